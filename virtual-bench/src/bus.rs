//! Reports accesses to anything that is missing. A register without a model returns the value last stored in it, so
//! firmware that relies on one would pass on the bench and fail on the chip.

use std::fmt;

use rigless::session::Session;

use crate::emulator::{Emulator, Wiring};

/// Addresses without a model that the firmware may access, each with the reason.
const ALLOWED: [(u64, u64, &str); 1] = [(
    0x0800_0000,
    0x0808_0000,
    "the flash array: stores are handled by the bench, not by the emulator's bus",
)];

/// The gaps that a firmware has run into.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BusReport {
    /// One line per gap since the first power-up.
    pub gaps: Vec<String>,
    /// Resets since the first power-up, in order: instant on the bench's clock, ns, and cause.
    pub resets: Vec<(u64, String)>,
}

impl BusReport {
    /// The report of a machine that was powered up at `epoch_ns`; `earlier` covers its previous power-ups.
    pub(crate) fn of<W: Wiring>(
        session: &Session<Emulator<W>>,
        earlier: &Self,
        epoch_ns: u64,
    ) -> Self {
        let allowed = |address: u64| {
            ALLOWED
                .iter()
                .any(|&(first, past, _)| (first..past).contains(&address))
        };
        let emulator = session.board();
        let Self {
            mut gaps,
            mut resets,
        } = earlier.clone();
        let unmapped = session.unmapped();
        let unmapped = unmapped.iter().filter(|gap| !allowed(gap.address));
        gaps.extend(unmapped.map(ToString::to_string));
        let refused = session.refused().iter();
        gaps.extend(
            refused.map(|(address, fault)| format!("refused at {address:#010x}: {fault:?}")),
        );
        let unimplemented = session.unimplemented().iter();
        gaps.extend(unimplemented.map(|(address, gap)| {
            format!(
                "no model behind {} {} at {address:#010x}: {} reads, {} writes, pc {:#010x}",
                gap.instance, gap.register, gap.reads, gap.writes, gap.program_counter
            )
        }));
        let undefined = session.undefined().iter();
        gaps.extend(undefined.map(|(address, gap)| {
            format!(
                "no register in {} at {address:#010x}, pc {:#010x}",
                gap.instance, gap.program_counter
            )
        }));
        let unrouted = session.unrouted().iter();
        gaps.extend(
            unrouted.map(|(instance, line)| format!("no interrupt line {line} for {instance}")),
        );
        gaps.extend(
            session
                .told()
                .map(|told| format!("{} {}: {}", told.instance, told.register, told.reason)),
        );
        let absent = emulator.absent().iter();
        gaps.extend(absent.map(|address| format!("the STM32F411 maps nothing to {address:#010x}")));
        gaps.extend_from_slice(emulator.too_soon());
        gaps.extend_from_slice(emulator.line_mistakes());
        let foreign = emulator.flash_foreign().iter();
        gaps.extend(foreign.map(|address| {
            format!("the flash was changed at {address:#010x}, outside the settings' sectors")
        }));
        if emulator.flash_refused() > 0 {
            gaps.push(format!(
                "{} stores into a flash that was not ready for them",
                emulator.flash_refused()
            ));
        }
        let mut seen = std::collections::HashSet::new();
        gaps.retain(|gap| seen.insert(gap.clone()));
        let since = session.resets().iter();
        resets.extend(since.map(|reset| (epoch_ns + reset.at.0, format!("{:?}", reset.cause))));
        Self { gaps, resets }
    }

    /// Fails if the firmware has accessed something that is missing, or if the number of resets is wrong.
    ///
    /// # Errors
    /// The report as text.
    pub fn check(&self, expected_resets: usize) -> Result<(), String> {
        if self.gaps.is_empty() && self.resets.len() == expected_resets {
            return Ok(());
        }
        Err(format!("{expected_resets} resets were expected\n{self}"))
    }
}

impl fmt::Display for BusReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for gap in &self.gaps {
            writeln!(f, "{gap}")?;
        }
        for (at_ns, cause) in &self.resets {
            writeln!(f, "reset at {:.6} s: {cause}", *at_ns as f64 / 1e9)?;
        }
        Ok(())
    }
}
