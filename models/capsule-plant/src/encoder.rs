//! The encoder's two lines as a function of the motor's angle.

use crate::random::Random;

/// The encoder with its defects.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Encoder {
    /// Delay of the four edges of a line, counts.
    phase: [f64; 4],
    /// Quarter of the present line, 0 to 3.
    quarter: u8,
    line: i64,
    /// Levels at which the lines A and B are stuck; none if they are not.
    stuck: [Option<bool>; 2],
    pub(crate) swapped: bool,
    /// Probability that a line is lost, drawn for each new line.
    pub(crate) loses: f64,
    lost: bool,
    random: Random,
}

impl Encoder {
    /// An encoder at angle 0.
    pub(crate) fn new(phase: [f64; 4]) -> Self {
        let mut encoder = Self {
            phase,
            quarter: 0,
            line: 0,
            stuck: [None; 2],
            swapped: false,
            loses: 0.0,
            lost: false,
            random: Random::new(0xE2C0),
        };
        encoder.turn(0.0);
        encoder
    }

    /// Makes these lines stick at their present levels.
    pub(crate) fn stick(&mut self, lines: [bool; 2]) {
        let (a, b) = self.true_levels();
        for ((stuck, wanted), level) in self.stuck.iter_mut().zip(lines).zip([a, b]) {
            *stuck = wanted.then_some(level).or(*stuck);
        }
    }

    /// Turns the motor to this angle, in counts.
    pub(crate) fn turn(&mut self, counts: f64) {
        // A line begins at its first edge, which may come early.
        let from_first = counts - self.phase[0];
        let line = (from_first / 4.0).floor();
        let within = from_first - 4.0 * line;
        let past = |edge: usize| within >= edge as f64 + self.phase[edge] - self.phase[0];
        self.quarter = (1..4).filter(|edge| past(*edge)).count() as u8;
        if line as i64 != self.line {
            self.line = line as i64;
            self.lost = self.loses > 0.0 && self.random.unit() < self.loses;
        }
    }

    fn true_levels(&self) -> (bool, bool) {
        // A lost line keeps the levels between two lines.
        let quarter = if self.lost { 0 } else { self.quarter };
        (quarter == 1 || quarter == 2, quarter == 2 || quarter == 3)
    }

    /// Outputs A and B.
    pub(crate) fn levels(&self) -> (bool, bool) {
        let (mut a, mut b) = self.true_levels();
        if self.swapped {
            (a, b) = (b, a);
        }
        (self.stuck[0].unwrap_or(a), self.stuck[1].unwrap_or(b))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts that TIM2 would make on the way to `to`.
    fn counted(encoder: &mut Encoder, to: f64) -> i64 {
        let quarter = |(a, b)| match (a, b) {
            (false, false) => 0,
            (true, false) => 1,
            (true, true) => 2,
            (false, true) => 3,
        };
        let mut counter = 0;
        let mut before: i64 = quarter(encoder.levels());
        for step in 0..=(to * 20.0) as i64 {
            encoder.turn(step as f64 / 20.0);
            let now = quarter(encoder.levels());
            counter += match (now - before).rem_euclid(4) {
                1 => 1,
                3 => -1,
                _ => 0,
            };
            before = now;
        }
        counter
    }

    #[test]
    fn late_edges_lose_no_count() {
        for phase in [[0.0; 4], [0.3, -0.3, 0.2, -0.1], [-0.3, 0.3, -0.3, 0.3]] {
            let counted = counted(&mut Encoder::new(phase), 400.5);
            assert!((399..=401).contains(&counted), "{counted} with {phase:?}");
        }
    }

    #[test]
    fn a_share_of_the_lines_is_lost() {
        let mut encoder = Encoder::new([0.0; 4]);
        encoder.loses = 0.3;
        let counted = counted(&mut encoder, 40_000.0);
        assert!((27_000..29_000).contains(&counted), "{counted}");
    }
}
