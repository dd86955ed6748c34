//! Control's surroundings, on the chip.

use super::{
    channels::{LAST_HEARD_US, TELEMETRY_CHANGED, TELEMETRY_MS, send_event},
    retained, start,
};
use crate::{common::Surroundings, retained::EStop};
use core::sync::atomic::Ordering;
use embassy_time::Instant;
use protocol::system::{Chip, Event, What};

/// Gives a type the [`Surroundings`] of this chip.
pub trait OnChip {}

impl<M: OnChip> Surroundings for M {
    fn now_us(&self) -> u64 {
        Instant::now().as_micros()
    }

    fn chip(&self) -> Chip {
        start::chip()
    }

    fn silence_us(&self) -> u32 {
        // Low 32 bits only: correct up to 71 minutes, then it wraps.
        (self.now_us() as u32).wrapping_sub(LAST_HEARD_US.load(Ordering::Relaxed))
    }

    fn set_telemetry(&mut self, period_ms: u16) {
        TELEMETRY_MS.store(period_ms, Ordering::Relaxed);
        TELEMETRY_CHANGED.signal(());
    }

    fn keep_latched(&mut self, estop: Option<EStop>) {
        retained::keep_latched(estop);
    }

    fn send_event(&mut self, event: &Event) {
        match event.what {
            What::Rig(event) => defmt::info!("{}", event),
            What::Capsule(event) => defmt::info!("{}", event),
            What::Booted(_) | What::Acknowledged | What::LinkLost => {}
        }
        send_event(event);
    }
}
