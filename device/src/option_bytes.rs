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
