//! Decodes the chip's option bytes. Never changes them.

use protocol::system::BrownOut;

/// The brown-out level: BOR_LEV, bits 3 and 2 of FLASH_OPTCR (RM0383 section 3.8.6). Chips are delivered with it off.
/// At level 3 the chip stops before the supply gets too low to write the flash.
pub const fn brown_out(option_bytes: u32) -> BrownOut {
    match option_bytes >> 2 & 3 {
        0 => BrownOut::Level3,
        1 => BrownOut::Level2,
        2 => BrownOut::Level1,
        _ => BrownOut::Off,
    }
}

/// The brown-out level of an STM32L4: BOR_LEV, bits 10 to 8 of FLASH_OPTR (RM0394). Its levels are about 1.7, 2.0,
/// 2.2, 2.5 and 2.8 V. Each is reported as the highest STM32F411 level that it reaches.
pub const fn stm32l4_brown_out(option_bytes: u32) -> BrownOut {
    match option_bytes >> 8 & 7 {
        0 | 1 => BrownOut::Off,
        2 => BrownOut::Level1,
        3 => BrownOut::Level2,
        _ => BrownOut::Level3,
    }
}
