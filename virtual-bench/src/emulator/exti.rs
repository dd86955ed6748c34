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
    /// Lines that software has triggered and that were not cleared since: SWIER.
    triggered: u64,
}

impl Exti {
    /// The level at the pin that SYSCFG routes to `line` has changed. A masked line becomes pending too (RM0383
    /// section 10.3.6): it interrupts as soon as it is unmasked.
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
        self.pending |= edges & (1 << line);
        self.settle(registers, context);
    }

    fn settle(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        registers.set(exti::Register::Pr, self.pending);
        registers.set(exti::Register::Swier, self.triggered);
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
            exti::Register::Pr => {
                self.pending &= !value;
                self.triggered &= !value;
            }
            // A bit that changes from 0 to 1 triggers its line, unless that is masked. It stays set until the line is
            // cleared (section 10.3.5).
            exti::Register::Swier => {
                self.pending |= value & !self.triggered & registers.get(exti::Register::Imr);
                self.triggered = value;
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

#[cfg(test)]
mod tests {
    use super::*;
    use exti::Register::{Imr, Pr, Rtsr, Swier};
    use rigless::mcu::Mcu;
    use rigless::soc::stm32f427::Stm32f427;
    use rigless::time::VirtualNanos;

    /// The controller with line 6 sensitive to rising edges, and the part on whose bus it is.
    struct Lines(Stm32f427, Exti);

    impl Lines {
        const LINE: usize = 6;

        fn new() -> Self {
            let mut lines = Self(Stm32f427::new().expect("a part"), Exti::default());
            lines.write(Rtsr, 1 << Self::LINE);
            lines
        }

        fn on_bus<T>(
            &mut self,
            act: impl FnOnce(&mut Exti, &mut RegisterFile, &mut DeviceContext<'_>) -> T,
        ) -> T {
            let slot = self.0.bus().slot("EXTI").expect("a controller");
            let (registers, mut context) = self.0.bus_mut().drive(VirtualNanos(0), slot);
            act(&mut self.1, registers, &mut context)
        }

        fn write(&mut self, register: exti::Register, value: u64) {
            self.on_bus(|exti, registers, context| {
                // As the bus does before it calls the device.
                registers.write_over_bus(register, value);
                exti.write(register, value, registers, context);
            });
        }

        fn edge(&mut self, high: bool) {
            self.on_bus(|exti, registers, context| {
                exti.edge(Self::LINE, high, registers, context);
            });
        }

        /// Whether the line's bit in `register` is set.
        fn shows(&mut self, register: exti::Register) -> bool {
            self.on_bus(|_, registers, _| registers.get(register) >> Self::LINE & 1 == 1)
        }

        fn interrupts(&self) -> bool {
            self.1.raised != 0
        }
    }

    #[test]
    fn an_edge_on_a_masked_line_waits_until_it_is_unmasked() {
        let mut lines = Lines::new();
        lines.edge(false);
        assert!(!lines.shows(Pr), "that edge is not selected");
        lines.edge(true);
        assert!(lines.shows(Pr) && !lines.interrupts());
        lines.write(Imr, 1 << Lines::LINE);
        assert!(lines.interrupts());
        lines.write(Pr, 1 << Lines::LINE);
        assert!(!lines.shows(Pr) && !lines.interrupts());
    }

    #[test]
    fn software_triggers_an_unmasked_line_once_until_it_is_cleared() {
        let mut lines = Lines::new();
        lines.write(Swier, 1 << Lines::LINE);
        assert!(lines.shows(Swier) && !lines.shows(Pr), "it is masked");
        lines.write(Imr, 1 << Lines::LINE);
        lines.write(Swier, 1 << Lines::LINE);
        assert!(!lines.shows(Pr), "the bit was set already");
        lines.write(Pr, 1 << Lines::LINE);
        assert!(!lines.shows(Swier));
        lines.write(Swier, 1 << Lines::LINE);
        assert!(lines.shows(Pr) && lines.interrupts());
    }
}
