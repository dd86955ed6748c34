//! Checks where an image lies in the chip's memory and how much of it it takes.
//!
//! A successful link can still produce an image that bricks a board: without a linker script there is no
//! vector table, and without `_stext` the code lies in the sectors that are erased for the settings.

use std::ops::Range;

use object::elf::{PT_LOAD, SHF_ALLOC, SHT_NOBITS};
use object::endian::LittleEndian;
use object::read::elf::{ElfFile32, ProgramHeader as _, SectionHeader as _};
use object::{Object as _, ObjectSection as _};

/// Memory of a chip. `memory.x` defines the settings' sectors and the start of the code.
#[derive(Debug)]
struct Memory {
    flash: Range<u32>,
    settings: Range<u32>,
    code: Range<u32>,
    /// RAM for data, without the KiB that keeps the last panic.
    ram: Range<u32>,
    stack: Range<u32>,
    /// Bytes without memory below the stack; no frame may step over them.
    gap: u32,
}

/// 512 KiB of flash, 128 KiB of RAM.
static STM32F411RE: Memory = Memory {
    flash: 0x0800_0000..0x0808_0000,
    settings: 0x0800_4000..0x0801_0000,
    code: 0x0801_0000..0x0808_0000,
    ram: 0x2001_0000..0x2001_FC00,
    stack: 0x2000_0000..0x2000_F800,
    // Below the gap lies the system memory, which can be read. The 16 option bytes within the gap are left out, too.
    gap: 32 * 1024,
};

/// The most memory an image may take.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Budget {
    /// Vector table, code, constants and initial values.
    pub(crate) flash_bytes: u32,
    /// Statics: `.data`, `.bss`, `.uninit`. The stack has its own place.
    pub(crate) ram_bytes: u32,
}

/// Addresses and sizes of an image.
#[derive(Debug)]
pub(crate) struct Layout {
    pub(crate) flash_bytes: u32,
    pub(crate) ram_bytes: u32,
    /// Load addresses of everything that is programmed.
    programmed: Vec<Range<u32>>,
    /// Addresses of the sections with code.
    text: Vec<Range<u32>>,
    /// Address of the vector table, its first word (stack pointer) and its second (reset).
    vectors: Option<(u32, u32, u32)>,
    /// The most that one instruction takes from the stack.
    pub(crate) frame_bytes: u32,
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
            frame_bytes: 0,
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
            if start >= STM32F411RE.ram.start {
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
                ".text" => {
                    layout.text.push(start..start.saturating_add(length));
                    layout.frame_bytes = layout.frame_bytes.max(largest_frame(section.data()?));
                }
                _ => {}
            }
        }
        Ok(layout)
    }

    /// Reasons not to flash this image; empty if there are none.
    pub(crate) fn objections(&self, budget: Budget) -> Vec<String> {
        let mut found = Vec::new();
        let Memory {
            flash,
            settings,
            code,
            stack: whole_stack,
            ..
        } = &STM32F411RE;
        match self.vectors {
            None => found.push("no vector table: the chip would not boot".to_owned()),
            Some((place, stack, reset)) => {
                if place != flash.start {
                    found.push(format!("vector table at {place:#010x}, not at 0x08000000"));
                }
                if stack != whole_stack.end {
                    found.push(format!(
                        "the stack starts at {stack:#010x}, not at {:#010x}",
                        whole_stack.end
                    ));
                }
                // Bit 0 of a vector marks Thumb code.
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
            if !(code.contains(start) && *end <= code.end) {
                found.push(format!(
                    "code at {start:#010x}..{end:#010x}, outside of its sectors"
                ));
            }
        }
        for Range { start, end } in &self.programmed {
            if !(flash.contains(start) && *end <= flash.end) {
                found.push(format!(
                    "programs {start:#010x}..{end:#010x}, outside of flash"
                ));
            }
            if *start < settings.end && settings.start < *end {
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
        if self.frame_bytes > STM32F411RE.gap {
            found.push(format!(
                "a frame of {} bytes steps over the {} bytes without memory below the stack",
                self.frame_bytes, STM32F411RE.gap
            ));
        }
        found
    }
}

/// The largest constant that is taken from the stack pointer in this code: `sub.w sp, sp, #` and `subw sp, sp, #`
/// (Armv7-M ARM A7.7.176, T2 and T3). Constants between the functions may look like one; then it is too large, never
/// too small.
fn largest_frame(code: &[u8]) -> u32 {
    let halves: Vec<u32> = code
        .chunks_exact(2)
        .map(|half| u16::from_le_bytes([half[0], half[1]]).into())
        .collect();
    let frame = |pair: &[u32]| {
        let (first, second) = (pair[0], pair[1]);
        if second & 0x8F00 != 0x0D00 {
            return 0;
        }
        let constant = (first & 0x400) << 1 | (second >> 4) & 0x700 | second & 0xFF;
        match first & 0xFBFF {
            0xF2AD => constant,
            0xF1AD | 0xF1BD => expanded(constant),
            _ => 0,
        }
    };
    halves.windows(2).map(frame).max().unwrap_or(0)
}

/// ThumbExpandImm (Armv7-M ARM A5.3.2).
fn expanded(constant: u32) -> u32 {
    let byte = constant & 0xFF;
    match constant >> 8 {
        0 => byte,
        1 => byte << 16 | byte,
        2 => byte << 24 | byte << 8,
        3 => byte * 0x0101_0101,
        _ => (0x80 | byte & 0x7F).rotate_right(constant >> 7),
    }
}

/// The tests check made-up layouts: one change must cause each objection.
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
            vectors: Some((0x0800_0000, 0x2000_F800, 0x0801_0001)),
            frame_bytes: 32 * 1024,
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
        let cases: [(&str, Change); 10] = [
            ("no vector table", |image| image.vectors = None),
            ("vector table at 0x08010000", |image| {
                image.vectors = Some((0x0801_0000, 0x2000_F800, 0x0801_0001));
            }),
            ("stack starts at 0x20020000", |image| {
                image.vectors = Some((0x0800_0000, 0x2002_0000, 0x0801_0001));
            }),
            ("reset vector 0x00000000", |image| {
                image.vectors = Some((0x0800_0000, 0x2000_F800, 0));
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
            ("a frame of 32769 bytes", |image| image.frame_bytes += 1),
        ];
        for (words, change) in cases {
            let found = only_objection(change);
            assert!(found.contains(words), "{found:?} does not say {words:?}");
        }
    }

    /// Encodings from an assembler.
    #[test]
    fn the_largest_frame_is_found() {
        let code = |halves: &[u16]| -> Vec<u8> {
            halves.iter().flat_map(|half| half.to_le_bytes()).collect()
        };
        // sub sp, #16; subw sp, sp, #3356; sub.w sp, sp, #8768; sub.w r0, r0, #65536
        assert_eq!(largest_frame(&code(&[0xB084])), 0);
        assert_eq!(largest_frame(&code(&[0xF6AD, 0x5D1C])), 3_356);
        assert_eq!(
            largest_frame(&code(&[0xF6AD, 0x5D1C, 0xF5AD, 0x5D09, 0xF5A0, 0x3080])),
            8_768
        );
    }

    #[test]
    fn what_is_not_an_image_is_refused() {
        assert!(Layout::read(b"MZ, or so").is_err());
        let this_program = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        assert!(Layout::read(&this_program).is_err());
    }

    /// The addresses above must equal those of the linker script.
    #[test]
    fn addresses_agree_with_the_linker_script() {
        let memory = &STM32F411RE;
        let path = crate::process::root().join("memory.x");
        let script = std::fs::read_to_string(path).unwrap();
        let line = |name: &str| {
            let named = |line: &&str| line.trim_start().starts_with(name);
            script.lines().find(named).unwrap()
        };
        let hex = |text: &str| {
            let digits = text.split("0x").nth(1).unwrap();
            let end = digits.find(|digit: char| !digit.is_ascii_hexdigit());
            u32::from_str_radix(&digits[..end.unwrap_or(digits.len())], 16).unwrap()
        };
        let region = |name: &str| {
            let (from, length) = line(name).split_once(',').unwrap();
            let kib = length.trim_end_matches('K').rsplit(' ').next().unwrap();
            let start = hex(from);
            start..start + kib.parse::<u32>().unwrap() * 1024
        };
        let value = |name: &str| hex(line(name).split_once('=').unwrap().1);
        assert_eq!(region("FLASH"), memory.flash);
        assert_eq!(region("RAM"), memory.ram);
        assert_eq!(value("_stext"), memory.code.start);
        assert_eq!(
            value("_settings_start")..value("_settings_end"),
            memory.settings
        );
        assert_eq!(value("_stack_end")..value("_stack_start"), memory.stack);
        // The stack of processor faults lies between the stack and the data.
        assert_eq!(value("_fault_stack_start"), memory.stack.end + 2 * 1024);
        assert_eq!(value("_fault_stack_start"), memory.ram.start);
        // The KiB that survives a reset adjoins that RAM at one end.
        let kept = value("_last_words_start")..value("_last_words_end");
        assert_eq!(kept.end - kept.start, 1024);
        assert!(kept.start == memory.ram.end || kept.end == memory.ram.start);
    }
}
