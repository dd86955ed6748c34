//! The brown-out level in the option bytes of the chip.

use device::option_bytes::brown_out;
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
