//! The external interrupt controller and the pin selection of SYSCFG (RM0383 chapter 10 and section 7.2), which the
//! emulator does not have.

use rigless::device::{Device, DeviceContext, Level, RegisterFile};
use rigless::soc::stm32f427::generated::{exti, syscfg};

/// Lines that come from pins.
const PIN_LINES: u64 = 0xFFFF;

/// Vectors by their position in the instance's table, and the lines that share each. Position 0 is not for pins.
const VECTORS: [(usize, u64); 7] = [
    (1, 1 << 0),
    (2, 1 << 1),
    (3, 1 << 2),
    (4, 1 << 3),
    (5, 1 << 4),
    (6, 0x03E0),
    (7, 0xFC00),
];

/// The controller. The bench reports edges through [`Exti::edge`], because the emulated pins do not.
#[derive(Debug, Default)]
pub(super) struct Exti {
    pending: u64,
    raised: u64,
}

impl Exti {
    /// The level at the pin that SYSCFG routes to `line` has changed.
    pub(super) fn edge(
        &mut self,
        line: usize,
        high: bool,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let edges = if high {
            registers.get(exti::Register::Rtsr)
        } else {
            registers.get(exti::Register::Ftsr)
        };
        self.pending |= edges & registers.get(exti::Register::Imr) & (1 << line);
        self.settle(registers, context);
    }

    fn settle(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        registers.set(exti::Register::Pr, self.pending);
        let active = self.pending & registers.get(exti::Register::Imr) & PIN_LINES;
        for (position, lines) in VECTORS {
            let wanted = active & lines != 0;
            if (self.raised >> position) & 1 != u64::from(wanted) {
                self.raised ^= 1 << position;
                context.interrupt(position, Level::from(wanted));
            }
        }
    }
}

impl Device for Exti {
    type Register = exti::Register;

    fn write(
        &mut self,
        register: exti::Register,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        match register {
            // Write one to clear. The register file has stored the written word as it is.
            exti::Register::Pr => self.pending &= !value,
            exti::Register::Swier => {
                self.pending |= value & registers.get(exti::Register::Imr);
                registers.set(exti::Register::Swier, 0);
            }
            _ => {}
        }
        self.settle(registers, context);
    }
}

/// The selection registers: plain storage, modelled so that an access does not count as a gap.
#[derive(Debug, Default)]
pub(super) struct Syscfg;

impl Syscfg {
    /// The port (0 = A) which `registers` route to `line`.
    pub(super) fn selected(registers: &RegisterFile, line: usize) -> usize {
        let register = [
            syscfg::Register::Exticr1,
            syscfg::Register::Exticr2,
            syscfg::Register::Exticr3,
            syscfg::Register::Exticr4,
        ][line / 4];
        let code = (registers.get(register) >> (4 * (line % 4))) & 0xF;
        usize::try_from(code).unwrap_or(usize::MAX)
    }
}

impl Device for Syscfg {
    type Register = syscfg::Register;
}
