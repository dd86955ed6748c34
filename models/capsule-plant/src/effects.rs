//! Effects of a real capsule beyond the plain model: variable friction, a plastic origami, play in the gears, an
//! imperfect encoder and amplifier, a cell that polarises. Each can be switched off or scaled.
//!
//! **None is measured**: the coefficients of copper and magnet are those of the materials, all other ranges are
//! assumed. They were chosen before any firmware was tested against them.

use crate::random::Random;

/// An effect that the plain model lacks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Friction of worm and motor falls as the grease warms up.
    Grease,
    /// Winding and magnet warm up: more resistance, less torque.
    WarmMotor,
    /// The worm's friction differs between winding and paying out.
    Direction,
    /// The worm's friction changes with the number of cycles.
    Wear,
    /// A standing motor has more friction than a turning one.
    StickSlip,
    /// The origami pulls less while it opens.
    Hysteresis,
    /// The origami's force falls while it is held.
    Relaxation,
    /// With each cycle, thread and origami lengthen and the origami softens.
    Creep,
    /// The origami resists in proportion to its speed.
    Damping,
    /// Crescents snap through during a fold.
    SnapThrough,
    /// Play between motor and spool.
    Backlash,
    /// The edges of the encoder's lines are not exactly a quarter of a line apart.
    EncoderPhase,
    /// The amplifier's zero drifts.
    AmplifierDrift,
    /// The cell's voltage falls further while current flows, and recovers.
    Polarisation,
}

impl Effect {
    /// All effects.
    pub const ALL: [Self; 14] = [
        Self::Grease,
        Self::WarmMotor,
        Self::Direction,
        Self::Wear,
        Self::StickSlip,
        Self::Hysteresis,
        Self::Relaxation,
        Self::Creep,
        Self::Damping,
        Self::SnapThrough,
        Self::Backlash,
        Self::EncoderPhase,
        Self::AmplifierDrift,
        Self::Polarisation,
    ];
}

/// Size of each effect in one capsule; 0 switches it off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Effects {
    /// [`Effect::Grease`]: fraction of the worm's friction lost per K above 22 degrees.
    pub worm_per_k: f64,
    /// [`Effect::Grease`]: fraction of the no-load current lost per K above 22 degrees.
    pub no_load_per_k: f64,
    /// [`Effect::WarmMotor`]: scale; 1 is copper's +0.39 % and a magnet's -0.11 % per K.
    pub warm_motor: f64,
    /// [`Effect::Direction`]: friction while paying out over that while winding, less 1.
    pub direction: f64,
    /// [`Effect::Wear`]: fraction by which the worm's friction has changed after a long life.
    pub wear: f64,
    /// [`Effect::StickSlip`]: friction of a standing motor over that of a turning one, less 1.
    pub stick: f64,
    /// [`Effect::Hysteresis`]: fraction of the force that the origami lacks while it opens.
    pub hysteresis: f64,
    /// [`Effect::Relaxation`]: fractions of the force that a held origami loses, one per [`RELAXATION_S`].
    pub relaxation: [f64; 2],
    /// [`Effect::Creep`]: lengthening per tenfold number of cycles, mm.
    pub creep_mm: f64,
    /// [`Effect::Creep`]: fraction of the force that the origami loses per tenfold number of cycles.
    pub softening: f64,
    /// [`Effect::Damping`]: resistance to speed, N s/mm.
    pub damping: f64,
    /// [`Effect::SnapThrough`]: fraction of the force that each snap at [`Effects::snap_at_mm`] loses.
    pub snap_through: f64,
    /// Travel of the snaps, mm.
    pub snap_at_mm: [f64; 3],
    /// [`Effect::Backlash`]: play, mm of thread.
    pub backlash_mm: f64,
    /// [`Effect::EncoderPhase`]: delay of the four edges of each line, counts.
    pub phase: [f64; 4],
    /// [`Effect::AmplifierDrift`]: amplitude of the zero's drift, mV.
    pub drift_mv: f64,
    /// [`Effect::AmplifierDrift`]: period of the drift, s.
    pub drift_s: f64,
    /// [`Effect::Polarisation`]: resistance, ohm.
    pub polarisation_ohm: f64,
    /// [`Effect::Polarisation`]: time constant, s.
    pub polarisation_s: f64,
}

/// Temperature for which the parameters hold, degrees Celsius.
pub const ROOM_C: f64 = 22.0;
/// Time constants of the relaxation, s: one within a motion, one within a rest.
pub const RELAXATION_S: [f64; 2] = [5.0, 300.0];
/// Travel over which the hysteresis reverses, mm (assumed).
pub const HYSTERESIS_MM: f64 = 0.3;
/// Travel over which a snap's force builds up, and over which it is lost, mm (assumed).
pub const SNAP_MM: (f64, f64) = (0.6, 0.05);
/// Speed at which most of the additional standing friction has vanished, rad/s: 0.4 mm/s of thread (assumed).
pub const STICK_RAD_S: f64 = 30.0;
/// Cycles after which half of the wear has occurred (assumed).
pub const WEAR_CYCLES: f64 = 200.0;
/// Temperature coefficient of copper's resistance, per K.
const COPPER_PER_K: f64 = 0.0039;
/// Temperature coefficient of an NdFeB magnet, per K.
const MAGNET_PER_K: f64 = -0.0011;

impl Effects {
    /// The plain model.
    pub const NONE: Self = Self {
        worm_per_k: 0.0,
        no_load_per_k: 0.0,
        warm_motor: 0.0,
        direction: 0.0,
        wear: 0.0,
        stick: 0.0,
        hysteresis: 0.0,
        relaxation: [0.0; 2],
        creep_mm: 0.0,
        softening: 0.0,
        damping: 0.0,
        snap_through: 0.0,
        snap_at_mm: [0.0; 3],
        backlash_mm: 0.0,
        phase: [0.0; 4],
        drift_mv: 0.0,
        drift_s: 100.0,
        polarisation_ohm: 0.0,
        polarisation_s: 3.0,
    };

    /// The effects of the capsule with this seed.
    #[must_use]
    pub fn varied(seed: u64) -> Self {
        let mut random = Random::new(seed ^ 0xEFFE_C7ED);
        Self {
            worm_per_k: random.between(0.005, 0.015),
            no_load_per_k: random.between(0.005, 0.015),
            warm_motor: 1.0,
            direction: random.between(-0.1, 0.1),
            wear: random.between(-0.2, 0.2),
            stick: random.between(0.1, 0.4),
            hysteresis: random.between(0.05, 0.25),
            relaxation: [random.between(0.01, 0.06), random.between(0.02, 0.10)],
            creep_mm: random.between(0.02, 0.28),
            softening: random.between(0.0, 0.03),
            damping: random.between(0.0, 0.06),
            snap_through: random.between(0.0, 0.15),
            snap_at_mm: [
                random.between(6.0, 13.0),
                random.between(13.0, 18.0),
                random.between(18.0, 21.0),
            ],
            backlash_mm: random.between(0.01, 0.06),
            phase: [(); 4].map(|()| random.between(-0.3, 0.3)),
            drift_mv: random.between(-3.0, 3.0),
            drift_s: random.between(20.0, 200.0),
            polarisation_ohm: random.between(0.1, 0.5),
            polarisation_s: random.between(1.0, 10.0),
        }
    }

    /// Scales one effect: 0 switches it off, 2 doubles it.
    #[must_use]
    pub fn scaled(mut self, effect: Effect, times: f64) -> Self {
        match effect {
            Effect::Grease => {
                self.worm_per_k *= times;
                self.no_load_per_k *= times;
            }
            Effect::WarmMotor => self.warm_motor *= times,
            Effect::Direction => self.direction *= times,
            Effect::Wear => self.wear *= times,
            Effect::StickSlip => self.stick *= times,
            Effect::Hysteresis => self.hysteresis *= times,
            Effect::Relaxation => {
                self.relaxation = self.relaxation.map(|fraction| fraction * times)
            }
            Effect::Creep => {
                self.creep_mm *= times;
                self.softening *= times;
            }
            Effect::Damping => self.damping *= times,
            Effect::SnapThrough => self.snap_through *= times,
            Effect::Backlash => self.backlash_mm *= times,
            // Limit: beyond half a count two edges would swap.
            Effect::EncoderPhase => {
                self.phase = self.phase.map(|late| (late * times).clamp(-0.49, 0.49));
            }
            Effect::AmplifierDrift => self.drift_mv *= times,
            Effect::Polarisation => self.polarisation_ohm *= times,
        }
        self
    }

    /// Keeps only this effect, scaled.
    #[must_use]
    pub fn only(self, effect: Effect, times: f64) -> Self {
        Effect::ALL.into_iter().fold(self, |effects, other| {
            effects.scaled(other, if other == effect { times } else { 0.0 })
        })
    }

    /// Winding resistance and motor constant at a temperature, relative to room temperature.
    #[must_use]
    pub fn motor_at(&self, celsius: f64) -> (f64, f64) {
        let warmer = self.warm_motor * (celsius - ROOM_C);
        (1.0 + COPPER_PER_K * warmer, 1.0 + MAGNET_PER_K * warmer)
    }

    /// Worm friction at a temperature after this many cycles, and no-load current, relative to the parameters.
    #[must_use]
    pub fn friction_at(&self, celsius: f64, cycles: f64) -> (f64, f64) {
        let warmer = celsius - ROOM_C;
        let worn = self.wear * cycles / (WEAR_CYCLES + cycles);
        (
            ((1.0 - self.worm_per_k * warmer) * (1.0 + worn)).max(0.1),
            (1.0 - self.no_load_per_k * warmer).max(0.1),
        )
    }
}
