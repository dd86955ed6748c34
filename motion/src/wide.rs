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

/// Not inlined: each use would bring a kilobyte of its own.
#[inline(never)]
fn div_rem(numerator: u128, denominator: u128) -> (u128, u128) {
    let quotient = numerator / denominator;
    (quotient, numerator - quotient * denominator)
}
