//! The clock tree with a clock from outside that may come late, or never. The emulator's own oscillators always come.

use rigless::device::{Device, DeviceContext, RegisterFile};
use rigless::soc::stm32f427::generated::rcc::{Register, cr};
use rigless::soc::stm32f427::peripherals::rcc::Rcc;
use rigless::time::VirtualNanos;

use super::forward::forward;

/// The clock tree. It takes its place on the bus and hides from it that the firmware has switched on an external clock
/// that is not running yet. Firmware that waits for the clock polls: it sees the clock at its next read of the
/// register.
#[derive(Debug)]
pub(super) struct Clocked {
    pub(super) rcc: Rcc,
    /// When the external clock starts; `None` if it never does.
    from: Option<VirtualNanos>,
    /// The firmware has switched it on, but it is not running yet.
    awaited: bool,
}

impl Clocked {
    pub(super) fn new(rcc: Rcc, from: Option<VirtualNanos>) -> Self {
        Self {
            rcc,
            from,
            awaited: false,
        }
    }

    /// Sets when the external clock starts.
    pub(super) fn set_from(&mut self, from: Option<VirtualNanos>) {
        self.from = from;
    }

    /// Whether the firmware has switched the clock on.
    pub(super) fn is_switched_on(&self, registers: &RegisterFile) -> bool {
        self.awaited || cr::HSEON.is_set(registers.get(Register::Cr))
    }

    fn is_there(&self, now: VirtualNanos) -> bool {
        self.from.is_some_and(|from| from <= now)
    }
}

impl Device for Clocked {
    type Register = Register;

    forward!(rcc: layout, peek, on_event, on_request, poll, reset_line);

    fn reset(&mut self) {
        Device::reset(&mut self.rcc);
        self.awaited = false;
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
        let mut value = value;
        if register == Register::Cr {
            self.awaited = cr::HSEON.is_set(value) && !self.is_there(context.now());
            if self.awaited {
                value = cr::HSEON.set(value, 0);
                registers.set(Register::Cr, cr::HSEON.set(registers.get(Register::Cr), 0));
            }
        }
        Device::write(&mut self.rcc, register, value, registers, context);
    }
}
