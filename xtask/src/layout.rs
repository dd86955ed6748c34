//! Where an image lies in the chip's memory and how much it takes.
//!
//! A successful link can still produce an image that bricks a board: without a linker script there is no
//! vector table, and without `_stext` the code lies in the sectors that are erased for the settings.

use std::ops::Range;

use object::elf::{PT_LOAD, SHF_ALLOC, SHT_NOBITS};
use object::endian::LittleEndian;
use object::read::elf::{ElfFile32, ProgramHeader as _, SectionHeader as _};
use object::{Object as _, ObjectSection as _};

/// Flash of the STM32F411RE. `memory.x` defines the settings' sectors and the start of the code.
const FLASH: Range<u32> = 0x0800_0000..0x0808_0000;
const SETTINGS: Range<u32> = 0x0800_4000..0x0801_0000;
const CODE: Range<u32> = 0x0801_0000..0x0808_0000;
/// RAM for data and stack. The last KiB of the chip's 128 KiB keeps the last panic.
const RAM: Range<u32> = 0x2000_0000..0x2001_FC00;

/// The most memory an image may take.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Budget {
    /// Vector table, code, constants and initial values.
    pub(crate) flash_bytes: u32,
    /// Statics: `.data`, `.bss`, `.uninit`; the stack takes what is left of the chip's RAM.
    pub(crate) ram_bytes: u32,
}

/// What an image occupies.
#[derive(Debug)]
pub(crate) struct Layout {
    pub(crate) flash_bytes: u32,
    pub(crate) ram_bytes: u32,
    /// Load addresses of everything that is programmed.
    programmed: Vec<Range<u32>>,
    /// Addresses of the sections that hold code.
    text: Vec<Range<u32>>,
    /// Address of the vector table, its first word (stack pointer) and its second (reset).
    vectors: Option<(u32, u32, u32)>,
}

impl Layout {
    /// Reads an image.
    ///
    /// # Errors
    /// Not a 32-bit little-endian ELF file, or a damaged one.
    pub(crate) fn read(file: &[u8]) -> object::Result<Self> {
        let elf = ElfFile32::<LittleEndian>::parse(file)?;
        let endian = elf.endian();
        let mut layout = Self {
            flash_bytes: 0,
            ram_bytes: 0,
            programmed: Vec::new(),
            text: Vec::new(),
            vectors: None,
        };
        for segment in elf.elf_program_headers() {
            let (start, length) = (segment.p_paddr(endian), segment.p_filesz(endian));
            if segment.p_type(endian) == PT_LOAD && length > 0 {
                layout.programmed.push(start..start.saturating_add(length));
            }
        }
        for section in elf.sections() {
            let header = section.elf_section_header();
            if header.sh_flags(endian) & SHF_ALLOC == 0 || header.sh_size(endian) == 0 {
                continue;
            }
            let (start, length) = (header.sh_addr(endian), header.sh_size(endian));
            if header.sh_type(endian) != SHT_NOBITS {
                layout.flash_bytes = layout.flash_bytes.saturating_add(length);
            }
            if start >= RAM.start {
                layout.ram_bytes = layout.ram_bytes.saturating_add(length);
            }
            match section.name()? {
                ".vector_table" => {
                    let words: Vec<u32> = section
                        .data()?
                        .chunks_exact(4)
                        .take(2)
                        .map(|word| u32::from_le_bytes([word[0], word[1], word[2], word[3]]))
                        .collect();
                    if let [stack, reset] = words[..] {
                        layout.vectors = Some((start, stack, reset));
                    }
                }
                ".text" => layout.text.push(start..start.saturating_add(length)),
                _ => {}
            }
        }
        Ok(layout)
    }

    /// Reasons why this image must not be flashed; empty if there are none.
    pub(crate) fn objections(&self, budget: Budget) -> Vec<String> {
        let mut found = Vec::new();
        match self.vectors {
            None => found.push("no vector table: the chip would not boot".to_owned()),
            Some((place, stack, reset)) => {
                if place != FLASH.start {
                    found.push(format!("vector table at {place:#010x}, not at 0x08000000"));
                }
                if !(RAM.start < stack && stack <= RAM.end) {
                    found.push(format!("the stack starts at {stack:#010x}, outside of RAM"));
                }
                // Bit 0 of a vector says "Thumb".
                let entry = reset & !1;
                if !self.text.iter().any(|range| range.contains(&entry)) {
                    found.push(format!(
                        "the reset vector {reset:#010x} does not point at code"
                    ));
                }
            }
        }
        if self.text.is_empty() {
            found.push("no code".to_owned());
        }
        for Range { start, end } in &self.text {
            if !(CODE.contains(start) && *end <= CODE.end) {
                found.push(format!(
                    "code at {start:#010x}..{end:#010x}, outside of its sectors"
                ));
            }
        }
        for Range { start, end } in &self.programmed {
            if !(FLASH.contains(start) && *end <= FLASH.end) {
                found.push(format!(
                    "programs {start:#010x}..{end:#010x}, outside of flash"
                ));
            }
            if *start < SETTINGS.end && SETTINGS.start < *end {
                found.push(format!(
                    "programs {start:#010x}..{end:#010x}, where the settings are"
                ));
            }
        }
        for (what, used, allowed) in [
            ("flash", self.flash_bytes, budget.flash_bytes),
            ("RAM", self.ram_bytes, budget.ram_bytes),
        ] {
            if used > allowed {
                found.push(format!(
                    "{what}: {used} bytes, {} over budget",
                    used - allowed
                ));
            }
        }
        found
    }
}

/// The tests check made-up layouts: each objection must be raised by the one change that causes it.
#[cfg(test)]
mod tests {
    use super::*;

    const BUDGET: Budget = Budget {
        flash_bytes: 64 * 1024,
        ram_bytes: 48 * 1024,
    };

    fn sound() -> Layout {
        Layout {
            flash_bytes: BUDGET.flash_bytes,
            ram_bytes: BUDGET.ram_bytes,
            programmed: vec![0x0800_0000..0x0800_0198, 0x0801_0000..0x0801_F000],
            text: std::iter::once(0x0801_0000..0x0801_8000).collect(),
            vectors: Some((0x0800_0000, 0x2001_FC00, 0x0801_0001)),
        }
    }

    type Change = fn(&mut Layout);

    fn only_objection(change: Change) -> String {
        let mut layout = sound();
        change(&mut layout);
        let found = layout.objections(BUDGET);
        assert_eq!(found.len(), 1, "{found:?}");
        found[0].clone()
    }

    #[test]
    fn a_sound_image_at_its_budget_passes() {
        assert_eq!(sound().objections(BUDGET), Vec::<String>::new());
    }

    #[test]
    fn each_defect_is_named() {
        let cases: [(&str, Change); 9] = [
            ("no vector table", |image| image.vectors = None),
            ("vector table at 0x08010000", |image| {
                image.vectors = Some((0x0801_0000, 0x2001_FC00, 0x0801_0001));
            }),
            ("stack starts at 0x20020000", |image| {
                image.vectors = Some((0x0800_0000, 0x2002_0000, 0x0801_0001));
            }),
            ("reset vector 0x00000000", |image| {
                image.vectors = Some((0x0800_0000, 0x2001_FC00, 0));
            }),
            ("outside of its sectors", |image| {
                image.text.push(0x0800_0400..0x0800_0800);
            }),
            ("where the settings are", |image| {
                image.programmed[0].end = 0x0800_4001;
            }),
            ("outside of flash", |image| {
                image.programmed[1].end = 0x0808_0001
            }),
            ("flash: 65537 bytes, 1 over", |image| image.flash_bytes += 1),
            ("RAM: 49153 bytes, 1 over", |image| image.ram_bytes += 1),
        ];
        for (words, change) in cases {
            let found = only_objection(change);
            assert!(found.contains(words), "{found:?} does not say {words:?}");
        }
    }

    #[test]
    fn what_is_not_an_image_is_refused() {
        assert!(Layout::read(b"MZ, or so").is_err());
        let this_program = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        assert!(Layout::read(&this_program).is_err());
    }

    /// The addresses above are those of the linker script.
    #[test]
    fn addresses_agree_with_memory_x() {
        let script = std::fs::read_to_string(
            crate::process::root().join("device/memory/stm32f411re/memory.x"),
        )
        .unwrap();
        let value = |name: &str| {
            let line = script.lines().find(|line| line.starts_with(name)).unwrap();
            let digits = line.split("0x").nth(1).unwrap().trim_end_matches(';');
            u32::from_str_radix(digits, 16).unwrap()
        };
        assert_eq!(value("_stext"), CODE.start);
        assert_eq!(value("_settings_start")..value("_settings_end"), SETTINGS);
        assert_eq!(value("_last_words_start"), RAM.end);
    }
}
