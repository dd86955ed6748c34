//! The fingerprint of an image against the published values of its hash.

use device::fingerprint;

/// FNV-1a over words is that over bytes where each word is a byte; the values are from its authors' list.
#[test]
fn the_fingerprint_is_fnv_over_words() {
    let of = |text: &str| fingerprint::of(text.bytes().map(u32::from));
    assert_eq!(of(""), 0x811C_9DC5);
    assert_eq!(of("a"), 0xE40C_292C);
    assert_eq!(of("foobar"), 0xBF9C_F968);
    // A high byte counts as well as a low one.
    assert_ne!(
        fingerprint::of([0x0100_0061].into_iter()),
        fingerprint::of([0x61].into_iter())
    );
}
