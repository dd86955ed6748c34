//! Clocks of peripherals that were just enabled: an access within two cycles of their bus may be lost (ES0287 2.1.6,
//! 2.2.7 in its revision 6). The emulator has no such delay, so the bench reports the access: the image has to have a
//! barrier between the two, or enough instructions.

use rigless::emulator::{Access, AccessKind, Host};
use rigless::soc::Width;

/// RCC_AHB1ENR, RCC_APB1ENR and RCC_APB2ENR (RM0383 section 6.3) with the first block of their bus. Bit n enables the
/// block of 1 KiB number n there.
const BUSES: [(u64, u64); 3] = [
    (0x4002_3830, 0x4002_0000),
    (0x4002_3840, 0x4000_0000),
    (0x4002_3844, 0x4001_0000),
];
/// From this bit of AHB1ENR (DMA1) on, the block's number is the bit's number plus [`DMA_APART`].
const DMA_BIT: u64 = 21;
const DMA_APART: u64 = 3;
/// Instructions that last two cycles of a bus at half the core's clock, with a store in the write buffer before them.
const WINDOW: u64 = 8;
/// Half-words behind the enabling store within which the barrier must follow.
const NEAR: u64 = 8;
/// DSB SY (Armv7-M ARM A7.7.33).
const BARRIER: [u64; 2] = [0xF3BF, 0x8F4F];

/// The clocks that were enabled last, and the accesses that came too soon.
#[derive(Debug, Default)]
pub(super) struct Enabled {
    set: [u64; BUSES.len()],
    /// First bytes of the blocks, and the store that enabled them.
    fresh: Vec<(u64, Access)>,
    pub(super) gaps: Vec<String>,
}

impl Enabled {
    /// A reset disables all clocks again.
    pub(super) fn reset(&mut self) {
        self.set = [0; BUSES.len()];
        self.fresh.clear();
    }

    /// Follows an access of the program.
    pub(super) fn accessed(&mut self, access: &Access, host: &mut dyn Host) {
        let Some(at) = access.program_counter else {
            return;
        };
        self.fresh
            .retain(|(_, store)| access.instruction_count - store.instruction_count <= WINDOW);
        if let Some((_, store)) =
            (self.fresh.iter()).find(|(block, _)| access.address >> 10 == block >> 10)
            && !has_barrier(store.program_counter.unwrap_or(0), at, host)
        {
            self.gaps.push(format!(
                "{:#010x} is accessed {} instructions after its clock was enabled, without a barrier, pc {at:#010x}",
                access.address,
                access.instruction_count - store.instruction_count
            ));
        }
        let place = BUSES
            .iter()
            .position(|(register, _)| *register == access.address);
        if let (Some(place), AccessKind::Write) = (place, access.kind) {
            let risen = access.value & !self.set[place];
            self.set[place] = access.value;
            for bit in (0..32).filter(|bit| risen >> bit & 1 == 1) {
                let apart = if place == 0 && bit >= DMA_BIT {
                    DMA_APART
                } else {
                    0
                };
                self.fresh
                    .push((BUSES[place].1 + ((bit + apart) << 10), *access));
            }
        }
    }
}

/// Whether a barrier follows the store at `from`, before the instruction at `to` if that is near.
fn has_barrier(from: u64, to: u64, host: &mut dyn Host) -> bool {
    let end = from + 2 * NEAR;
    let end = if (from..end).contains(&to) { to } else { end };
    let mut at = |address: u64| host.read(address, Width::W16).unwrap_or(0);
    (from..end)
        .step_by(2)
        .any(|address| [at(address), at(address + 2)] == BARRIER)
}
