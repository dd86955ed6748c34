//! The tabulated model: displacements at the nodes of a grid of bodies, with linear interpolation between them.
//!
//! A run with a converged step takes milliseconds, and a posterior takes some hundred thousand runs; reading a table
//! takes less than a microsecond. A node is computed when it is first needed: a posterior is thin and never needs
//! most nodes of the box around it. [`crate::fit`] measures the loss of accuracy against the model itself.

use std::sync::OnceLock;

use crate::observation::Case;
use crate::prediction::Predictor;
use crate::prior::{OF_BODY, Parts};

/// A sheared box of bodies: `origin + lower triangle * coordinates`, each coordinate from `low` to `high`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Region {
    origin: Parts,
    shear: [Parts; OF_BODY],
    low: Parts,
    high: Parts,
}

/// Least width of a box, in probabilities of the prior.
const LEAST_WIDTH: f64 = 1e-4;

impl Region {
    /// All bodies of the prior.
    pub const WHOLE: Self = Self {
        origin: [0.0; OF_BODY],
        shear: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        low: [0.0; OF_BODY],
        high: [1.0; OF_BODY],
    };

    /// The box around bodies along the Cholesky factor of their covariance, so that it follows a ridge, with a margin
    /// to each side as a share of its width. None without bodies.
    #[must_use]
    pub fn around(bodies: &[Parts], margin: f64) -> Option<Self> {
        let count = bodies.len() as f64;
        bodies.first()?;
        let origin: Parts =
            core::array::from_fn(|axis| bodies.iter().map(|body| body[axis]).sum::<f64>() / count);
        let covariance = |one: usize, other: usize| {
            let product = |body: &Parts| (body[one] - origin[one]) * (body[other] - origin[other]);
            bodies.iter().map(product).sum::<f64>() / count
        };
        let mut shear = [[0.0; OF_BODY]; OF_BODY];
        for row in 0..OF_BODY {
            for column in 0..=row {
                let known: f64 = (0..column).map(|k| shear[row][k] * shear[column][k]).sum();
                let left = covariance(row, column) - known;
                shear[row][column] = if row == column {
                    libm::sqrt(left.max(0.0)).max(LEAST_WIDTH)
                } else {
                    left / shear[column][column]
                };
            }
        }
        let mut this = Self {
            origin,
            shear,
            low: [f64::INFINITY; OF_BODY],
            high: [f64::NEG_INFINITY; OF_BODY],
        };
        for body in bodies {
            let at = this.coordinates(body);
            for (axis, coordinate) in at.into_iter().enumerate() {
                this.low[axis] = this.low[axis].min(coordinate);
                this.high[axis] = this.high[axis].max(coordinate);
            }
        }
        for axis in 0..OF_BODY {
            let more = margin * (this.high[axis] - this.low[axis]).max(1.0);
            this.low[axis] -= more;
            this.high[axis] += more;
        }
        Some(this)
    }

    /// Coordinates of a body.
    fn coordinates(&self, body: &Parts) -> Parts {
        let mut at = [0.0; OF_BODY];
        for row in 0..OF_BODY {
            let known: f64 = (0..row)
                .map(|column| self.shear[row][column] * at[column])
                .sum();
            at[row] = (body[row] - self.origin[row] - known) / self.shear[row][row];
        }
        at
    }

    /// The body at these shares of the widths. Beyond the end of a prior, the body at that end.
    fn body(&self, shares: Parts) -> Parts {
        let at: Parts = core::array::from_fn(|axis| {
            self.low[axis] + shares[axis] * (self.high[axis] - self.low[axis])
        });
        core::array::from_fn(|row| {
            let along: f64 = (0..=row)
                .map(|column| self.shear[row][column] * at[column])
                .sum();
            (self.origin[row] + along).clamp(0.0, 1.0)
        })
    }
}

/// Displacements at the nodes of a grid.
#[derive(Debug)]
pub struct Table {
    region: Region,
    nodes: [usize; OF_BODY],
    predictor: Predictor,
    /// Inner `None`: the model does not cover the body.
    found_mm: Vec<OnceLock<Option<Vec<f64>>>>,
}

impl Table {
    /// Tabulates a predictor's cases over a region, with `nodes` nodes for each parameter. Computes nothing yet.
    ///
    /// # Panics
    /// With fewer than two nodes for a parameter: interpolation needs two.
    #[must_use]
    pub fn new(predictor: Predictor, region: Region, nodes: [usize; OF_BODY]) -> Self {
        assert!(nodes.iter().all(|count| *count >= 2), "{nodes:?}");
        let mut found_mm = vec![];
        found_mm.resize_with(nodes.iter().product(), OnceLock::new);
        Self {
            region,
            nodes,
            predictor,
            found_mm,
        }
    }

    /// The displacements at a node.
    fn node(&self, place: [usize; OF_BODY]) -> Option<&[f64]> {
        let [_, second, third] = self.nodes;
        let index = (place[0] * second + place[1]) * third + place[2];
        let share = |axis: usize| place[axis] as f64 / (self.nodes[axis] - 1) as f64;
        let work = || {
            let body = self.region.body(core::array::from_fn(share));
            self.predictor.displacements_mm(&body).ok()
        };
        self.found_mm[index].get_or_init(work).as_deref()
    }

    /// Displacements of all cases, mm; none outside the region, and near bodies that the model does not cover.
    #[must_use]
    pub fn displacements_mm(&self, body: &Parts) -> Option<Vec<f64>> {
        let at = self.region.coordinates(body);
        let mut cell = [0; OF_BODY];
        let mut shares = [0.0; OF_BODY];
        for axis in 0..OF_BODY {
            let (low, high) = (self.region.low[axis], self.region.high[axis]);
            if !(low..=high).contains(&at[axis]) {
                return None;
            }
            let cells = self.nodes[axis] - 1;
            let along = (at[axis] - low) / (high - low) * cells as f64;
            cell[axis] = (along as usize).min(cells - 1);
            shares[axis] = along - cell[axis] as f64;
        }
        let mut found = vec![0.0; self.predictor.cases().len()];
        for corner in 0..1 << OF_BODY {
            let (mut place, mut weight) = (cell, 1.0);
            for axis in 0..OF_BODY {
                let far = corner >> axis & 1;
                place[axis] += far;
                weight *= if far == 1 {
                    shares[axis]
                } else {
                    1.0 - shares[axis]
                };
            }
            for (sum, mm) in found.iter_mut().zip(self.node(place)?) {
                *sum += weight * mm;
            }
        }
        Some(found)
    }

    /// Number of nodes computed so far, and number of all nodes.
    #[must_use]
    pub fn worked_out(&self) -> (usize, usize) {
        let done = self.found_mm.iter().filter(|node| node.get().is_some());
        (done.count(), self.found_mm.len())
    }
}

/// The distinct cases among these, and for each given case its index there.
#[must_use]
pub fn distinct(all: impl IntoIterator<Item = Case>) -> (Vec<Case>, Vec<usize>) {
    let mut cases: Vec<Case> = vec![];
    let place = |case: Case| {
        let known = cases.iter().position(|other| *other == case);
        known.unwrap_or_else(|| {
            cases.push(case);
            cases.len() - 1
        })
    };
    let places = all.into_iter().map(place).collect();
    (cases, places)
}
