//! What the chip's option bytes say. Nothing here changes them.

use protocol::system::BrownOut;

/// The brown-out level: BOR_LEV, bits 3 and 2 of FLASH_OPTCR (RM0383 section 3.8.6). A chip is delivered with it off; at
/// level 3 the flash can be written as long as the chip runs.
pub const fn brown_out(option_bytes: u32) -> BrownOut {
    match option_bytes >> 2 & 3 {
        0 => BrownOut::Level3,
        1 => BrownOut::Level2,
        2 => BrownOut::Level1,
        _ => BrownOut::Off,
    }
}

/// The same of an STM32L4: BOR_LEV, bits 10 to 8 of FLASH_OPTR (RM0394). Its levels are about 1.7, 2.0, 2.2, 2.5 and 2.8 V; each is told
/// as the highest one of the STM32F411's that it reaches.
pub const fn stm32l4_brown_out(option_bytes: u32) -> BrownOut {
    match option_bytes >> 8 & 7 {
        0 | 1 => BrownOut::Off,
        2 => BrownOut::Level1,
        3 => BrownOut::Level2,
        _ => BrownOut::Level3,
    }
}
