//! The fingerprint of an image: the device reports it as `image_hash`, and the tool calculates it from a file.

/// FNV-1a, 32 bits, over code, constants and initial values as 32-bit words.
pub fn of(words: impl Iterator<Item = u32>) -> u32 {
    words.fold(0x811C_9DC5, |hash, word| {
        (hash ^ word).wrapping_mul(0x0100_0193)
    })
}
