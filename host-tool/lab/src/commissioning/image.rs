//! What an image file says of itself: its mark, and the fingerprint that the machine calculates over its flash. Neither
//! needs symbols, which an image that is handed out does not have.

use std::path::{Path, PathBuf};

use client::identity::{self, kind_name};
use client::limited;
use device::{fingerprint, mark};
use object::read::elf::{ElfFile32, ProgramHeader as _};
use object::{Endianness, Object as _, ObjectSection as _};
use protocol::system::{DeviceKind, Identity};

/// Flash of the STM32F411RE.
const MOST_BYTES: usize = 512 * 1024;

#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    #[error("{0}")]
    Read(#[from] std::io::Error),
    #[error("{0}")]
    Elf(#[from] object::Error),
    #[error(
        "it is not an image of a machine of version 0.1.0 or later: no section {0} of such a one"
    )]
    NoSection(&'static str),
    #[error(
        "it is not an image of this chip: its code goes from {start:#010x} to {end:#010x}, allowed are 4 to {MOST_BYTES} bytes"
    )]
    Extent { start: u64, end: u64 },
}

/// Path of a machine's image in the folder of this program, where a release has it.
pub fn beside(machine: DeviceKind) -> Option<PathBuf> {
    let own = std::env::current_exe().ok()?;
    let path = own.with_file_name(format!("firmware-{}.elf", kind_name(machine)));
    path.is_file().then_some(path)
}

/// What to do if this program came with another image than runs on the machine; none if it did not.
pub fn to_flash(running: &Identity) -> Option<String> {
    let path = beside(running.device)?;
    let mark = mark(&path).ok()?;
    (mark.revision != running.revision).then(|| {
        let came = identity::revision(&mark.revision);
        let path = path.display();
        format!("firmware {came} came with this tool: `probe-rs download --chip STM32F411RETx {path}` flashes it")
    })
}

/// The mark of the image in this file.
pub fn mark(path: &Path) -> Result<mark::Mark, ImageError> {
    let file = limited::read(path, limited::IMAGE)?;
    let elf = ElfFile32::<Endianness>::parse(&*file)?;
    let section = elf.section_by_name(mark::SECTION);
    let mark = section.and_then(|section| mark::parse(section.data().ok()?));
    mark.ok_or(ImageError::NoSection(mark::SECTION))
}

/// The `image_hash` that the image in this file reports.
pub fn fingerprint(path: &Path) -> Result<u32, ImageError> {
    let file = limited::read(path, limited::IMAGE)?;
    let elf = ElfFile32::<Endianness>::parse(&*file)?;
    let endian = elf.endian();
    // From the code to the initial values of the data, which the linker puts last.
    let code = elf.section_by_name(".text");
    let start = code.ok_or(ImageError::NoSection(".text"))?.address();
    let segments = elf.elf_program_headers().iter();
    let stored = segments.map(|segment| (segment.p_paddr(endian), segment.p_filesz(endian)));
    let ends = stored.filter(|(_, bytes)| *bytes > 0);
    let end = ends
        .map(|(at, bytes)| u64::from(at) + u64::from(bytes))
        .max();
    let end = end.unwrap_or(start);
    // Bytes outside all segments stay erased.
    let mut flash = vec![0xFF; extent(start, end)?];
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

/// Bytes of an image between these addresses. Refuses the sections of another chip's file, which could span gigabytes.
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
