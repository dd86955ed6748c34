//! The core with its flash: least and most cycles of a sequence of instructions.

use super::thumb::{Instruction, Timing, decode};

/// Refill of the pipeline after a branch that is taken: 1 to 3 cycles (ARM DDI 0439, section 3.3).
const REFILL: [u64; 2] = [1, 3];
/// Entry into an exception and return from it, stacking included (ARM DDI 0439, section 3.9): 12 cycles each. A return
/// takes 10 if the stack's words are already fetched. In the worst case the vector's read also waits for the flash, and
/// the stack for DMA.
pub(crate) const EXCEPTION: [u64; 2] = [22, 34];
/// Extra cycles of a register access over a memory access, by bus. The most: two cycles of a bus at half the core's
/// clock, plus one to synchronise and one to return.
const REGISTERS: [(std::ops::Range<u64>, [u64; 2]); 4] = [
    (0x4000_0000..0x4001_0000, [2, 8]),
    (0x4001_0000..0x4002_0000, [1, 4]),
    (0x4002_0000..0x5000_0000, [0, 2]),
    (0xE000_0000..0xE010_0000, [0, 1]),
];
/// Lines of the flash accelerator (RM0383 section 3.4.2), of 128 bits.
const INSTRUCTION_LINES: usize = 64;
const DATA_LINES: usize = 8;
const LINE_BYTES: u32 = 16;

/// FLASH_ACR: wait states, and the enabled parts of the accelerator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Accelerator {
    /// Extra cycles of a read after the first.
    pub wait_states: u64,
    /// Prefetch: the next line is read ahead.
    pub prefetch: bool,
    /// Instruction cache: 64 lines.
    pub instructions: bool,
    /// Data cache: 8 lines.
    pub data: bool,
}

impl Accelerator {
    /// Decodes the register (RM0383 section 3.8.1).
    #[must_use]
    pub fn of_register(acr: u32) -> Self {
        let bit = |nth: u32| (acr >> nth) & 1 == 1;
        Self {
            wait_states: u64::from(acr & 0xF),
            prefetch: bit(8),
            instructions: bit(9),
            data: bit(10),
        }
    }

    /// The same wait states, without the accelerator.
    #[must_use]
    pub fn off(self) -> Self {
        Self {
            wait_states: self.wait_states,
            prefetch: false,
            instructions: false,
            data: false,
        }
    }
}

/// Cached lines, the last used one in front.
#[derive(Clone, Debug)]
struct Lines {
    kept: Vec<u32>,
    most: usize,
}

impl Lines {
    fn new(most: usize) -> Self {
        let kept = Vec::with_capacity(most + 1);
        Self { kept, most }
    }

    fn has(&mut self, line: u32) -> bool {
        let found = self.kept.iter().position(|kept| *kept == line);
        if let Some(at) = found {
            self.kept[..=at].rotate_right(1);
        }
        found.is_some()
    }

    fn keep(&mut self, line: u32) {
        self.kept.insert(0, line);
        self.kept.truncate(self.most);
    }
}

/// The flash as one bound sees it.
#[derive(Clone, Debug)]
struct Flash {
    set: Accelerator,
    /// True for the lower bound: a line read ahead is cached like any other, a hit reads the next line ahead, and a
    /// read never waits for earlier ones. False for the upper bound: none of these.
    at_least: bool,
    instructions: Lines,
    data: Lines,
    /// The line that the core fetches its instructions from.
    present: Option<u32>,
    /// The line being read ahead, and when it arrives.
    ahead: Option<(u32, u64)>,
    busy_until: u64,
}

impl Flash {
    fn new(set: Accelerator, at_least: bool) -> Self {
        Self {
            set,
            at_least,
            instructions: Lines::new(if set.instructions {
                INSTRUCTION_LINES
            } else {
                0
            }),
            data: Lines::new(if set.data { DATA_LINES } else { 0 }),
            present: None,
            ahead: None,
            busy_until: 0,
        }
    }

    /// Cycles that the core waits for an instruction in this line.
    fn fetch(&mut self, line: u32, now: u64) -> u64 {
        if self.present == Some(line) {
            return 0;
        }
        self.present = Some(line);
        if self.instructions.has(line) {
            if self.at_least {
                self.read_ahead(line + 1, now);
            }
            return 0;
        }
        let ready = match self.ahead.take() {
            Some((ahead, ready)) if ahead == line => {
                if self.at_least {
                    self.instructions.keep(line);
                }
                ready.max(now)
            }
            _ => {
                self.instructions.keep(line);
                self.read(now)
            }
        };
        self.read_ahead(line + 1, ready);
        ready - now
    }

    /// Cycles that the core waits for a constant.
    fn load(&mut self, line: u32, now: u64) -> u64 {
        if self.data.has(line) {
            return 0;
        }
        self.data.keep(line);
        self.read(now) - now
    }

    /// When a line requested now arrives.
    fn read(&mut self, now: u64) -> u64 {
        let begun = if self.at_least {
            now
        } else {
            now.max(self.busy_until)
        };
        self.busy_until = begun + self.set.wait_states;
        self.busy_until
    }

    fn read_ahead(&mut self, line: u32, from: u64) {
        let known = self.ahead.is_some_and(|(ahead, _)| ahead == line);
        if self.set.prefetch && !known && !self.instructions.kept.contains(&line) {
            let ready = self.read(from) + 1;
            self.busy_until = ready;
            self.ahead = Some((line, ready));
        }
    }
}

/// One of the two bounds.
#[derive(Clone, Debug)]
struct Bound {
    index: usize,
    cycles: u64,
    flash: Flash,
}

/// The core.
#[derive(Clone, Debug)]
pub(crate) struct Core {
    bounds: [Bound; 2],
    /// The previous instruction and its address.
    before: Option<(u32, Instruction)>,
    pub(crate) exceptions: u64,
    pub(crate) instructions: u64,
}

/// Code in flash, from its first address on.
#[derive(Clone)]
pub(crate) struct Code {
    pub(crate) base: u32,
    pub(crate) bytes: Vec<u8>,
}

impl Code {
    /// Addresses at which an instruction may begin.
    pub(crate) fn addresses(&self) -> impl Iterator<Item = u32> {
        (self.base..self.base + self.bytes.len() as u32).step_by(2)
    }

    fn half(&self, address: u32) -> u16 {
        let at = address.wrapping_sub(self.base) as usize;
        let bytes = self.bytes.get(at..at + 2).unwrap_or(&[0, 0]);
        u16::from_le_bytes([bytes[0], bytes[1]])
    }

    fn instruction(&self, address: u32) -> Instruction {
        decode(self.half(address), self.half(address + 2))
    }
}

impl Core {
    pub(crate) fn new(set: Accelerator) -> Self {
        let bound = |index| Bound {
            index,
            cycles: 0,
            flash: Flash::new(set, index == 0),
        };
        Self {
            bounds: [bound(0), bound(1)],
            before: None,
            exceptions: 0,
            instructions: 0,
        }
    }

    /// Least and most cycles so far.
    pub(crate) fn cycles(&self) -> [u64; 2] {
        self.bounds.each_ref().map(|bound| bound.cycles)
    }

    /// The core executes the instruction at `address`.
    pub(crate) fn execute(&mut self, address: u32, code: &Code) {
        let instruction = code.instruction(address);
        let (mut taken, mut entered) = (false, false);
        let mut overlaps = false;
        if let Some((at, before)) = self.before {
            let straight = at + before.size == address;
            taken = !straight && before.branches;
            // Only an exception leads elsewhere without a branch.
            entered = !straight && !before.branches;
            overlaps = straight
                && matches!(
                    before.timing,
                    Timing::Load(1) | Timing::Store(1) | Timing::BufferedStore
                );
        }
        self.before = Some((address, instruction));
        self.instructions += 1;
        self.exceptions += u64::from(entered);
        for bound in &mut self.bounds {
            bound.execute(address, instruction, overlaps, taken, entered);
        }
    }

    /// The instruction accessed a register.
    pub(super) fn access(&mut self, address: u64) {
        for (range, more) in REGISTERS {
            if range.contains(&address) {
                for bound in &mut self.bounds {
                    bound.cycles += more[bound.index];
                }
            }
        }
    }
}

impl Bound {
    fn execute(
        &mut self,
        address: u32,
        instruction: Instruction,
        overlaps: bool,
        taken: bool,
        entered: bool,
    ) {
        let Self {
            index,
            cycles,
            flash,
        } = self;
        if taken {
            *cycles += REFILL[*index];
        }
        if entered {
            *cycles += EXCEPTION[*index];
        }
        for line in [
            address / LINE_BYTES,
            (address + instruction.size - 2) / LINE_BYTES,
        ] {
            *cycles += flash.fetch(line, *cycles);
        }
        *cycles += match instruction.timing {
            Timing::Cycles(least, most) => u64::from([least, most][*index]),
            Timing::BufferedStore => 1,
            Timing::Store(words) => 1 + u64::from(words),
            Timing::Load(1) if overlaps && *index == 0 => 1,
            Timing::Load(words) => 1 + u64::from(words),
            Timing::Literal { words, offset } => {
                let place = ((address + 4) & !3).wrapping_add_signed(offset);
                let mut waits = 0;
                for word in 0..words {
                    waits += flash.load((place + 4 * word) / LINE_BYTES, *cycles + waits);
                }
                1 + u64::from(words) + waits
            }
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SET: Accelerator = Accelerator {
        wait_states: 3,
        prefetch: true,
        instructions: true,
        data: false,
    };

    /// Cycles of a sequence of addresses in code that begins at 0x0800_0000.
    fn run(set: Accelerator, halves: &[u16], addresses: &[u32]) -> [u64; 2] {
        let bytes: Vec<u8> = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        let code = Code {
            base: 0x0800_0000,
            bytes,
        };
        let mut core = Core::new(set);
        for address in addresses {
            core.execute(0x0800_0000 + address, &code);
        }
        core.cycles()
    }

    const NOP: u16 = 0xBF00;

    /// Eight narrow instructions a line: 3 cycles to begin with, then the next line is read ahead in time.
    #[test]
    fn straight_code_waits_for_its_first_line_only() {
        let code = [NOP; 64];
        let addresses: Vec<u32> = (0..64).map(|nth| 2 * nth).collect();
        assert_eq!(run(SET, &code, &addresses), [64 + 3, 64 + 3]);
        // Without the accelerator, the wait is due for each of the eight lines.
        assert_eq!(run(SET.off(), &code, &addresses), [64 + 24, 64 + 24]);
    }

    /// Four wide instructions are as long as a read.
    #[test]
    fn wide_instructions_are_fetched_in_time_too() {
        // mov.w r0, r0
        let code: Vec<u16> = std::iter::repeat_n([0xEA4F, 0x0000], 32)
            .flatten()
            .collect();
        let addresses: Vec<u32> = (0..32).map(|nth| 4 * nth).collect();
        let [least, most] = run(SET, &code, &addresses);
        assert_eq!(least, 32 + 3);
        assert!(most <= 32 + 3 + 7, "{most}");
    }

    /// A loop in one line: the refill after each branch, and no wait after the first round.
    #[test]
    fn a_loop_is_kept() {
        let code = [NOP, NOP, NOP, 0xE7FB];
        let addresses: Vec<u32> = (0..4 * 100).map(|nth| 2 * (nth % 4)).collect();
        assert_eq!(
            run(SET, &code, &addresses),
            [400 + 3 + 99, 400 + 3 + 3 * 99]
        );
    }

    /// Loads one behind the other overlap in the lower bound only.
    #[test]
    fn loads_overlap_at_least() {
        // ldr r0, [r1]
        assert_eq!(run(SET, &[0x6808; 4], &[0, 2, 4, 6]), [3 + 5, 3 + 8]);
    }

    /// A constant waits for the flash each time, unless its line is kept.
    #[test]
    fn a_constant_is_read_from_flash() {
        let code = [0x4800; 8];
        let alone = run(
            Accelerator {
                prefetch: false,
                ..SET
            },
            &code,
            &[0, 2],
        );
        assert_eq!(alone, [3 + 10, 3 + 10]);
        let kept = Accelerator {
            prefetch: false,
            data: true,
            ..SET
        };
        assert_eq!(run(kept, &code, &[0, 2]), [3 + 7, 3 + 7]);
    }

    /// Execution continues elsewhere without a branch: an exception.
    #[test]
    fn an_exception_costs_its_stacking() {
        let code = [NOP; 8];
        assert_eq!(run(SET, &code, &[0, 8]), [3 + 2 + 22, 3 + 2 + 34]);
    }

    #[test]
    fn the_least_used_line_goes_first() {
        let mut lines = Lines::new(2);
        lines.keep(1);
        lines.keep(2);
        assert!(lines.has(1));
        lines.keep(3);
        assert!(lines.has(1) && lines.has(3) && !lines.has(2));
    }
}
