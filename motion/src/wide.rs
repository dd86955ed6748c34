//! Division of 128-bit numbers for set-up arithmetic: one copy of the long routine, for the image's sake.

/// `numerator / denominator`, rounded up. The denominator is not zero.
pub(crate) fn div_ceil(numerator: u128, denominator: u128) -> u128 {
    let (quotient, rest) = div_rem(numerator, denominator);
    quotient + u128::from(rest > 0)
}

/// `numerator / denominator`, to the nearest, half upward. The denominator is not zero.
pub(crate) fn div_nearest(numerator: u128, denominator: u128) -> u128 {
    div_rem(numerator + denominator / 2, denominator).0
}

/// Bit by bit: this runs a few dozen times before a move, and the compiler's routine takes a kilobyte.
#[inline(never)]
fn div_rem(numerator: u128, denominator: u128) -> (u128, u128) {
    let (mut quotient, mut rest) = (numerator, 0_u128);
    for _ in 0..u128::BITS {
        // The quotient's bits come in where the numerator's go out.
        rest = rest << 1 | quotient >> (u128::BITS - 1);
        quotient <<= 1;
        if rest >= denominator {
            rest -= denominator;
            quotient |= 1;
        }
    }
    (quotient, rest)
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        // The denominators of this crate stay below 2^127: a doubled rest fits.
        #[test]
        fn divides(numerator: u128, denominator in 1..u128::MAX / 2, shift in 0..128_u32) {
            let denominator = (denominator >> shift).max(1);
            let expected = (numerator / denominator, numerator % denominator);
            prop_assert_eq!(div_rem(numerator, denominator), expected);
        }
    }
}
