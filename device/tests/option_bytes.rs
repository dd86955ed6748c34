//! The brown-out level in the option bytes of both chips.

use device::option_bytes::{brown_out, stm32l4_brown_out};
use protocol::system::BrownOut;

/// 0x0FFF_AAED is the register's reset value (RM0383 section 3.8.6), as on a new chip.
#[test]
fn the_brown_out_level_is_in_bits_2_and_3() {
    assert_eq!(brown_out(0x0FFF_AAED), BrownOut::Off);
    let levels = [
        BrownOut::Level3,
        BrownOut::Level2,
        BrownOut::Level1,
        BrownOut::Off,
    ];
    for (code, level) in (0_u32..).zip(levels) {
        for others in [0, !0xC, 0x0FFF_AAE1] {
            assert_eq!(brown_out(others | code << 2), level);
        }
    }
}

/// The STM32L4 has more levels. One that lies between two levels of the protocol is reported as the lower one.
#[test]
fn the_stm32l4_has_its_level_in_bits_8_to_10() {
    let levels = [
        BrownOut::Off,
        BrownOut::Off,
        BrownOut::Level1,
        BrownOut::Level2,
        BrownOut::Level3,
    ];
    for (code, level) in (0_u32..).zip(levels) {
        for others in [0, !0x700, 0xFFEF_F8AA] {
            assert_eq!(stm32l4_brown_out(others | code << 8), level);
        }
    }
}
