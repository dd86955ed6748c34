//! Rate and format of the serial port. The emulator passes bytes at any rate and in any frame, so the bench compares
//! the registers with what the host's port is set to, and reports a port that it would not understand.

use rigless::device::RegisterFile;
use rigless::soc::stm32f427::generated::usart6::{Register, cr1, cr2};

/// Rate of the host's port, baud.
const BAUD: u64 = 115_200;
/// Largest deviation, percent. The receiver tolerates 3.3 % (RM0383 section 19.3.5); the rest is for the oscillators of
/// both ends.
const MOST_PERCENT: u64 = 2;

/// Mistakes in the settings of an enabled port with these registers, whose bus runs at `bus_hz`.
pub(super) fn mistake(registers: &RegisterFile, bus_hz: u64) -> Option<String> {
    let [control, stops] = [Register::Cr1, Register::Cr2].map(|register| registers.get(register));
    if !cr1::UE.is_set(control) {
        return None;
    }
    let baud = baud(
        bus_hz,
        registers.get(Register::Brr),
        cr1::OVER8.is_set(control),
    );
    if 100 * baud.abs_diff(BAUD) > MOST_PERCENT * BAUD {
        return Some(format!("USART2 is set to {baud} baud, not to {BAUD}"));
    }
    let is_8n1 = !cr1::M.is_set(control) && !cr1::PCE.is_set(control) && cr2::STOP.get(stops) == 0;
    (!is_8n1).then(|| format!("USART2 is not set to 8N1: CR1 {control:#x}, CR2 {stops:#x}"))
}

/// The rate that BRR sets (section 19.3.4): its fraction has four bits, or three when each bit is sampled eight times.
fn baud(bus_hz: u64, divider: u64, over_8: bool) -> u64 {
    let samples = if over_8 {
        (divider >> 4) * 8 + (divider & 7)
    } else {
        divider
    };
    bus_hz.checked_div(samples).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rigless::soc::stm32f427::Stm32f427;

    #[test]
    fn a_port_that_the_host_does_not_understand_is_named() {
        let mut part = Stm32f427::new().expect("a part");
        let (_, registers) = part.serial_port(1);
        let on = cr1::UE.mask();
        let mut found = |bus_hz, divider, control, stops| {
            registers.set(Register::Brr, divider);
            registers.set(Register::Cr1, control);
            registers.set(Register::Cr2, stops);
            mistake(registers, bus_hz)
        };
        // The rig's and the capsule's.
        assert_eq!(found(50_000_000, 434, on, 0), None);
        assert_eq!(found(16_000_000, 139, on, 0), None);
        // 16 MHz / 8 / 17.375.
        assert_eq!(
            found(16_000_000, 17 << 4 | 3, on | cr1::OVER8.mask(), 0),
            None
        );
        assert_eq!(found(50_000_000, 434, 0, 0), None);
        let half = "USART2 is set to 57603 baud, not to 115200";
        assert_eq!(found(25_000_000, 434, on, 0).as_deref(), Some(half));
        // 2.1 % too fast, and a port without a divider.
        assert!(found(50_000_000, 425, on, 0).is_some());
        assert!(found(50_000_000, 0, on, 0).is_some());
        for (control, stops) in [
            (cr1::M.mask(), 0),
            (cr1::PCE.mask(), 0),
            (0, cr2::STOP.set(0, 2)),
        ] {
            let found = found(50_000_000, 434, on | control, stops).expect("not 8N1");
            assert!(found.starts_with("USART2 is not set to 8N1"), "{found}");
        }
    }
}
