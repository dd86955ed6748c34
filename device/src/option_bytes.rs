//! What the chip's option bytes say. Nothing here changes them.

/// Below which supply the chip keeps itself in reset (DS10314 table 19, falling).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BrownOut {
    /// Never; only the power-on reset acts, at 1.60 to 1.76 V. What a chip is delivered with.
    Off,
    /// 2.13 to 2.24 V.
    Level1,
    /// 2.44 to 2.56 V.
    Level2,
    /// 2.75 to 2.88 V: the level at which the flash can be written as long as the chip runs.
    Level3,
}

/// Who can read the flash from outside.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReadProtection {
    /// Everybody.
    None,
    /// Nobody; the way back erases the flash.
    Level1,
    /// Nobody, and no debugger either, for ever.
    Level2,
}

/// The register that shows the option bytes (FLASH_OPTCR, RM0383 section 3.8.6).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OptionBytes(pub u32);

impl OptionBytes {
    /// BOR_LEV, bits 3 and 2.
    pub const fn brown_out(self) -> BrownOut {
        match self.0 >> 2 & 3 {
            0 => BrownOut::Level3,
            1 => BrownOut::Level2,
            2 => BrownOut::Level1,
            _ => BrownOut::Off,
        }
    }

    /// WDG_SW, bit 5, is clear: the watchdog runs from the reset on.
    pub const fn watchdog_by_hardware(self) -> bool {
        self.0 >> 5 & 1 == 0
    }

    /// RDP, bits 15 to 8.
    pub const fn read_protection(self) -> ReadProtection {
        match self.0 >> 8 & 0xFF {
            0xAA => ReadProtection::None,
            0xCC => ReadProtection::Level2,
            _ => ReadProtection::Level1,
        }
    }

    /// One bit per sector that cannot be written or erased: nWRP, bits 23 to 16, where 0 protects. Means something else
    /// while bit 31 (SPRMOD) is set: sectors that cannot be read, where 1 protects; they cannot be written either.
    pub const fn protected_sectors(self) -> u8 {
        let bits = (self.0 >> 16) as u8;
        if self.0 >> 31 == 1 { bits } else { !bits }
    }
}
