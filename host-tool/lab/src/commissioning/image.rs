//! The fingerprint of an image file, as the rig calculates it over its flash.

use std::path::Path;

use client::limited;
use device::fingerprint;
use object::read::elf::{ElfFile32, ProgramHeader as _};
use object::{Endianness, Object as _, ObjectSymbol as _};

/// Flash of the STM32F411RE.
const MOST_BYTES: usize = 512 * 1024;

#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    #[error("{0}")]
    Read(#[from] std::io::Error),
    #[error("{0}")]
    Elf(#[from] object::Error),
    #[error("it is not an image of this firmware: no symbol {0}")]
    NoSymbol(&'static str),
    #[error(
        "it is not an image of this chip: its code goes from {start:#010x} to {end:#010x}, allowed are 4 to {MOST_BYTES} bytes"
    )]
    Extent { start: u64, end: u64 },
}

/// The `image_hash` that the image in this file reports.
pub fn fingerprint(path: &Path) -> Result<u32, ImageError> {
    let file = limited::read(path, limited::IMAGE)?;
    let elf = ElfFile32::<Endianness>::parse(&*file)?;
    let symbol = |name: &'static str| {
        elf.symbol_by_name(name)
            .map(|symbol| symbol.address())
            .ok_or(ImageError::NoSymbol(name))
    };
    let start = symbol("__stext")?;
    let data = symbol("__edata")?.saturating_sub(symbol("__sdata")?);
    let end = symbol("__sidata")?.saturating_add(data);
    // Bytes outside all segments stay erased.
    let mut flash = vec![0xFF; extent(start, end)?];
    let endian = elf.endian();
    for segment in elf.elf_program_headers() {
        let begins = u64::from(segment.p_paddr(endian));
        let Ok(bytes) = segment.data(endian, &*file) else {
            continue;
        };
        for (address, byte) in (begins..).zip(bytes) {
            let cell = address
                .checked_sub(start)
                .and_then(|offset| usize::try_from(offset).ok())
                .and_then(|offset| flash.get_mut(offset));
            if let Some(cell) = cell {
                *cell = *byte;
            }
        }
    }
    let words = flash.chunks_exact(4).map(|word| {
        let bytes = [word[0], word[1], word[2], word[3]];
        u32::from_le_bytes(bytes)
    });
    Ok(fingerprint::of(words))
}

/// Bytes of an image between these addresses. Refuses the symbols of another chip's file, which could span gigabytes.
fn extent(start: u64, end: u64) -> Result<usize, ImageError> {
    end.checked_sub(start)
        .and_then(|length| usize::try_from(length).ok())
        .filter(|length| (4..=MOST_BYTES).contains(length))
        .ok_or(ImageError::Extent { start, end })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_fits_this_chip_is_an_image() {
        let start = 0x0800_0000;
        for (end, bytes) in [
            (0x0800_0004, Some(4)),
            (0x0808_0000, Some(MOST_BYTES)),
            (0x0808_0004, None),
            (0xFFFF_FFFC, None),
            (start, None),
            (start - 4, None),
        ] {
            let found = extent(start, end);
            assert_eq!(found.ok(), bytes, "{end:#x}");
        }
    }
}
