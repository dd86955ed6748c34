//! Checks an image before it is flashed: it must be an ELF file for this chip and this machine, and leave the settings
//! alone.

use std::path::Path;

use client::identity::kind_name;
use client::limited;
use object::read::elf::{ElfFile32, FileHeader as _, ProgramHeader as _};
use object::{Endianness, Object as _, ObjectSymbol as _, elf};
use protocol::system::DeviceKind;

use crate::commissioning::image::{self, ImageError};

/// Flash of the STM32F411RE.
const FLASH: std::ops::Range<u64> = 0x0800_0000..0x0808_0000;
/// The part of it that keeps settings, name and calibration and is never part of an image.
const KEPT: std::ops::Range<u64> = 0x0800_4000..0x0801_0000;
/// RAM, with the last address of a full descending stack.
const RAM: std::ops::RangeInclusive<u64> = 0x2000_0000..=0x2002_0000;

/// Why a file cannot be flashed.
#[derive(Debug, thiserror::Error)]
pub enum Unfit {
    /// It cannot be read.
    #[error("{0}")]
    Read(std::io::Error),
    /// It is not an ELF file of 32 bits.
    #[error("it is no ELF file of a microcontroller ({0})")]
    NoElf(object::Error),
    /// It is a program for another processor.
    #[error(
        "it is a program for another processor (ELF machine {machine}, type {kind}), not an image for an Arm Cortex-M"
    )]
    OtherProcessor {
        /// `e_machine` of its header.
        machine: u16,
        /// `e_type` of its header.
        kind: u16,
    },
    /// It has nothing to flash.
    #[error("it has nothing to flash")]
    Empty,
    /// A part of it lies outside the flash, or where the settings are.
    #[error("its part from {start:#010x} to {end:#010x} lies {place}")]
    Place {
        /// First address.
        start: u64,
        /// Address behind the last one.
        end: u64,
        /// Where that is.
        place: &'static str,
    },
    /// Its vector table does not fit this chip.
    #[error("its vector table cannot start this chip: stack {stack:#010x}, reset {reset:#010x}")]
    Vectors {
        /// Initial stack pointer.
        stack: u32,
        /// Address of the first instruction.
        reset: u32,
    },
    /// It is for the other machine.
    #[error("it is the image of the {found}, not of the {wanted}", found = kind_name(*found), wanted = kind_name(*wanted))]
    OtherMachine {
        /// The machine to flash.
        wanted: DeviceKind,
        /// The machine it is for.
        found: DeviceKind,
    },
    /// It does not show which machine it is for.
    #[error(
        "it is neither the image of the rig nor that of the capsule, or its symbols were removed"
    )]
    Unknown,
    /// The linker's names are missing.
    #[error("{0}")]
    Image(ImageError),
}

/// An image that can be flashed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Image {
    /// Bytes of flash that it fills.
    pub bytes: u64,
    /// Fingerprint; the machine that runs the image reports it as `image_hash`.
    pub fingerprint: u32,
}

/// Checks a file that is to be flashed to a machine.
///
/// # Errors
/// [`Unfit`].
pub fn inspect(path: &Path, wanted: DeviceKind) -> Result<Image, Unfit> {
    let file = limited::read(path, limited::IMAGE).map_err(Unfit::Read)?;
    let parsed = ElfFile32::<Endianness>::parse(&*file).map_err(Unfit::NoElf)?;
    let endian = parsed.endian();
    let header = parsed.elf_header();
    let (machine, kind) = (header.e_machine(endian), header.e_type(endian));
    if (machine, kind) != (elf::EM_ARM, elf::ET_EXEC) {
        return Err(Unfit::OtherProcessor { machine, kind });
    }
    let mut parts = vec![];
    for segment in parsed.elf_program_headers() {
        let bytes = segment.data(endian, &*file).unwrap_or_default();
        if segment.p_type(endian) == elf::PT_LOAD && !bytes.is_empty() {
            let start = u64::from(segment.p_paddr(endian));
            let end = start + bytes.len() as u64;
            parts.push((start, end, bytes));
        }
    }
    if parts.is_empty() {
        return Err(Unfit::Empty);
    }
    for (start, end, _) in &parts {
        let (start, end) = (*start, *end);
        let place = if start < FLASH.start || end > FLASH.end {
            "outside this chip's flash (0x08000000 to 0x08080000)"
        } else if start < KEPT.end && end > KEPT.start {
            "where the settings are kept (0x08004000 to 0x08010000)"
        } else {
            continue;
        };
        return Err(Unfit::Place { start, end, place });
    }
    vectors(&parts)?;
    let found = machine_of(&parsed).ok_or(Unfit::Unknown)?;
    if found != wanted {
        return Err(Unfit::OtherMachine { wanted, found });
    }
    Ok(Image {
        bytes: parts.iter().map(|(start, end, _)| end - start).sum(),
        fingerprint: image::fingerprint(path).map_err(Unfit::Image)?,
    })
}

/// Makes sure that the chip finds a stack and code at the start of its flash.
fn vectors(parts: &[(u64, u64, &[u8])]) -> Result<(), Unfit> {
    let table = parts.iter().find(|(start, _, _)| *start == FLASH.start);
    let word = |at: usize| {
        let bytes = table.and_then(|(_, _, bytes)| bytes.get(at..at + 4)?.first_chunk::<4>());
        bytes.map_or(0, |bytes| u32::from_le_bytes(*bytes))
    };
    let (stack, reset) = (word(0), word(4));
    // The address is odd: the chip runs Thumb code only.
    let entry = u64::from(reset & !1);
    let in_code = parts
        .iter()
        .any(|(start, end, _)| (*start..*end).contains(&entry));
    let stack_fits = RAM.contains(&u64::from(stack)) && stack % 8 == 0 && stack > 0x2000_0000;
    if stack_fits && reset % 2 == 1 && in_code {
        return Ok(());
    }
    Err(Unfit::Vectors { stack, reset })
}

/// The machine whose crate the symbols belong to.
fn machine_of(parsed: &ElfFile32<'_, Endianness>) -> Option<DeviceKind> {
    let mut found = None;
    for symbol in parsed.symbols() {
        let name = symbol.name().unwrap_or_default();
        // Length and name, as the compiler mangles a path.
        let kind = if name.starts_with("_ZN12firmware_rig") {
            DeviceKind::Rig
        } else if name.starts_with("_ZN16firmware_capsule") {
            DeviceKind::Capsule
        } else {
            continue;
        };
        if found.is_some_and(|found| found != kind) {
            return None;
        }
        found = Some(kind);
    }
    found
}
