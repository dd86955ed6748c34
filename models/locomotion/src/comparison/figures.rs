//! The figures of one body that the sentences need: its runs, and short calculations about it.

use crate::body::Chain;
use crate::comparison::runs::{RigRuns, TubeRuns};
use crate::comparison::{Common, Questions};
use crate::kinematics::Design;
use crate::model::Model;
use crate::paper::INDENTATIONS_MM;
use crate::prior::{self, Words};
use crate::range::OutOfRange;
use crate::{folded, roller, tube};

/// The deepest of the paper's indentations.
pub(super) const DEEPEST_MM: f64 = INDENTATIONS_MM[4];

/// One body on the rig, in the tube and folded, with the runs that several sentences share.
pub(super) struct Figures<'a> {
    model: &'a Model,
    pub(super) rig: roller::Params,
    pub(super) pipe: tube::Params,
    pub(super) block: folded::Params,
    pub(super) on_rig: RigRuns,
    pub(super) in_tube: TubeRuns,
    pub(super) common: &'a Common,
    /// The paper's design with the printed angles.
    pub(super) printed: Design<f64>,
}

/// An unfolded body squeezed evenly to the deepest indentation, then released.
pub(super) struct Squeezed {
    /// Displacement of the tail by the squeeze.
    pub(super) tail_mm: f64,
    /// Displacement of the head by the release.
    pub(super) released_head_mm: f64,
    /// Length after the release less length at rest.
    pub(super) released_mm: f64,
}

/// A folded body under one cycle of the rollers.
pub(super) struct Pushed {
    /// Displacement by the stroke to the left.
    pub(super) antegrade_mm: f64,
    /// Displacement by the return stroke.
    pub(super) returning_mm: f64,
}

/// The paper's body with other angles or another core.
pub(super) fn design(
    alpha_deg: f64,
    beta_deg: f64,
    core_ratio: f64,
) -> Result<Design<f64>, OutOfRange> {
    Design::new(24.40, core_ratio * 24.40, alpha_deg, beta_deg, 9)
}

impl<'a> Figures<'a> {
    /// Makes the runs of the worlds that are asked for.
    pub(super) fn new(
        model: &'a Model,
        asked: &Questions<'_>,
        common: &'a Common,
    ) -> Result<Self, OutOfRange> {
        let (mut rig, mut pipe) = (model.rig()?, model.tube()?);
        if asked.roughly {
            (rig, pipe) = (prior::rough_rig(rig), prior::rough_tube(pipe));
        }
        Ok(Self {
            model,
            rig,
            pipe,
            block: model.folded(None)?,
            on_rig: match asked.worlds.contains(&Words::Rig) {
                true => RigRuns::new(rig, asked.roughly)?,
                false => RigRuns::NOT_ASKED,
            },
            in_tube: match asked.worlds.contains(&Words::Tube) {
                true => TubeRuns::new(pipe, asked.roughly)?,
                false => TubeRuns::NOT_ASKED,
            },
            common,
            printed: Design::paper_printed(),
        })
    }

    /// The design of the body on the rig.
    pub(super) fn body(&self) -> Design<f64> {
        self.rig.body.design
    }

    /// The body with another slope of its long sides, or another number of crescents.
    fn other(&self, tan_beta: f64, crescents: u8) -> Result<Design<f64>, OutOfRange> {
        let body = self.body();
        Design::with_slopes(
            body.width_mm(),
            body.core_mm(),
            body.tan_alpha(),
            tan_beta,
            crescents,
        )
    }

    /// The body with another number of crescents.
    pub(super) fn with_crescents(&self, crescents: u8) -> Result<Design<f64>, OutOfRange> {
        self.other(self.body().tan_beta(), crescents)
    }

    /// The body at beta = 45 deg.
    pub(super) fn steep(&self, crescents: u8) -> Result<Design<f64>, OutOfRange> {
        self.other(1.0, crescents)
    }

    /// The same with the number of crescents that comes nearest to the length of the core.
    pub(super) fn as_long(&self) -> Result<Design<f64>, OutOfRange> {
        let spacing_mm = self.steep(1)?.spacing_mm();
        let as_long = libm::round(self.body().core_length_mm(0.0)? / spacing_mm);
        self.steep(as_long.clamp(1.0, 32.0) as u8)
    }

    /// Displacement of another design on the rig, at the deepest indentation.
    pub(super) fn run(&self, design: Design<f64>) -> Result<f64, OutOfRange> {
        let mut params = self.rig;
        params.body.design = design;
        roller::run(params, DEEPEST_MM)
    }

    /// Length of the wall that the rollers' arc touches at the deepest indentation.
    pub(super) fn wave_mm(&self) -> f64 {
        2.0 * libm::sqrt(DEEPEST_MM * (2.0 * self.rig.radius_mm - DEEPEST_MM))
    }

    /// Shortening per crescent at 3 mm, less that of the printed design.
    pub(super) fn shortened_mm(&self, design: Design<f64>) -> Result<f64, OutOfRange> {
        Ok(design.shortening_per_crescent_mm(3.0)?
            - self.printed.shortening_per_crescent_mm(3.0)?)
    }

    /// Squeezes the unfolded body evenly and releases it.
    pub(super) fn squeezed(&self) -> Result<Squeezed, OutOfRange> {
        let mut chain = Chain::new(self.rig.body)?;
        let at_rest_mm = chain.head_mm() - chain.core_tail_mm();
        chain.step(|_| DEEPEST_MM)?;
        let (tail_mm, head_mm) = (chain.displacement_mm(), chain.head_displacement_mm());
        chain.step(|_| 0.0)?;
        Ok(Squeezed {
            tail_mm,
            released_head_mm: chain.head_displacement_mm() - head_mm,
            released_mm: chain.head_mm() - chain.core_tail_mm() - at_rest_mm,
        })
    }

    /// Pushes the folded body by one stroke to the left and one back.
    pub(super) fn pushed(&self) -> Result<Pushed, OutOfRange> {
        let mut body = folded::FoldedBody::new(self.block, DEEPEST_MM)?;
        body.carriage_to(self.block.stroke_mm)?;
        let antegrade_mm = body.displacement_mm();
        body.carriage_to(0.0)?;
        Ok(Pushed {
            antegrade_mm,
            returning_mm: body.displacement_mm() - antegrade_mm,
        })
    }

    /// Displacement of a body that is declared folded with no thread drawn in.
    pub(super) fn undrawn_mm(&self) -> Result<f64, OutOfRange> {
        folded::run(self.model.folded(Some(0.0))?, DEEPEST_MM)
    }

    /// Displacement in the tube at 7000 Pa with a wave every 4 s.
    pub(super) fn often_mm(&self) -> Result<f64, OutOfRange> {
        let often = tube::Params {
            period_s: 4.0,
            ..self.pipe
        };
        Ok(tube::averaged(often, 7000.0)?.tail_mm)
    }

    /// Buckling pressure of a free elastic ring under outer pressure, Pa: `E t^3 / (4 (1-nu^2) R^3)`, with R to the
    /// middle of the wall.
    pub(super) fn ring_buckling_pa(&self) -> f64 {
        let pipe = &self.pipe;
        let ratio = pipe.thickness_mm / (pipe.radius_mm + pipe.thickness_mm / 2.0);
        pipe.modulus_pa * ratio * ratio * ratio / (4.0 * (1.0 - pipe.poisson * pipe.poisson))
    }
}

/// Greatest step less least step from one of the paper's indentations to the next.
pub(super) fn uneven_mm() -> f64 {
    let steps = INDENTATIONS_MM.windows(2).map(|pair| pair[1] - pair[0]);
    let (least, most) = (
        steps.clone().fold(f64::INFINITY, f64::min),
        steps.fold(0.0, f64::max),
    );
    most - least
}
