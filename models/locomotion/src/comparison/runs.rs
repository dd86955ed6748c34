//! The runs of one body, on the rig and in the tube, that the rows of the comparison share.

use crate::body::FrictionRatio;
use crate::comparison::frictions;
use crate::paper::{INDENTATIONS_MM, pressures_pa};
use crate::range::OutOfRange;
use crate::{roller, trend, tube};

/// On the rig.
pub(super) struct RigRuns {
    /// Displacement at each indentation.
    pub(super) roller_mm: [f64; 5],
    /// Greatest difference at any indentation between the lowest and the highest friction.
    pub(super) lubrication_mm: f64,
    /// Isolated passes at each indentation.
    pub(super) passes: [roller::IsolatedPass; 5],
}

impl RigRuns {
    /// Stands for runs that were not requested: NaN shows in any row that uses them nevertheless.
    pub(super) const NOT_ASKED: Self = Self {
        roller_mm: [f64::NAN; 5],
        lubrication_mm: f64::NAN,
        passes: [roller::IsolatedPass {
            antegrade_mm: f64::NAN,
            returning_mm: f64::NAN,
        }; 5],
    };

    /// `roughly`: with a fixed friction ratio, compares the frictions at the least and the greatest indentation only.
    pub(super) fn new(rig: roller::Params, roughly: bool) -> Result<Self, OutOfRange> {
        let fixed = rig.body.friction_ratio != FrictionRatio::Facets;
        let (mut wet, mut dry) = (rig, rig);
        wet.body.friction = 0.08;
        dry.body.friction = 0.20;
        let mut this = Self::NOT_ASKED;
        this.lubrication_mm = 0.0;
        for (place, indentation) in INDENTATIONS_MM.into_iter().enumerate() {
            this.roller_mm[place] = roller::run(rig, indentation)?;
            this.passes[place] = roller::isolated_pass(rig, indentation)?;
            if roughly && fixed && !matches!(place, 0 | 4) {
                continue;
            }
            let difference = roller::run(dry, indentation)? - roller::run(wet, indentation)?;
            this.lubrication_mm = this.lubrication_mm.max(libm::fabs(difference));
        }
        Ok(this)
    }

    /// R^2 of the straight line through the roller series, with the origin as a sixth point or without.
    pub(super) fn linearity(&self, origin: bool) -> f64 {
        let points = INDENTATIONS_MM.into_iter().zip(self.roller_mm);
        trend::linearity([(0.0, 0.0)].into_iter().take(origin.into()).chain(points))
    }

    /// Displacement by a return pass as a share of the antegrade pass: the greatest over the indentations. Infinite
    /// if an antegrade pass does not move the body headward, because no return is small beside nothing.
    pub(super) fn worst_return(&self) -> f64 {
        self.passes
            .iter()
            .map(|pass| {
                if pass.antegrade_mm > 0.0 {
                    libm::fabs(pass.returning_mm) / pass.antegrade_mm
                } else {
                    f64::INFINITY
                }
            })
            .fold(0.0, f64::max)
    }
}

/// In the tube.
pub(super) struct TubeRuns {
    /// Displacement at each pressure, mean over the placements.
    pub(super) pressure: [tube::Averaged; 11],
    /// Least and greatest displacement over the frictions at 7000 Pa.
    pub(super) friction_mm: (f64, f64),
    /// Greatest difference at any pressure between the lowest and the highest friction.
    pub(super) difference_mm: f64,
}

impl TubeRuns {
    /// Stands for runs that were not requested.
    pub(super) const NOT_ASKED: Self = Self {
        pressure: [tube::Averaged {
            tail_mm: f64::NAN,
            head_mm: f64::NAN,
            range_mm: (f64::NAN, f64::NAN),
        }; 11],
        friction_mm: (f64::NAN, f64::NAN),
        difference_mm: f64::NAN,
    };

    /// `roughly`: with a fixed friction ratio, compares the frictions at the lowest and the highest pressure only.
    pub(super) fn new(pipe: tube::Params, roughly: bool) -> Result<Self, OutOfRange> {
        let mut this = Self::NOT_ASKED;
        this.difference_mm = 0.0;
        let fixed = pipe.body.friction_ratio != FrictionRatio::Facets;
        // With a fixed ratio the friction cancels to the last bit, so one placement is enough.
        let few = tube::Params {
            placements: if fixed { 1 } else { pipe.placements },
            ..pipe
        };
        for (place, pressure_pa) in pressures_pa().enumerate() {
            this.pressure[place] = tube::averaged(pipe, pressure_pa)?;
            if roughly && fixed && !matches!(place, 0 | 10) {
                continue;
            }
            let difference = tube::averaged(with_friction(few, 0.20), pressure_pa)?.tail_mm
                - tube::averaged(with_friction(few, 0.08), pressure_pa)?.tail_mm;
            this.difference_mm = this.difference_mm.max(libm::fabs(difference));
        }
        this.friction_mm = over_frictions(pipe)?;
        Ok(this)
    }

    /// Displacement of the tail at each pressure.
    pub(super) fn pressure_mm(&self) -> [f64; 11] {
        self.pressure.map(|averaged| averaged.tail_mm)
    }

    /// Mean slope of the pressure series between two of its points, mm/kPa.
    pub(super) fn slope_per_kpa(&self, from: usize, to: usize) -> f64 {
        let mm = self.pressure_mm();
        (mm[to] - mm[from]) / ((to - from) as f64 * 0.4)
    }

    /// Pressure at which the polyline of two parts that lies nearest to the series bends, Pa.
    pub(super) fn bend_pa(&self) -> f64 {
        let mm = self.pressure_mm();
        let mut points = [(0.0, 0.0); 11];
        for (point, of) in points.iter_mut().zip(pressures_pa().zip(mm)) {
            *point = of;
        }
        trend::bend(&points)
    }

    /// The slope above 5800 Pa over the one below. Infinite if only the upper one rises, NaN if neither does.
    pub(super) fn faster(&self) -> f64 {
        let (below, above) = (self.slope_per_kpa(0, 7), self.slope_per_kpa(7, 10));
        if below > 0.0 {
            above / below
        } else if above > 0.0 {
            f64::INFINITY
        } else {
            f64::NAN
        }
    }
}

/// Least and greatest displacement over the frictions at 7000 Pa.
pub(super) fn over_frictions(params: tube::Params) -> Result<(f64, f64), OutOfRange> {
    let mut range = (f64::INFINITY, f64::NEG_INFINITY);
    let slipping = params.body.friction_ratio == FrictionRatio::Facets;
    // With a fixed ratio the two ends are enough to show that the friction cancels.
    for friction in frictions().step_by(if slipping { 1 } else { 24 }) {
        let mm = tube::averaged(with_friction(params, friction), 7000.0)?.tail_mm;
        range = (range.0.min(mm), range.1.max(mm));
    }
    Ok(range)
}

fn with_friction(mut params: tube::Params, friction: f64) -> tube::Params {
    params.body.friction = friction;
    params
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A body that no antegrade pass moves must not count as one that a return pass hardly moves.
    #[test]
    fn a_return_pass_is_not_small_beside_nothing() {
        for antegrade_mm in [0.0, -1.0, f64::NAN] {
            let mut runs = RigRuns::NOT_ASKED;
            runs.passes = [roller::IsolatedPass {
                antegrade_mm,
                returning_mm: 0.0,
            }; 5];
            assert_eq!(runs.worst_return(), f64::INFINITY);
        }
    }

    /// A body that moves backward at all pressures must not count as faster because it falls back more.
    #[test]
    fn what_falls_is_not_faster() {
        let faster = |below_mm: f64, above_mm: f64| {
            let mut runs = TubeRuns::NOT_ASKED;
            for (place, averaged) in runs.pressure.iter_mut().enumerate() {
                averaged.tail_mm =
                    below_mm * place.min(7) as f64 + above_mm * place.saturating_sub(7) as f64;
            }
            runs.faster()
        };
        assert!((faster(1.0, 3.0) - 3.0).abs() < 1e-12);
        assert_eq!(faster(-1.0, 3.0), f64::INFINITY);
        assert!(faster(-1.0, -3.0).is_nan());
        assert!(faster(1.0, -3.0) < 0.0);
    }
}
