//! Makes one task of the firmware hang, fault or panic at its next check-in with the watchdog.
//!
//! The image is not built for this. As a debugger would, the bench overwrites the beginning of the firmware's
//! `check_in` with a branch to unused flash; there a substitute does the same for every client but one. A reset mends
//! the code, so what runs after it is the image again.

use object::{Object, ObjectSymbol};

use crate::bench::{BenchError, Visit};
use crate::emulator::Wiring;

/// What the chosen client does at its check-in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deed {
    /// Loops for ever, at its own priority.
    Hang,
    /// Jumps to where no memory is.
    Fault,
    /// Panics.
    Panic,
}

/// Where [`Deed::Fault`] jumps to: the external memory that the chip does not have (RM0383 section 2.3).
pub const NOWHERE: u32 = 0x6000_0000;
/// Where the substitute lies: the last bytes of the flash, which no image reaches.
const UNUSED: u32 = 0x0807_FF00;

/// Code to put into a machine's flash.
#[derive(Clone, Debug)]
pub struct Sabotage {
    /// Addresses and the half-words that go there, in order.
    code: [(u64, Vec<u16>); 2],
}

impl Sabotage {
    /// `deed`, by the client that checks in with `client`; addresses are those of the image at `image`.
    ///
    /// # Errors
    /// An image without the symbols `check_in` and `CHECK_INS`.
    pub fn new(image: &std::path::Path, client: u8, deed: Deed) -> Result<Self, BenchError> {
        let elf = std::fs::read(image).map_err(|why| BenchError::NoImage {
            path: image.into(),
            why,
        })?;
        let bad = |why: String| BenchError::BadImage {
            path: image.into(),
            why,
        };
        let file = object::File::parse(&*elf).map_err(|why| bad(why.to_string()))?;
        let address = |part: &str| {
            let mut found = file.symbols().filter(|symbol| {
                symbol.size() > 0 && symbol.name().is_ok_and(|name| name.contains(part))
            });
            match (found.next(), found.next()) {
                (Some(symbol), None) => Ok(symbol.address() as u32 & !1),
                (one, _) => Err(bad(format!(
                    "{} symbol contains {part}",
                    if one.is_some() { "more than one" } else { "no" }
                ))),
            }
        };
        let (check_in, check_ins) = (address("8check_in")?, address("9CHECK_INS")?);
        let deed = match deed {
            Deed::Hang => vec![0xE7FE], // b .
            Deed::Fault => jump(NOWHERE),
            Deed::Panic => jump(address("9panic_fmt")?),
        };
        Ok(Self {
            code: [
                (UNUSED.into(), substitute(client, &deed, check_ins)),
                (check_in.into(), branch(check_in, UNUSED).to_vec()),
            ],
        })
    }

    /// Takes effect from the next instruction on, until the next reset.
    pub fn apply<W: Wiring>(&self, visit: &mut Visit<'_, W>) {
        for (address, code) in &self.code {
            visit.overwrite(*address, code);
        }
    }
}

/// `check_in` with a deed: r0 is the client; r1 to r3 are the callee's (AAPCS32 section 6.1.1).
fn substitute(client: u8, deed: &[u16], check_ins: u32) -> Vec<u16> {
    let past = deed.len() as u16 - 1;
    let mut code = vec![0x2800 | u16::from(client), 0xD100 | past]; // cmp r0, #client; bne past the deed
    code.extend_from_slice(deed);
    code.extend(load_r1(check_ins));
    code.extend([0xE8D1, 0x2F4F]); // ldrexb r2, [r1]
    code.push(0x4302); // orrs r2, r0
    code.extend([0xE8C1, 0x2F43]); // strexb r3, r2, [r1]
    code.extend([0x2B00, 0xD1F8]); // cmp r3, #0; bne to the ldrexb
    code.push(0x4770); // bx lr
    code
}

/// bx r1, with the return address of `check_in` still in lr.
fn jump(to: u32) -> Vec<u16> {
    [&load_r1(to | 1)[..], &[0x4708]].concat()
}

/// movw r1, #low; movt r1, #high (Armv7-M ARM A7.7.76 T3, A7.7.79).
fn load_r1(value: u32) -> [u16; 4] {
    let halves = |opcode: u16, half: u16| {
        let first = opcode | (half >> 12) | (half >> 1 & 0x400);
        [first, (half << 4 & 0x7000) | 0x0100 | (half & 0xFF)]
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

    /// As an assembler encodes them.
    #[test]
    fn instructions_are_encoded_as_the_manual_says() {
        assert_eq!(load_r1(0x2000_0434), [0xF240, 0x4134, 0xF2C2, 0x0100]);
        assert_eq!(load_r1(0xFFFF_FFFF), [0xF64F, 0x71FF, 0xF6CF, 0x71FF]);
        assert_eq!(branch(0x0800_0000, 0x0800_0004), [0xF000, 0xB800]);
        assert_eq!(branch(0x0800_0004, 0x0800_0000), [0xF7FF, 0xBFFC]);
    }

    #[test]
    fn the_substitute_skips_the_deed_of_the_others() {
        for deed in [vec![0xE7FE], jump(NOWHERE)] {
            let code = substitute(2, &deed, 0x2000_0434);
            let past = 2 + usize::from(code[1] & 0xFF) + 1;
            assert_eq!(code[past..past + 4], load_r1(0x2000_0434));
            assert!(code.len() * 2 <= 0x100);
        }
    }
}
