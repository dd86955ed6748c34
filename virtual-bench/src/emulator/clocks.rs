//! The clock tree with an external clock that may start late, or never. The emulator's own oscillators always start.
//!
//! The external clock is a square wave (UM1724 section 6.7.1), not a crystal: it clocks the chip only while the chip's
//! own oscillator is bypassed.

use rigless::device::{Device, DeviceContext, RegisterFile};
use rigless::soc::stm32f427::generated::rcc::{Register, cr};
use rigless::soc::stm32f427::peripherals::rcc::Rcc;
use rigless::time::VirtualNanos;

use super::delegate::delegate;

/// Wraps the clock tree and replaces it on the bus. Hides from it that the firmware has switched on an external clock
/// that is not running yet. Firmware that waits for the clock polls the register: its next read shows the clock.
#[derive(Debug)]
pub(super) struct Clocked {
    pub(super) rcc: Rcc,
    /// When the external clock starts; `None` if it never does.
    from: Option<VirtualNanos>,
    /// The firmware has switched it on, but it is not running yet.
    awaited: bool,
    /// The firmware has switched it on.
    on: bool,
    /// HSEBYP as it was when the firmware switched it on.
    bypassed: bool,
}

impl Clocked {
    pub(super) fn new(rcc: Rcc, from: Option<VirtualNanos>) -> Self {
        Self {
            rcc,
            from,
            awaited: false,
            on: false,
            bypassed: false,
        }
    }

    /// Sets when the external clock starts.
    pub(super) fn set_from(&mut self, from: Option<VirtualNanos>) {
        self.from = from;
    }

    /// Stops the external clock, which the firmware has switched on but not used yet.
    pub(super) fn pause(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        let value = cr::HSEON.set(registers.get(Register::Cr), 0);
        registers.set(Register::Cr, value);
        Device::write(&mut self.rcc, Register::Cr, value, registers, context);
        self.awaited = true;
    }

    /// Whether the firmware has switched the clock on.
    pub(super) fn is_switched_on(&self, registers: &RegisterFile) -> bool {
        self.awaited || cr::HSEON.is_set(registers.get(Register::Cr))
    }

    fn is_there(&self, now: VirtualNanos) -> bool {
        self.bypassed && self.from.is_some_and(|from| from <= now)
    }
}

impl Device for Clocked {
    type Register = Register;

    delegate!(rcc: layout, peek, on_event, on_request, poll, reset_line);

    fn reset(&mut self) {
        Device::reset(&mut self.rcc);
        (self.awaited, self.on, self.bypassed) = (false, false, false);
    }

    fn read(
        &mut self,
        register: Register,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> Option<u64> {
        if register != Register::Cr || !self.awaited {
            return Device::read(&mut self.rcc, register, registers, context);
        }
        if self.is_there(context.now()) {
            self.awaited = false;
            let value = cr::HSEON.set(registers.get(Register::Cr), 1);
            registers.set(Register::Cr, value);
            Device::write(&mut self.rcc, Register::Cr, value, registers, context);
        }
        let read = Device::read(&mut self.rcc, register, registers, context);
        let value = read.unwrap_or_else(|| registers.get(Register::Cr));
        Some(cr::HSEON.set(value, 1))
    }

    fn write(
        &mut self,
        register: Register,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        if register != Register::Cr {
            return Device::write(&mut self.rcc, register, value, registers, context);
        }
        // HSEBYP changes only while the clock is off (RM0383 section 6.3.1).
        if !self.on {
            self.bypassed = cr::HSEBYP.is_set(value);
        }
        self.awaited = cr::HSEON.is_set(value) && !self.is_there(context.now());
        let seen = |value| {
            let value = cr::HSEBYP.set(value, self.bypassed.into());
            if self.awaited {
                cr::HSEON.set(value, 0)
            } else {
                value
            }
        };
        registers.set(Register::Cr, seen(registers.get(Register::Cr)));
        Device::write(&mut self.rcc, register, seen(value), registers, context);
        self.on = self.is_switched_on(registers);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rigless::mcu::Mcu;
    use rigless::soc::stm32f427::Stm32f427;

    /// Writes these values to RCC_CR in turn, a microsecond apart, while a square wave is there from the beginning.
    /// Returns what the firmware reads a microsecond later, and whether the clock runs.
    fn after(writes: &[u64]) -> (u64, bool) {
        let mut part = Stm32f427::new().expect("a part");
        let slot = part.bus().slot("RCC").expect("a clock tree");
        let mut clocked = Clocked::new(std::mem::take(&mut part.rcc), Some(VirtualNanos(0)));
        let mut now_ns = 0;
        for write in writes {
            now_ns += 1_000;
            let (registers, mut context) = part.bus_mut().drive(VirtualNanos(now_ns), slot);
            // As the bus does before it calls the device. HSION stays set.
            registers.write_over_bus(Register::Cr, write | 1);
            clocked.write(Register::Cr, write | 1, registers, &mut context);
        }
        let (registers, mut context) = part.bus_mut().drive(VirtualNanos(now_ns + 1_000), slot);
        let read = clocked.read(Register::Cr, registers, &mut context);
        let stored = registers.get(Register::Cr);
        (read.unwrap_or(stored), cr::HSEON.is_set(stored))
    }

    #[test]
    fn a_square_wave_needs_the_bypass() {
        let (on, bypass) = (cr::HSEON.mask(), cr::HSEBYP.mask());
        for (writes, runs) in [
            (&[bypass, bypass | on][..], true),
            (&[bypass | on], true),
            (&[on], false),
            // Too late: it is on.
            (&[on, bypass | on], false),
            (&[on, 0, bypass | on], true),
            // It stays bypassed until it is switched off.
            (&[bypass | on, on], true),
        ] {
            let (read, does_run) = after(writes);
            assert_eq!(does_run, runs, "{writes:#x?}");
            assert!(cr::HSEON.is_set(read), "{writes:#x?}: switched on");
            assert_eq!(cr::HSEBYP.is_set(read), runs, "{writes:#x?}");
        }
    }
}
