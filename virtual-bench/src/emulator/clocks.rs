//! The clock tree with a clock from outside that may be missing. The emulator's own oscillators always come.

use rigless::device::{Device, DeviceContext, RegisterFile};
use rigless::soc::stm32f427::generated::rcc::{Register, cr};
use rigless::soc::stm32f427::peripherals::rcc::Rcc;

use super::forward::forward;

/// The clock tree. It takes its place on the bus, and keeps from it that the firmware switches a missing clock on.
#[derive(Debug)]
pub(super) struct Clocked {
    pub(super) rcc: Rcc,
    has_hse: bool,
}

impl Clocked {
    pub(super) fn new(rcc: Rcc, has_hse: bool) -> Self {
        Self { rcc, has_hse }
    }

    /// Whether the clock comes when it is switched on the next time.
    pub(super) fn set_present(&mut self, has_hse: bool) {
        self.has_hse = has_hse;
    }
}

impl Device for Clocked {
    type Register = Register;

    forward!(rcc: layout, read, peek, on_event, on_request, poll, reset, reset_line);

    fn write(
        &mut self,
        register: Register,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let mut value = value;
        if register == Register::Cr && !self.has_hse {
            value = cr::HSEON.set(value, 0);
            registers.set(Register::Cr, cr::HSEON.set(registers.get(Register::Cr), 0));
        }
        Device::write(&mut self.rcc, register, value, registers, context);
    }
}
