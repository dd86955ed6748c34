//! A jumper from STEP to an input of the chip, and its faults.

/// Faults of a jumper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Connect it (or cut it).
    Whole(bool),
    /// Inject a high pulse of this width, ns.
    Spike(u64),
    /// Delay the next pulse by this much, ns; must be less than the pulse's length.
    Delay(u64),
    /// Drop the next pulse.
    Skip,
    /// Delay each pulse from now on by 0 or by this much, ns, at random: the effect of a slow edge and a sampled input
    /// on equal intervals. 0 ends it.
    Jitter(u64),
    /// Lose the next pulse's captured instant: DMA fetches it only after the following one has overwritten it.
    Lose,
}

/// State of a fault that keeps a captured instant from DMA.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Keeping {
    /// Nothing.
    #[default]
    Nothing,
    /// DMA will be kept from the next pulse's instant.
    Next,
    /// DMA is kept from this instant, until the following pulse.
    First,
    /// The following pulse has come.
    Second,
}

/// The jumper.
#[derive(Clone, Copy, Debug)]
pub struct Wire {
    whole: bool,
    spike_until_ns: Option<u64>,
    /// Fault of the next pulse.
    fault: Option<Fault>,
    /// Delay of the pulse in progress.
    delay_ns: u64,
    jitter_ns: u64,
    dice: u64,
    keeping: Keeping,
    /// The level of STEP at the far end of the wire.
    high: bool,
}

impl Wire {
    /// A jumper that is fitted (`whole`) or missing.
    #[must_use]
    pub fn new(whole: bool) -> Self {
        Self {
            whole,
            spike_until_ns: None,
            fault: None,
            delay_ns: 0,
            jitter_ns: 0,
            dice: 0x9E37_79B9_7F4A_7C15,
            keeping: Keeping::Nothing,
            high: false,
        }
    }

    /// Whether DMA is kept from the instants captured now.
    #[must_use]
    pub fn keeps_from_dma(&self) -> bool {
        matches!(self.keeping, Keeping::First | Keeping::Second)
    }

    /// Returns either 0 or the full jitter, at random.
    fn jitter_ns(&mut self) -> u64 {
        self.dice ^= self.dice << 13;
        self.dice ^= self.dice >> 7;
        self.dice ^= self.dice << 17;
        self.jitter_ns * (self.dice & 1)
    }

    /// Applies `fault` now.
    pub fn act(&mut self, fault: Fault, at_ns: u64) {
        match fault {
            Fault::Whole(whole) => {
                self.whole = whole;
                self.high &= whole;
            }
            Fault::Spike(width_ns) => self.spike_until_ns = Some(at_ns + width_ns),
            Fault::Delay(_) | Fault::Skip => self.fault = Some(fault),
            Fault::Jitter(ns) => self.jitter_ns = ns,
            Fault::Lose => self.keeping = Keeping::Next,
        }
    }

    /// Handles a change of STEP. Returns when it arrives, ns, if it does.
    pub fn step(&mut self, high: bool, at_ns: u64) -> Option<u64> {
        let comes = if high {
            let fault = self.fault.take();
            self.delay_ns = match fault {
                Some(Fault::Delay(ns)) => ns,
                _ => self.jitter_ns(),
            };
            self.keeping = match self.keeping {
                Keeping::Next => Keeping::First,
                Keeping::First => Keeping::Second,
                after => after,
            };
            self.whole && fault != Some(Fault::Skip)
        } else {
            if self.keeping == Keeping::Second {
                self.keeping = Keeping::Nothing;
            }
            self.high
        };
        self.high = high && comes;
        (comes && self.spike_until_ns.is_none()).then_some(at_ns + self.delay_ns)
    }

    /// Whether it conducts; `None` if something other than STEP may change its output.
    #[must_use]
    pub fn leads(&self) -> Option<bool> {
        let plain = self.fault.is_none()
            && self.spike_until_ns.is_none()
            && self.delay_ns == 0
            && self.jitter_ns == 0
            && self.keeping == Keeping::Nothing;
        plain.then_some(self.whole)
    }

    /// Advances to `now_ns`.
    pub fn advance(&mut self, now_ns: u64) {
        self.spike_until_ns = self.spike_until_ns.filter(|&until_ns| now_ns < until_ns);
    }

    /// When its output next changes without STEP, ns.
    #[must_use]
    pub fn next_ns(&self) -> Option<u64> {
        self.spike_until_ns
    }

    /// The level at its output.
    #[must_use]
    pub fn is_high(&self) -> bool {
        self.high || self.spike_until_ns.is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pulse(wire: &mut Wire, at_ns: u64) -> (Option<u64>, Option<u64>) {
        let rose_ns = wire.step(true, at_ns);
        (rose_ns, wire.step(false, at_ns + 2_000))
    }

    #[test]
    fn a_pulse_comes_through_or_later_or_not_at_all() {
        let mut wire = Wire::new(true);
        assert_eq!(pulse(&mut wire, 10_000), (Some(10_000), Some(12_000)));
        wire.act(Fault::Delay(20), 13_000);
        assert_eq!(pulse(&mut wire, 20_000), (Some(20_020), Some(22_020)));
        // During a pulse, a fault applies to the next one.
        wire.step(true, 23_000);
        wire.act(Fault::Delay(20), 23_000);
        assert_eq!(wire.step(false, 25_000), Some(25_000));
        assert_eq!(pulse(&mut wire, 26_000), (Some(26_020), Some(28_020)));
        wire.act(Fault::Skip, 23_000);
        assert_eq!(pulse(&mut wire, 30_000), (None, None));
        assert_eq!(pulse(&mut wire, 40_000), (Some(40_000), Some(42_000)));
        wire.act(Fault::Whole(false), 43_000);
        assert_eq!(pulse(&mut wire, 50_000), (None, None));
    }

    #[test]
    fn jitter_comes_by_nothing_or_by_all_of_it() {
        let mut wire = Wire::new(true);
        wire.act(Fault::Jitter(10), 0);
        let mut by = [0, 0];
        for n in 0..1_000 {
            let (rose_ns, fell_ns) = pulse(&mut wire, n * 10_000);
            let late = rose_ns.expect("it comes") - n * 10_000;
            assert_eq!(fell_ns, Some(n * 10_000 + 2_000 + late));
            by[usize::from(late == 10)] += 1;
            assert!(late == 0 || late == 10);
        }
        assert!(by.iter().all(|count| *count > 400), "{by:?}");
    }

    #[test]
    fn a_lost_instant_is_kept_until_the_next_pulse_is_over() {
        let mut wire = Wire::new(true);
        wire.act(Fault::Lose, 0);
        let mut kept = vec![];
        for n in 0..3 {
            for high in [true, false] {
                wire.step(high, n * 10_000 + u64::from(!high) * 2_000);
                kept.push(wire.keeps_from_dma());
            }
        }
        assert_eq!(kept, [true, true, true, false, false, false]);
    }

    #[test]
    fn it_leads_plainly_unless_something_is_wrong_with_it() {
        for whole in [true, false] {
            assert_eq!(Wire::new(whole).leads(), Some(whole));
        }
        let faults = [
            Fault::Spike(100),
            Fault::Delay(10),
            Fault::Skip,
            Fault::Jitter(10),
            Fault::Lose,
        ];
        for fault in faults {
            let mut wire = Wire::new(true);
            wire.act(fault, 0);
            assert_eq!(wire.leads(), None, "{fault:?}");
        }
        // DMA is blocked until the pulse after the lost one is over.
        let mut wire = Wire::new(true);
        wire.act(Fault::Lose, 0);
        for (high, leads) in [
            (true, None),
            (false, None),
            (true, None),
            (false, Some(true)),
        ] {
            wire.step(high, 1_000);
            assert_eq!(wire.leads(), leads);
        }
    }

    #[test]
    fn a_cut_within_a_pulse_ends_it() {
        let mut wire = Wire::new(true);
        wire.step(true, 1_000);
        assert!(wire.is_high());
        wire.act(Fault::Whole(false), 1_500);
        assert!(!wire.is_high());
        assert_eq!(wire.step(false, 3_000), None);
    }

    #[test]
    fn a_spike_ends_by_itself() {
        let mut wire = Wire::new(true);
        wire.act(Fault::Spike(250), 1_000);
        assert_eq!((wire.is_high(), wire.next_ns()), (true, Some(1_250)));
        wire.advance(1_249);
        assert!(wire.is_high());
        wire.advance(1_250);
        assert_eq!((wire.is_high(), wire.next_ns()), (false, None));
    }
}
