//! Frictions, pressures and indentations of the paper's experiments.

/// The friction coefficients of section II.B: 0.08, 0.085 ... 0.20.
pub fn frictions() -> impl ExactSizeIterator<Item = f64> + Clone {
    (0..25u8).map(|i| f64::from(80 + 5 * u16::from(i)) / 1000.0)
}

/// The pressures of section II.B, Pa: 3000, 3400 ... 7000.
pub fn pressures_pa() -> impl ExactSizeIterator<Item = f64> + Clone {
    (0..11u8).map(|i| f64::from(3000 + 400 * u16::from(i)))
}

/// The indentations of the roller series, mm. The paper gives only 5.05 mm, as the condition of the fold test; it is
/// assumed to be a_5, the deepest. The other four are assumed too.
pub const INDENTATIONS_MM: [f64; 5] = [1.0, 2.0, 3.0, 4.0, 5.05];
