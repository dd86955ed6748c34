//! Fault injection into one task of the firmware: it hangs, faults, panics, uses up its stack or leaves out its
//! check-in with the watchdog.
//!
//! The image is unmodified. Like a debugger, the bench overwrites the beginning of the firmware's `check_in` with a
//! branch to unused flash, where a substitute does the same for every client but one. A reset restores the code.

use object::{Object, ObjectSymbol};

use crate::bench::{BenchError, Visit};
use crate::emulator::Wiring;

/// Behaviour of the chosen client when it checks in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Misbehaviour {
    /// Loops forever, at its own priority.
    Hang,
    /// Continues without the check-in, like a task that waits for an event that never comes.
    Forget,
    /// Jumps to an address without memory.
    Fault,
    Panic,
    /// Begins a frame of the log and panics within it.
    PanicInLog,
    /// Calls itself until the stack is used up.
    Overflow,
    /// Takes all of the stack but 16 bytes, and waits for an interrupt, whose frame has no room there.
    OverflowByInterrupt,
    /// Faults with a stack whose frame reaches beyond the RAM's end.
    FrameAtRamEnd,
    /// Sets all vector-catch bits of a debugger, once, and continues.
    SetCatches,
}

/// Address to which [`Misbehaviour::Fault`] jumps: external memory, which the chip does not have (RM0383 section 2.3).
pub const UNMAPPED: u32 = 0x6000_0000;
const RAM_END: u32 = 0x2002_0000;
/// Debug exception and monitor control (Armv7-M ARM C1.6.5).
const DEMCR: u32 = 0xE000_EDFC;
/// Address of the substitute: the end of the flash, which no image reaches.
const UNUSED: u32 = 0x0807_FF00;
/// Address of the source location that [`Misbehaviour::Panic`] reports, also unused.
const LOCATION: u32 = 0x0807_FE00;
/// File of that location, as the last words report it.
pub const FILE: &str = "bench.rs";

/// Core's function for the panic of an addition.
const ADD_OVERFLOW: &str = "core::panicking::panic_const::panic_const_add_overflow";

/// Code to put into a machine's flash.
#[derive(Clone, Debug)]
pub struct FaultInjection {
    /// Addresses and the half-words that go there, in order.
    code: [(u64, Vec<u16>); 3],
}

impl FaultInjection {
    /// Makes the client that checks in with `client` misbehave; addresses come from the image at `image`.
    ///
    /// # Errors
    /// An image without the symbols `check_in` and `CHECK_INS`.
    pub fn new(
        image: &std::path::Path,
        client: u8,
        misbehaviour: Misbehaviour,
    ) -> Result<Self, BenchError> {
        let elf = std::fs::read(image).map_err(|why| BenchError::NoImage {
            path: image.into(),
            why,
        })?;
        let bad = |why: String| BenchError::BadImage {
            path: image.into(),
            why,
        };
        let file = object::File::parse(&*elf).map_err(|why| bad(why.to_string()))?;
        // Without the hash that every way of mangling adds.
        let path = |name: &str| format!("{:#}", rustc_demangle::demangle(name));
        let address = |item: &str| {
            let mut found = file.symbols().filter(|symbol| {
                symbol.size() > 0 && symbol.name().is_ok_and(|name| path(name) == item)
            });
            match (found.next(), found.next()) {
                (Some(symbol), None) => Ok(symbol.address() as u32 & !1),
                (one, _) => Err(bad(format!(
                    "{} symbol is {item}",
                    if one.is_some() { "more than one" } else { "no" }
                ))),
            }
        };
        // A symbol that the linker script defines has no size.
        let symbol_at = |name: &str| {
            let mut found = file.symbols().filter(|symbol| symbol.name() == Ok(name));
            let symbol = found
                .next()
                .ok_or_else(|| bad(format!("no symbol {name}")))?;
            Ok::<_, BenchError>(symbol.address() as u32)
        };
        let (check_in, check_ins) = (
            address("device::chip::watchdog::check_in")?,
            address("device::chip::channels::CHECK_INS")?,
        );
        let payload = match misbehaviour {
            Misbehaviour::Hang => vec![0xE7FE],   // b .
            Misbehaviour::Forget => vec![0x4770], // bx lr
            Misbehaviour::Fault => jump(UNMAPPED),
            Misbehaviour::Panic => panic(address(ADD_OVERFLOW)?),
            Misbehaviour::PanicInLog => {
                let mut code = load(1, symbol_at("_defmt_acquire")? | 1).to_vec();
                code.push(0x4788); // blx r1
                code.extend(panic(address(ADD_OVERFLOW)?));
                code
            }
            Misbehaviour::Overflow => vec![0xB5F0, 0xE7FD], // push {r4-r7, lr}; b to the push
            Misbehaviour::OverflowByInterrupt => {
                let mut code = load(1, symbol_at("_stack_end")? + 16).to_vec();
                code.extend([0x468D, 0xE7FE]); // mov sp, r1; b .
                code
            }
            Misbehaviour::FrameAtRamEnd => {
                let mut code = load(1, RAM_END + 8).to_vec();
                code.extend([0x468D, 0xDE00]); // mov sp, r1; udf
                code
            }
            Misbehaviour::SetCatches => {
                let mut code = load(1, DEMCR).to_vec();
                code.extend([0xF240, 0x73F1, 0x600B]); // movw r3, #0x7F1; str r3, [r1]
                code
            }
        };
        Ok(Self {
            code: [
                (UNUSED.into(), substitute(client, &payload, check_ins)),
                (LOCATION.into(), location()),
                (check_in.into(), branch(check_in, UNUSED).to_vec()),
            ],
        })
    }

    /// Overwrites the code; takes effect with the next instruction and lasts until the next reset.
    pub fn apply<W: Wiring>(&self, visit: &mut Visit<'_, W>) {
        for (address, code) in &self.code {
            visit.overwrite(*address, code);
        }
    }
}

/// Code of `check_in`, but with `payload` for one client. r0 holds the client; the callee may use r1 to r3 (AAPCS32
/// section 6.1.1).
fn substitute(client: u8, payload: &[u16], check_ins: u32) -> Vec<u16> {
    let past = payload.len() as u16 - 1;
    let mut code = vec![0x2800 | u16::from(client), 0xD100 | past]; // cmp r0, #client; bne past the payload
    code.extend_from_slice(payload);
    code.extend(load(1, check_ins));
    code.extend([0xE8D1, 0x2F4F]); // ldrexb r2, [r1]
    code.push(0x4302); // orrs r2, r0
    code.extend([0xE8C1, 0x2F43]); // strexb r3, r2, [r1]
    code.extend([0x2B00, 0xD1F8]); // cmp r3, #0; bne to the ldrexb
    code.push(0x4770); // bx lr
    code
}

/// bx r1, with the return address of `check_in` still in lr.
fn jump(to: u32) -> Vec<u16> {
    [&load(1, to | 1)[..], &[0x4708]].concat()
}

/// Jumps to core's function for a panic, which takes the location in r0.
fn panic(function: u32) -> Vec<u16> {
    [&load(0, LOCATION)[..], &jump(function)].concat()
}

/// A `core::panic::Location` as rustc lays it out: file, line and column; and the file's name.
fn location() -> Vec<u16> {
    let words = [LOCATION + 16, FILE.len() as u32, 1, 1];
    let bytes = words.into_iter().flat_map(u32::to_le_bytes);
    let bytes: Vec<_> = bytes.chain(FILE.bytes()).collect();
    let halves = bytes.chunks_exact(2);
    halves
        .map(|half| u16::from_le_bytes([half[0], half[1]]))
        .collect()
}

/// movw, #low; movt, #high (Armv7-M ARM A7.7.76 T3, A7.7.79).
fn load(register: u16, value: u32) -> [u16; 4] {
    let halves = |opcode: u16, half: u16| {
        let first = opcode | (half >> 12) | (half >> 1 & 0x400);
        [first, (half << 4 & 0x7000) | register << 8 | (half & 0xFF)]
    };
    let [[a, b], [c, d]] = [
        halves(0xF240, value as u16),
        halves(0xF2C0, (value >> 16) as u16),
    ];
    [a, b, c, d]
}

/// b.w (Armv7-M ARM A7.7.12 T4).
fn branch(from: u32, to: u32) -> [u16; 2] {
    let offset = to.wrapping_sub(from + 4);
    let bit = |n: u32| (offset >> n & 1) as u16;
    let sign = bit(24);
    let first = 0xF000 | sign << 10 | (offset >> 12 & 0x3FF) as u16;
    let (j1, j2) = (bit(23) ^ sign ^ 1, bit(22) ^ sign ^ 1);
    [
        first,
        0x9000 | j1 << 13 | j2 << 11 | (offset >> 1 & 0x7FF) as u16,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Expected values from an assembler.
    #[test]
    fn instructions_are_encoded_as_the_manual_says() {
        assert_eq!(load(1, 0x2000_0434), [0xF240, 0x4134, 0xF2C2, 0x0100]);
        assert_eq!(load(1, 0xFFFF_FFFF), [0xF64F, 0x71FF, 0xF6CF, 0x71FF]);
        assert_eq!(branch(0x0800_0000, 0x0800_0004), [0xF000, 0xB800]);
        assert_eq!(branch(0x0800_0004, 0x0800_0000), [0xF7FF, 0xBFFC]);
    }

    #[test]
    fn the_substitute_skips_the_payload_for_all_other_clients() {
        for payload in [vec![0xE7FE], jump(UNMAPPED)] {
            let code = substitute(2, &payload, 0x2000_0434);
            let past = 2 + usize::from(code[1] & 0xFF) + 1;
            assert_eq!(code[past..past + 4], load(1, 0x2000_0434));
            assert!(code.len() * 2 <= 0x100);
        }
    }
}
