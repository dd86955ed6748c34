//! How many cycles an instruction of a Cortex-M4 takes by itself: the table of its technical reference manual (ARM
//! DDI 0439, section 3.3), from the two half-words that it is encoded in.

/// An instruction, with the properties that determine its cycles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Instruction {
    /// Size in bytes.
    pub(super) size: u32,
    pub(super) timing: Timing,
    /// It may change the program counter.
    pub(super) branches: bool,
}

/// Cycles of an instruction, without waits and without the pipeline refill after a branch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Timing {
    /// Least and most cycles.
    Cycles(u32, u32),
    /// Loads this many words: 1 + n. The address phase of a single load overlaps with the load or store before it.
    Load(u32),
    /// Loads `words` words from flash, relative to the word-aligned program counter.
    Literal { words: u32, offset: i32 },
    /// Stores this many words: 1 + n.
    Store(u32),
    /// A single store at a constant offset: the write buffer completes it during the next instruction.
    BufferedStore,
}

/// A division ends early, depending on its operands.
const DIVIDE: Timing = Timing::Cycles(2, 12);
/// A 32-bit multiply-accumulate: 2 by the manual, 1 by its later edition.
const MULTIPLY_ACCUMULATE: Timing = Timing::Cycles(1, 2);
/// Floats of 32 bits (ARM DDI 0439, section 7.2.3); one cycle more where the next instruction takes the result.
const FLOAT: Timing = Timing::Cycles(1, 2);
const FLOAT_MULTIPLY_ACCUMULATE: Timing = Timing::Cycles(3, 4);
const FLOAT_DIVIDE: Timing = Timing::Cycles(14, 15);
/// A barrier waits for earlier stores, and ISB for a pipeline refill.
const BARRIER: Timing = Timing::Cycles(1, 4);

/// Decodes the instruction that begins with `first`; `second` is used only if it is a 32-bit one.
pub(super) fn decode(first: u16, second: u16) -> Instruction {
    let (first, second) = (u32::from(first), u32::from(second));
    match first >> 11 {
        0b11101..=0b11111 => wide(first, second),
        _ => narrow(first),
    }
}

const ONE: Timing = Timing::Cycles(1, 1);

fn narrow(word: u32) -> Instruction {
    let low = (word & 0xFF).count_ones();
    let ninth = (word >> 8) & 1;
    let (timing, branches) = match word >> 8 {
        // ADD, MOV to a high register, which may be the program counter; BX and BLX.
        0x44 | 0x46 => (ONE, word & 0x87 == 0x87),
        0x47 => (ONE, true),
        0x48..=0x4F => (
            Timing::Literal {
                words: 1,
                offset: 4 * (word & 0xFF) as i32,
            },
            false,
        ),
        0x50..=0x55 => (Timing::Store(1), false),
        0x56..=0x5F => (Timing::Load(1), false),
        0x60..=0x9F if word & 0x0800 == 0 => (Timing::BufferedStore, false),
        0x60..=0x9F => (Timing::Load(1), false),
        // CBZ, CBNZ.
        0xB1 | 0xB3 | 0xB9 | 0xBB => (ONE, true),
        0xB4 | 0xB5 => (Timing::Store(low + ninth), false),
        0xBC | 0xBD => (Timing::Load(low + ninth), ninth == 1),
        // CPS.
        0xB6 => (Timing::Cycles(1, 2), false),
        // IT, which may be folded into the instruction before; hints otherwise.
        0xBF if word & 0xF != 0 => (Timing::Cycles(0, 1), false),
        0xC0..=0xC7 => (Timing::Store(low), false),
        0xC8..=0xCF => (Timing::Load(low), false),
        // B; SVC is an exception.
        0xD0..=0xDE | 0xE0..=0xE7 => (ONE, true),
        _ => (ONE, false),
    };
    Instruction {
        size: 2,
        timing,
        branches,
    }
}

fn wide(first: u32, second: u32) -> Instruction {
    let (timing, branches) = match (first >> 4) & 0x1FF {
        // Load and store multiple.
        kind @ (0x088..=0x08B | 0x090..=0x093 | 0x080..=0x083 | 0x098..=0x09B) if kind & 4 == 0 => {
            let words = second.count_ones();
            if kind & 1 == 1 {
                (Timing::Load(words), second >> 15 == 1)
            } else {
                (Timing::Store(words), false)
            }
        }
        // TBB, TBH.
        0x08D if second & 0xFFE0 == 0xF000 => (Timing::Cycles(2, 2), true),
        // Exclusive ones.
        0x084 | 0x08C => (Timing::Store(1), false),
        0x085 | 0x08D => (Timing::Load(1), false),
        kind @ 0x080..=0x09F if kind & 1 == 1 && first & 0xF == 15 => {
            let distance = 4 * (second & 0xFF) as i32;
            let up = first & 0x80 != 0;
            (literal(2, distance, up), false)
        }
        kind @ 0x080..=0x09F if kind & 1 == 1 => (Timing::Load(2), false),
        0x080..=0x09F => (Timing::Store(2), false),
        0x0C0..=0x0FF | 0x1C0..=0x1FF => (float(first, second), false),
        0x100..=0x17F if second >> 15 == 1 => control(first, second),
        kind @ 0x180..=0x19F => single(kind, first, second),
        0x1B0 | 0x1B1 if second >> 12 != 15 || kind_is_subtraction(second) => {
            (MULTIPLY_ACCUMULATE, false)
        }
        0x1B9 | 0x1BB => (DIVIDE, false),
        _ => (ONE, false),
    };
    Instruction {
        size: 4,
        timing,
        branches,
    }
}

/// Instructions of the floating-point unit.
fn float(first: u32, second: u32) -> Timing {
    let words = second & 0xFF;
    match first & 0xFFB0 {
        // VLDR and VSTR, of one word or two.
        kind if kind & 0xFF20 == 0xED00 => match (kind & 0x10 != 0, 1 + ((second >> 8) & 1)) {
            (false, words) => Timing::Store(words),
            (true, count) if first & 0xF == 15 => {
                literal(count, 4 * words as i32, first & 0x80 != 0)
            }
            (true, count) => Timing::Load(count),
        },
        // Two registers of the core to or from it.
        0xEC00 | 0xEC10 if first & 0xFFE0 == 0xEC40 => Timing::Cycles(2, 3),
        // VLDM and VSTM, VPOP and VPUSH.
        kind if kind & 0xFE00 == 0xEC00 => match kind & 0x10 != 0 {
            true => Timing::Load(words),
            false => Timing::Store(words),
        },
        // Moves of single words.
        _ if second & 0x10 != 0 => FLOAT,
        // VMLA and VMLS, VNMLA and VNMLS, VFMA and VFNMA.
        0xEE00 | 0xEE10 | 0xEEA0 | 0xEE90 => FLOAT_MULTIPLY_ACCUMULATE,
        // VDIV, and VSQRT among those of one operand.
        0xEE80 => FLOAT_DIVIDE,
        0xEEB0 if first & 0xF == 1 && second & 0xD0 == 0xC0 => FLOAT_DIVIDE,
        _ => FLOAT,
    }
}

/// MLS.
fn kind_is_subtraction(second: u32) -> bool {
    second & 0xF0 == 0x10
}

/// Branches, barriers and the special registers.
fn control(first: u32, second: u32) -> (Timing, bool) {
    match (second >> 12) & 0b101 {
        0 if (first >> 6) & 0xE != 0xE => (ONE, true),
        0 if first & 0xFFF0 == 0xF3B0 => (BARRIER, false),
        0 => (Timing::Cycles(1, 2), false),
        _ => (ONE, true),
    }
}

/// A load or store of one word or less.
fn single(kind: u32, first: u32, second: u32) -> (Timing, bool) {
    let constant = first & 0x80 != 0 || second & 0x800 != 0;
    let to_counter = second >> 12 == 15 && kind & 7 == 5;
    match kind & 1 {
        1 if first & 0xF == 15 => (
            literal(1, (second & 0xFFF) as i32, first & 0x80 != 0),
            to_counter,
        ),
        1 => (Timing::Load(1), to_counter),
        _ if constant => (Timing::BufferedStore, false),
        _ => (Timing::Store(1), false),
    }
}

fn literal(words: u32, distance: i32, up: bool) -> Timing {
    let offset = if up { distance } else { -distance };
    Timing::Literal { words, offset }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Encodings as an assembler gives them.
    #[test]
    fn instructions_are_told_apart() {
        let cases: [(&str, u16, u16, u32, Timing, bool); 45] = [
            ("movs r0, #1", 0x2001, 0, 2, ONE, false),
            ("adds r0, r1, r2", 0x1888, 0, 2, ONE, false),
            ("bx lr", 0x4770, 0, 2, ONE, true),
            ("blx r3", 0x4798, 0, 2, ONE, true),
            ("mov r8, r0", 0x4680, 0, 2, ONE, false),
            ("mov pc, r0", 0x4687, 0, 2, ONE, true),
            (
                "ldr r0, [pc, #8]",
                0x4802,
                0,
                2,
                Timing::Literal {
                    words: 1,
                    offset: 8,
                },
                false,
            ),
            ("str r0, [r1, r2]", 0x5088, 0, 2, Timing::Store(1), false),
            ("ldr r0, [r1, r2]", 0x5888, 0, 2, Timing::Load(1), false),
            ("ldrsb r0, [r1, r2]", 0x5688, 0, 2, Timing::Load(1), false),
            (
                "str r0, [r1, #4]",
                0x6048,
                0,
                2,
                Timing::BufferedStore,
                false,
            ),
            ("ldrh r0, [r1, #4]", 0x8888, 0, 2, Timing::Load(1), false),
            ("ldr r0, [sp, #4]", 0x9801, 0, 2, Timing::Load(1), false),
            ("push {r4, r5, lr}", 0xB530, 0, 2, Timing::Store(3), false),
            ("pop {r4, r5, pc}", 0xBD30, 0, 2, Timing::Load(3), true),
            ("cbz r0, .", 0xB100, 0, 2, ONE, true),
            ("it eq", 0xBF08, 0, 2, Timing::Cycles(0, 1), false),
            ("nop", 0xBF00, 0, 2, ONE, false),
            ("beq .", 0xD0FE, 0, 2, ONE, true),
            ("b .", 0xE7FE, 0, 2, ONE, true),
            ("stm r0!, {r1, r2}", 0xC006, 0, 2, Timing::Store(2), false),
            (
                "ldrd r0, r1, [r2]",
                0xE9D2,
                0x0100,
                4,
                Timing::Load(2),
                false,
            ),
            (
                "strd r0, r1, [r2]",
                0xE9C2,
                0x0100,
                4,
                Timing::Store(2),
                false,
            ),
            (
                "push.w {r4-r11, lr}",
                0xE92D,
                0x4FF0,
                4,
                Timing::Store(9),
                false,
            ),
            (
                "pop.w {r4-r11, pc}",
                0xE8BD,
                0x8FF0,
                4,
                Timing::Load(9),
                true,
            ),
            ("bl .", 0xF7FF, 0xFFFE, 4, ONE, true),
            ("beq.w .", 0xF43F, 0xAFFE, 4, ONE, true),
            ("dmb", 0xF3BF, 0x8F5F, 4, BARRIER, false),
            (
                "mrs r0, primask",
                0xF3EF,
                0x8010,
                4,
                Timing::Cycles(1, 2),
                false,
            ),
            ("udiv r0, r1, r2", 0xFBB1, 0xF0F2, 4, DIVIDE, false),
            ("umull r0, r1, r2, r3", 0xFBA2, 0x0103, 4, ONE, false),
            (
                "mla r0, r1, r2, r3",
                0xFB01,
                0x3002,
                4,
                MULTIPLY_ACCUMULATE,
                false,
            ),
            (
                "ldr.w r0, [pc, #-4]",
                0xF85F,
                0x0004,
                4,
                Timing::Literal {
                    words: 1,
                    offset: -4,
                },
                false,
            ),
            ("vadd.f32 s0, s1, s2", 0xEE30, 0x0A81, 4, FLOAT, false),
            ("vmul.f32 s0, s1, s2", 0xEE20, 0x0A81, 4, FLOAT, false),
            ("vcmp.f32 s0, s1", 0xEEB4, 0x0A60, 4, FLOAT, false),
            ("vmov.f32 s0, s1", 0xEEB0, 0x0A60, 4, FLOAT, false),
            ("vmov s0, r1", 0xEE00, 0x1A10, 4, FLOAT, false),
            (
                "vmla.f32 s0, s1, s2",
                0xEE00,
                0x0A81,
                4,
                FLOAT_MULTIPLY_ACCUMULATE,
                false,
            ),
            (
                "vdiv.f32 s0, s1, s2",
                0xEE80,
                0x0A81,
                4,
                FLOAT_DIVIDE,
                false,
            ),
            ("vsqrt.f32 s0, s1", 0xEEB1, 0x0AE0, 4, FLOAT_DIVIDE, false),
            ("vldr s0, [r1]", 0xED91, 0x0A00, 4, Timing::Load(1), false),
            (
                "vpush {s16, s17}",
                0xED2D,
                0x8A02,
                4,
                Timing::Store(2),
                false,
            ),
            (
                "vldr s0, [pc, #8]",
                0xED9F,
                0x0A02,
                4,
                Timing::Literal {
                    words: 1,
                    offset: 8,
                },
                false,
            ),
            (
                "strh.w r0, [r1, r2]",
                0xF821,
                0x0002,
                4,
                Timing::Store(1),
                false,
            ),
        ];
        for (text, first, second, size, timing, branches) in cases {
            let expected = Instruction {
                size,
                timing,
                branches,
            };
            assert_eq!(decode(first, second), expected, "{text}");
        }
    }
}
