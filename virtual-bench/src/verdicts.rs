//! Judges a run by its step edges only, with its own 128-bit integer arithmetic and no code of the firmware.
//!
//! A stroke of `n` steps in `T` ticks with ramps of `r` ticks is the symmetric trapezoid from rest to rest. Step `k` is
//! due when the position is `k`:
//!
//! ```text
//! acceleration  t = sqrt(k C)             C = 2 r (T - r) / n, while t <= r
//! cruise        t = r/2 + k (T - r) / n
//! deceleration  t = T - sqrt((n - k) C)
//! ```
//!
//! All strokes of a run share one time axis with one origin.

use std::fmt;

use crate::pins::EdgeLog;

/// Ticks of the step timer per second.
pub const TICK_HZ: u64 = 100_000_000;
/// One tick, ns.
pub const TICK_NS: u64 = 10;
/// Resolution of the exact instants, parts per tick.
const PARTS: u128 = 1_000;

/// One stroke.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stroke {
    pub steps: u64,
    pub duration_ticks: u64,
    /// Duration of each ramp, ticks.
    pub ramp_ticks: u64,
}

impl Stroke {
    /// The stroke of `steps` in `duration_ticks` with the shortest ramp whose acceleration is at most `accel` steps/s2;
    /// `None` if even the triangle needs more acceleration.
    #[must_use]
    pub fn within(steps: u64, duration_ticks: u64, accel: u64) -> Option<Self> {
        let wanted = u128::from(steps) * u128::from(TICK_HZ) * u128::from(TICK_HZ);
        let enough = |ramp: u64| {
            let area = u128::from(ramp) * u128::from(duration_ticks - ramp);
            area * u128::from(accel) >= wanted
        };
        let (mut low, mut high) = (1, duration_ticks / 2);
        if high == 0 || !enough(high) {
            return None;
        }
        while low < high {
            let middle = low + (high - low) / 2;
            if enough(middle) {
                high = middle;
            } else {
                low = middle + 1;
            }
        }
        Some(Self {
            steps,
            duration_ticks,
            ramp_ticks: low,
        })
    }

    /// The exact instant of step `k` (1 to `steps`) from the stroke's start, in thousandths of a tick, rounded down.
    #[must_use]
    pub fn instant(&self, k: u64) -> u128 {
        let (n, duration) = (u128::from(self.steps), u128::from(self.duration_ticks));
        let (ramp, k) = (u128::from(self.ramp_ticks), u128::from(k));
        // C n, in ticks squared; a ramp covers r / (2 (T - r)) of the n steps.
        let square = 2 * ramp * (duration - ramp);
        let root = |steps: u128| (steps * square * PARTS * PARTS / n).isqrt();
        if 2 * (duration - ramp) * k <= ramp * n {
            root(k)
        } else if 2 * (duration - ramp) * (n - k) <= ramp * n {
            duration * PARTS - root(n - k)
        } else {
            PARTS * ramp / 2 + k * (duration - ramp) * PARTS / n
        }
    }
}

/// A run: `cycles` times away from home and back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    pub cycles: u32,
    /// Away from home.
    pub forward: Stroke,
    /// Towards home.
    pub back: Stroke,
    /// Rest at the far end, ticks.
    pub far_dwell_ticks: u64,
    /// Rest at home between cycles, ticks.
    pub home_dwell_ticks: u64,
}

impl Run {
    /// The paper's run on the default axis: 5 cycles of 130 mm in 40 s, 800 steps/mm, 100 mm/s2.
    ///
    /// # Panics
    /// Never: the run is feasible.
    #[must_use]
    pub fn paper() -> Self {
        let stroke = Stroke::within(104_000, 4 * TICK_HZ, 80_000).expect("feasible");
        Self {
            cycles: 5,
            forward: stroke,
            back: stroke,
            far_dwell_ticks: 0,
            home_dwell_ticks: 0,
        }
    }

    /// Every edge: its exact instant in thousandths of a tick from the first stroke's start, and whether it is away
    /// from home.
    pub fn edges(&self) -> impl Iterator<Item = (u128, bool)> + '_ {
        let mut start = 0;
        (0..2 * self.cycles).flat_map(move |stroke| {
            let away = stroke % 2 == 0;
            let (shape, dwell) = if away {
                (self.forward, self.far_dwell_ticks)
            } else {
                (self.back, self.home_dwell_ticks)
            };
            let origin = start;
            start += u128::from(shape.duration_ticks + dwell) * PARTS;
            (1..=shape.steps).map(move |k| (origin + shape.instant(k), away))
        })
    }

    /// Time from the first stroke's start to the last edge, ticks.
    #[must_use]
    pub fn ticks(&self) -> u64 {
        let cycle = self.forward.duration_ticks + self.far_dwell_ticks + self.back.duration_ticks;
        u64::from(self.cycles) * (cycle + self.home_dwell_ticks) - self.home_dwell_ticks
    }
}

/// The result of judging a run by its edges.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// Edges on the pin, and edges of the exact run.
    pub edges: (u64, u64),
    /// Edges in the wrong direction.
    pub wrong_direction: u64,
    /// Strokes: changes of direction plus one.
    pub strokes: u32,
    /// Largest deviation of an edge from the exact profile, ns, and the number of that edge. Time begins at the tick
    /// nearest to the first edge.
    pub worst: (f64, u64),
    /// Time from the first stroke's start to the last edge, ns, measured on the pin.
    pub duration_ns: u64,
    /// Time of the exact run from the first stroke's start to the last edge, ns.
    pub exact_ns: u64,
    /// Extreme positions by the edges, steps from the start of the run.
    pub extremes: (i64, i64),
    /// Final position by the edges, steps from the start of the run.
    pub end: i64,
}

impl Verdict {
    /// Compares `edges` with `run`.
    #[must_use]
    pub fn of(run: &Run, edges: &EdgeLog) -> Self {
        let first = run.edges().next().map_or(0, |(instant, _)| instant);
        let first_tick = (first + PARTS / 2) / PARTS;
        let origin = edges.iter().next().map_or(0, |edge| {
            i128::from(edge.at_ns) - (first_tick * u128::from(TICK_NS)) as i128
        });
        let mut verdict = Self {
            edges: (edges.len() as u64, run.edges().count() as u64),
            wrong_direction: 0,
            strokes: 0,
            worst: (0.0, 0),
            duration_ns: 0,
            exact_ns: run.ticks() * TICK_NS,
            extremes: (0, 0),
            end: 0,
        };
        let mut heading = None;
        let mut worst_parts = 0;
        for (number, (edge, (exact, away))) in edges.iter().zip(run.edges()).enumerate() {
            let is_parts =
                (i128::from(edge.at_ns) - origin) * (PARTS as i128) / i128::from(TICK_NS);
            let off = is_parts.abs_diff(exact as i128);
            if off > worst_parts {
                worst_parts = off;
                verdict.worst = (off as f64 * TICK_NS as f64 / PARTS as f64, number as u64);
            }
            verdict.wrong_direction += u64::from(edge.away != away);
        }
        for edge in edges.iter() {
            if heading.replace(edge.away) != Some(edge.away) {
                verdict.strokes += 1;
            }
            verdict.end += if edge.away { 1 } else { -1 };
            let (low, high) = verdict.extremes;
            verdict.extremes = (low.min(verdict.end), high.max(verdict.end));
            verdict.duration_ns = (i128::from(edge.at_ns) - origin) as u64;
        }
        verdict
    }

    /// Fails unless every edge is there, in the right direction and within `limit_ns` of the exact profile.
    ///
    /// # Errors
    /// The verdict as text.
    pub fn check(&self, limit_ns: f64) -> Result<(), String> {
        let there = self.edges.0 == self.edges.1 && self.wrong_direction == 0;
        if there && self.worst.0 <= limit_ns {
            return Ok(());
        }
        Err(self.to_string())
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "edges             {} of {}", self.edges.0, self.edges.1)?;
        writeln!(f, "strokes           {}", self.strokes)?;
        writeln!(f, "wrong direction   {}", self.wrong_direction)?;
        writeln!(
            f,
            "worst edge        {:.2} ns off (edge {})",
            self.worst.0, self.worst.1
        )?;
        writeln!(
            f,
            "duration          {} ns, exactly {} ns",
            self.duration_ns, self.exact_ns
        )?;
        write!(
            f,
            "positions         {}..={} steps, ends at {}",
            self.extremes.0, self.extremes.1, self.end
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pins::StepEdge;

    fn rounded(run: &Run, origin_ns: u64) -> Vec<StepEdge> {
        let edges = run.edges().map(|(parts, away)| StepEdge {
            at_ns: origin_ns + ((parts + PARTS / 2) / PARTS) as u64 * TICK_NS,
            away,
        });
        edges.collect()
    }

    fn short() -> Run {
        let stroke = Stroke::within(800, TICK_HZ / 2, 20_000).expect("feasible");
        Run {
            cycles: 2,
            forward: stroke,
            back: stroke,
            far_dwell_ticks: 1_000_000,
            home_dwell_ticks: 2_000_000,
        }
    }

    #[test]
    fn the_papers_run_is_a_million_edges_in_forty_seconds() {
        let run = Run::paper();
        assert_eq!(run.ticks(), 40 * TICK_HZ);
        assert_eq!(run.edges().count(), 1_040_000);
        let (last, away) = run.edges().last().expect("edges");
        assert_eq!((last, away), (40 * u128::from(TICK_HZ) * PARTS, false));
        // 100 mm/s2 needs a ramp of 35.68 mm/s / 100 mm/s2.
        assert!((35_600_000..35_750_000).contains(&run.forward.ramp_ticks));
        let shorter = u128::from(run.forward.ramp_ticks - 1);
        assert!(shorter * (400_000_000 - shorter) * 80_000 < 104_000 * 10_u128.pow(16));
    }

    #[test]
    fn instants_rise_and_mirror() {
        let stroke = Stroke::within(5_000, 60_000_000, 80_000).expect("feasible");
        let whole = u128::from(stroke.duration_ticks) * PARTS;
        let mut before = 0;
        for k in 1..=stroke.steps {
            let instant = stroke.instant(k);
            assert!(instant > before, "step {k}");
            before = instant;
            if k < stroke.steps {
                let mirrored = whole - stroke.instant(stroke.steps - k);
                assert!(
                    mirrored.abs_diff(instant) <= 2,
                    "step {k}: {mirrored} {instant}"
                );
            }
        }
        assert_eq!(before, whole);
    }

    #[test]
    fn edges_on_the_nearest_tick_are_half_a_tick_off_at_most() {
        let run = short();
        let log = rounded(&run, 12_345_670).into_iter().collect();
        let verdict = Verdict::of(&run, &log);
        assert!(verdict.worst.0 <= 5.01, "{verdict}");
        assert_eq!(verdict.strokes, 4);
        assert_eq!((verdict.extremes, verdict.end), ((0, 800), 0));
        assert_eq!(verdict.duration_ns, run.ticks() * TICK_NS);
        assert!(verdict.check(10.0).is_ok());
    }

    #[test]
    fn a_missing_a_late_and_a_reversed_edge_are_seen() {
        let run = short();
        let sound = rounded(&run, 0);
        let mut missing = sound.clone();
        missing.remove(1_000);
        let mut late = sound.clone();
        late[1_000].at_ns += 20;
        let mut reversed = sound.clone();
        reversed[1_000].away = !reversed[1_000].away;
        for (edges, what) in [(missing, "missing"), (late, "late"), (reversed, "reversed")] {
            let verdict = Verdict::of(&run, &edges.into_iter().collect());
            assert!(verdict.check(10.0).is_err(), "{what}: {verdict}");
        }
    }

    #[test]
    fn drift_shows_although_every_interval_is_right() {
        let run = short();
        let mut edges = rounded(&run, 0);
        let half = edges.len() / 2;
        edges[half..].iter_mut().for_each(|edge| edge.at_ns += 30);
        let verdict = Verdict::of(&run, &edges.into_iter().collect());
        assert!(verdict.worst.0 > 20.0, "{verdict}");
    }

    #[test]
    fn what_cannot_be_done_gently_enough_is_no_stroke() {
        assert_eq!(Stroke::within(104_000, 4 * TICK_HZ, 25_999), None);
        assert!(Stroke::within(104_000, 4 * TICK_HZ, 26_000).is_some());
    }
}
