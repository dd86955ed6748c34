//! Linear least squares.

/// A fit by least squares.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fit<const N: usize> {
    pub(super) values: [f64; N],
    /// Standard deviations, corrected for correlated residuals.
    pub(super) deviations: [f64; N],
    /// Sum of squared residuals.
    pub(super) squares: f64,
}

/// Least squares for `rows` of factors and results; none if they do not determine the values.
pub(super) fn fit<const N: usize>(rows: &[([f64; N], f64)]) -> Option<Fit<N>> {
    let mut normal = [[0.0; N]; N];
    let mut right = [0.0; N];
    for (factors, result) in rows {
        for i in 0..N {
            right[i] += factors[i] * result;
            for j in 0..N {
                normal[i][j] += factors[i] * factors[j];
            }
        }
    }
    let inverse = inverse(normal)?;
    let values: [f64; N] = std::array::from_fn(|i| (0..N).map(|j| inverse[i][j] * right[j]).sum());
    let residuals: Vec<f64> = rows
        .iter()
        .map(|(factors, result)| {
            let given: f64 = (0..N).map(|i| factors[i] * values[i]).sum();
            result - given
        })
        .collect();
    let squares: f64 = residuals.iter().map(|residual| residual * residual).sum();
    let free = rows.len().checked_sub(N).filter(|free| *free > 0)? as f64;
    let variance = squares / free * likeness(&residuals);
    Some(Fit {
        values,
        deviations: std::array::from_fn(|i| (variance * inverse[i][i].max(0.0)).sqrt()),
        squares,
    })
}

/// Factor on a variance for correlated neighbouring residuals. Limited: above a correlation of 0.9 it would depend on
/// the estimate of the correlation alone.
pub(super) fn likeness(residuals: &[f64]) -> f64 {
    let squares: f64 = residuals.iter().map(|residual| residual * residual).sum();
    let products: f64 = residuals.windows(2).map(|pair| pair[0] * pair[1]).sum();
    let alike = match squares > 0.0 {
        true => (products / squares).clamp(0.0, 0.9),
        false => 0.0,
    };
    (1.0 + alike) / (1.0 - alike)
}

/// Inverse by Gauss-Jordan elimination with the largest pivot; none if the matrix is singular.
pub(super) fn inverse<const N: usize>(mut matrix: [[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let mut result = [[0.0; N]; N];
    for (i, row) in result.iter_mut().enumerate() {
        row[i] = 1.0;
    }
    for column in 0..N {
        let pivot = (column..N).max_by(|one, other| {
            matrix[*one][column]
                .abs()
                .total_cmp(&matrix[*other][column].abs())
        })?;
        matrix.swap(column, pivot);
        result.swap(column, pivot);
        let by = matrix[column][column];
        if by.abs() < 1e-12 {
            return None;
        }
        for j in 0..N {
            matrix[column][j] /= by;
            result[column][j] /= by;
        }
        for row in (0..N).filter(|row| *row != column) {
            let by = matrix[row][column];
            for j in 0..N {
                matrix[row][j] -= by * matrix[column][j];
                result[row][j] -= by * result[column][j];
            }
        }
    }
    Some(result)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_finds_a_line_and_says_how_well() {
        // 3 + 2 x, with alternating deviations of equal size.
        let rows = |scatter: f64| -> Vec<([f64; 2], f64)> {
            (0..100)
                .map(|x| (f64::from(x), if x % 2 == 0 { scatter } else { -scatter }))
                .map(|(x, error)| ([1.0, x], 3.0 + 2.0 * x + error))
                .collect()
        };
        let exact = fit(&rows(0.0)).expect("determined");
        assert!((exact.values[0] - 3.0).abs() < 1e-9 && (exact.values[1] - 2.0).abs() < 1e-12);
        assert!(exact.deviations[0] < 1e-6);
        let loose = fit(&rows(1.0)).expect("determined");
        // Standard deviation of the mean of 100 values with deviation 1, at the end of a line: 0.2.
        assert!((0.1..0.3).contains(&loose.deviations[0]), "{loose:?}");
        let errors = [loose.values[0] - 3.0, loose.values[1] - 2.0];
        assert!(errors[0].abs() < 0.1 && errors[1].abs() < 0.01, "{loose:?}");
    }

    #[test]
    fn neighbours_that_err_alike_count_as_one() {
        let rows = |length: i32| -> Vec<([f64; 1], f64)> {
            let error = |x: i32| if x / length % 2 == 0 { 1.0 } else { -1.0 };
            (0..400).map(|x| ([1.0], error(x))).collect()
        };
        let (each, tens) = (fit(&rows(1)).expect("one"), fit(&rows(10)).expect("one"));
        assert!(
            tens.deviations[0] > 2.5 * each.deviations[0],
            "{each:?} {tens:?}"
        );
    }

    #[test]
    fn a_deviation_is_that_of_a_mean() {
        let rows: Vec<_> = (0..400)
            .map(|x| ([1.0], if x % 2 == 0 { 2.0 } else { -2.0 }))
            .collect();
        let found = fit(&rows).expect("one");
        let expected = (4.0_f64 / 399.0).sqrt();
        assert!((found.deviations[0] - expected).abs() < 1e-9, "{found:?}");
        assert!((found.squares - 1_600.0).abs() < 1e-9);
    }

    /// A quarter of the squares is common to neighbours; at most nine tenths count.
    #[test]
    fn likeness_is_the_correlation_of_neighbours() {
        for (residuals, expected) in [
            (&[2.0, 2.0, -2.0, -2.0][..], 1.25 / 0.75),
            (&[2.0, -2.0], 1.0),
            (&[0.0, 0.0], 1.0),
            (&[3.0; 100], 19.0),
        ] {
            let found = likeness(residuals);
            assert!((found - expected).abs() < 1e-9, "{found} for {expected}");
        }
    }

    #[test]
    fn what_is_not_determined_is_not_told() {
        let same: Vec<_> = (0..10).map(|_| ([1.0, 5.0], 2.0)).collect();
        assert!(fit(&same).is_none());
        assert!(fit::<2>(&[]).is_none());
        // With as many values as rows, nothing is left to judge them by.
        assert!(fit(&[([1.0, 0.0], 1.0), ([0.0, 1.0], 2.0)]).is_none());
    }
}
