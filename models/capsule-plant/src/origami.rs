//! The folded plastic at the end of the thread: force over travel, with relaxation, hysteresis and damping.
//!
//! It has no mass. The thread only pulls: if it is paid out faster than the origami opens, it goes slack.

use crate::effects::{Effects, HYSTERESIS_MM, RELAXATION_S, SNAP_MM};
use crate::spring;

/// State of the origami.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Origami {
    /// Length of the fold, mm: held by the thread, or longer while the origami opens.
    folded_mm: f64,
    /// Mean speed over the last step, mm/s.
    speed: f64,
    /// Direction of the hysteresis: 1 after folding, -1 after opening.
    direction: f64,
    /// Relaxed force of each time constant, N.
    settled_n: [f64; 2],
}

impl Origami {
    pub(crate) fn at(folded_mm: f64) -> Self {
        Self {
            folded_mm,
            direction: 1.0,
            ..Self::default()
        }
    }

    /// Force of an instantaneous fold without relaxation, N.
    fn elastic_n(folded_mm: f64, stiffness: f64, effects: &Effects) -> f64 {
        let (builds_mm, lost_mm) = SNAP_MM;
        if effects.snap_through == 0.0 {
            return spring::force_n(folded_mm) * stiffness;
        }
        let snap: f64 = effects
            .snap_at_mm
            .iter()
            .map(|at_mm| {
                let past = folded_mm - at_mm;
                if !(-builds_mm..lost_mm).contains(&past) {
                    0.0
                } else if past < 0.0 {
                    1.0 + past / builds_mm
                } else {
                    1.0 - past / lost_mm
                }
            })
            .sum();
        spring::force_n(folded_mm) * stiffness * (1.0 + effects.snap_through * snap)
    }

    /// Force against further folding, without damping, N.
    fn plastic_n(&self, stiffness: f64, effects: &Effects) -> f64 {
        let relaxed: f64 = (self.settled_n.iter())
            .zip(effects.relaxation)
            .map(|(settled, fraction)| settled * fraction)
            .sum();
        let force = Self::elastic_n(self.folded_mm, stiffness, effects) - relaxed;
        (force * (1.0 - effects.hysteresis * (1.0 - self.direction) / 2.0)).max(0.0)
    }

    /// Pull of the origami on a thread at `travel_mm`, N.
    pub(crate) fn pull_n(&self, travel_mm: f64, stiffness: f64, effects: &Effects) -> f64 {
        if self.folded_mm > travel_mm + 1e-9 {
            return 0.0;
        }
        // Between two steps the thread may have been released or caught. Only the elastic force is known then.
        let here = Self {
            folded_mm: travel_mm,
            ..*self
        };
        (here.plastic_n(stiffness, effects) + effects.damping * self.speed).max(0.0)
    }

    /// Advances the origami by `dt` to a thread at `travel_mm`; 0 if there is no thread.
    pub(crate) fn follow(&mut self, travel_mm: f64, stiffness: f64, effects: &Effects, dt: f64) {
        let before_mm = self.folded_mm;
        let opened_mm = if effects.damping > 0.0 && before_mm > travel_mm {
            before_mm - self.plastic_n(stiffness, effects) / effects.damping * dt
        } else {
            travel_mm
        };
        self.folded_mm = travel_mm.max(opened_mm);
        let moved_mm = self.folded_mm - before_mm;
        self.speed = moved_mm / dt;
        if moved_mm != 0.0 {
            let turned = (moved_mm.abs() / HYSTERESIS_MM).min(1.0);
            self.direction += (moved_mm.signum() - self.direction) * turned;
        }
        if effects.relaxation != [0.0; 2] {
            let force = Self::elastic_n(self.folded_mm, stiffness, effects);
            for (settled, time) in self.settled_n.iter_mut().zip(RELAXATION_S) {
                *settled += (force - *settled) * settles(dt / time);
            }
        }
    }
}

/// 1 - exp(-of). Short steps use the series, because an exponential is slow.
pub(crate) fn settles(of: f64) -> f64 {
    if of < 1e-3 {
        of - of * of / 2.0
    } else {
        -(-of).exp_m1()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moved(origami: &mut Origami, to_mm: f64, effects: &Effects) {
        let (steps, from_mm) = (10_000, origami.folded_mm);
        for step in 1..=steps {
            let fraction = f64::from(step) / f64::from(steps);
            origami.follow(from_mm + (to_mm - from_mm) * fraction, 1.0, effects, 1e-4);
        }
    }

    fn pull(origami: &Origami, at_mm: f64, effects: &Effects) -> f64 {
        origami.pull_n(at_mm, 1.0, effects)
    }

    #[test]
    fn without_effects_it_is_a_spring() {
        let mut origami = Origami::at(0.0);
        moved(&mut origami, 20.0, &Effects::NONE);
        assert_eq!(pull(&origami, 20.0, &Effects::NONE), spring::force_n(20.0));
        moved(&mut origami, 10.0, &Effects::NONE);
        assert_eq!(pull(&origami, 10.0, &Effects::NONE), spring::force_n(10.0));
    }

    #[test]
    fn hysteresis_takes_its_share_on_the_way_back() {
        let effects = Effects {
            hysteresis: 0.2,
            ..Effects::NONE
        };
        let mut origami = Origami::at(0.0);
        moved(&mut origami, 20.0, &effects);
        assert!((pull(&origami, 20.0, &effects) / spring::force_n(20.0) - 1.0).abs() < 1e-3);
        moved(&mut origami, 17.0, &effects);
        assert!((pull(&origami, 17.0, &effects) / spring::force_n(17.0) - 0.8).abs() < 1e-3);
    }

    #[test]
    fn a_held_fold_loses_its_share_and_an_opened_one_gets_it_back() {
        let effects = Effects {
            relaxation: [0.05, 0.10],
            ..Effects::NONE
        };
        let mut origami = Origami::at(0.0);
        origami.follow(20.0, 1.0, &effects, 1e-6);
        let fresh = pull(&origami, 20.0, &effects);
        origami.follow(20.0, 1.0, &effects, 3_600.0);
        assert!((pull(&origami, 20.0, &effects) / fresh - 0.85).abs() < 1e-3);
        origami.follow(0.0, 1.0, &effects, 3_600.0);
        origami.follow(20.0, 1.0, &effects, 1e-6);
        assert!((pull(&origami, 20.0, &effects) / fresh - 1.0).abs() < 1e-3);
    }

    #[test]
    fn a_damped_origami_opens_later_than_its_thread_is_paid_out() {
        let effects = Effects {
            damping: 0.05,
            ..Effects::NONE
        };
        let mut origami = Origami::at(20.0);
        origami.follow(20.0, 1.0, &effects, 1e-3);
        origami.follow(10.0, 1.0, &effects, 1e-3);
        assert_eq!(pull(&origami, 10.0, &effects), 0.0);
        for _ in 0..10_000 {
            origami.follow(10.0, 1.0, &effects, 1e-3);
        }
        assert!(pull(&origami, 10.0, &effects) > 0.0);
    }

    #[test]
    fn a_crescent_that_snaps_through_gives_way_at_once() {
        let effects = Effects {
            snap_through: 0.15,
            snap_at_mm: [8.0, 12.0, 19.0],
            ..Effects::NONE
        };
        let force = |mm| Origami::elastic_n(mm, 1.0, &effects);
        assert!((force(19.0) / spring::force_n(19.0) - 1.15).abs() < 1e-3);
        assert!((force(19.05) / spring::force_n(19.05) - 1.0).abs() < 1e-3);
        assert!((force(18.3) / spring::force_n(18.3) - 1.0).abs() < 1e-3);
    }
}
