//! Division of 128-bit numbers and square root of 64-bit ones, for set-up and slow steps. They are
//! written for small code, not for speed.

/// `numerator / denominator`, rounded up. The denominator is not zero.
pub(crate) fn div_ceil(numerator: u128, denominator: u128) -> u128 {
    let (quotient, rest) = div_rem(numerator, denominator);
    quotient + u128::from(rest > 0)
}

/// `numerator / denominator`, to the nearest integer, half up. The denominator is not zero.
pub(crate) fn div_nearest(numerator: u128, denominator: u128) -> u128 {
    div_rem(numerator + denominator / 2, denominator).0
}

/// Quotient and remainder, bit by bit: this runs a few dozen times before a move, and the
/// compiler's routine takes a kilobyte.
#[inline(never)]
fn div_rem(numerator: u128, denominator: u128) -> (u128, u128) {
    let (mut quotient, mut rest) = (numerator, 0_u128);
    for _ in 0..u128::BITS {
        // Bits of the quotient come in at the bottom as bits of the numerator go out at the top.
        rest = rest << 1 | quotient >> (u128::BITS - 1);
        quotient <<= 1;
        if rest >= denominator {
            rest -= denominator;
            quotient |= 1;
        }
    }
    (quotient, rest)
}

/// The largest number whose square does not exceed `number`, bit by bit: the compiler's routine and
/// its table take 0.7 KB, and near rest or in slow steps there is time.
#[inline(never)]
pub(crate) const fn isqrt(number: u64) -> u64 {
    let (mut rest, mut root, mut bit) = (number, 0, 1 << 62);
    while bit > 0 {
        let trial = root + bit;
        root >>= 1;
        if rest >= trial {
            rest -= trial;
            root += bit;
        }
        bit >>= 2;
    }
    root
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        // The denominators of this crate are below 2^127, so that twice a remainder fits.
        #[test]
        fn divides(numerator: u128, denominator in 1..u128::MAX / 2, shift in 0..128_u32) {
            let denominator = (denominator >> shift).max(1);
            let expected = (numerator / denominator, numerator % denominator);
            prop_assert_eq!(div_rem(numerator, denominator), expected);
        }

        #[test]
        fn takes_the_root(number: u64, shift in 0..64_u32, root: u32, off in -1..=1_i64) {
            for number in [number >> shift, u64::from(root).pow(2).wrapping_add_signed(off)] {
                prop_assert_eq!(isqrt(number), number.isqrt());
            }
        }
    }
}
