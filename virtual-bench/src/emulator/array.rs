//! The flash array behind the emulated interface: programming clears bits, an erase sets them, a cut in the middle
//! of an erase leaves the sector half done.

use rigless::emulator::{Access, AccessKind, Host};
use rigless::soc::Width;

use super::map::{FLASH_BASE, FLASH_BYTES, SECTOR_BYTES};

/// The interface's control and status registers (RM0383 section 3.8).
const CONTROL: u64 = 0x4002_3C10;
const STATUS: u64 = 0x4002_3C0C;
const PG: u64 = 1 << 0;
const SER: u64 = 1 << 1;
const MER: u64 = 1 << 2;
const STRT: u64 = 1 << 16;
const LOCK: u64 = 1 << 31;
const BUSY: u64 = 1 << 16;

/// How much of an operation takes place.
enum Share {
    None,
    Part,
    All,
}

/// What a store or a start did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Touched {
    /// Nothing of the array's.
    Nothing,
    /// An erase began.
    EraseBegan,
    /// A store that the chip would refuse: locked, not in programming mode, or of another width than set.
    Refused,
}

/// Where in a flash operation the supply fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CutAt {
    /// Just before it.
    Before,
    /// Within: a store has cleared some of its bits, an erase has done half of its sector.
    Within,
    /// Just after it.
    After,
}

#[derive(Debug, Default)]
pub(super) struct Array {
    /// First byte and length of what is being erased.
    erasing: Option<(u64, u64)>,
    /// Stores and erases since power-up.
    operations: u64,
    /// The supply fails at this operation.
    failing: Option<(u64, CutAt)>,
    /// It has: the array does not change any more.
    failed: bool,
}

impl Array {
    pub(super) fn operations(&self) -> u64 {
        self.operations
    }

    pub(super) fn has_failed(&self) -> bool {
        self.failed
    }

    pub(super) fn fail(&mut self, at: CutAt, operation: u64) {
        self.failing = Some((operation, at));
    }

    /// Counts an operation; how much of it takes place.
    fn begin(&mut self) -> Share {
        if self.failed {
            return Share::None;
        }
        let number = self.operations;
        self.operations += 1;
        match self.failing {
            Some((operation, at)) if operation == number => {
                self.failed = true;
                match at {
                    CutAt::Before => Share::None,
                    CutAt::Within => Share::Part,
                    CutAt::After => Share::All,
                }
            }
            _ => Share::All,
        }
    }

    /// An access has settled. `control` is the control register now, `status` the status register.
    pub(super) fn settled(
        &mut self,
        access: &Access,
        value: u64,
        (control, status): (u64, u64),
        host: &mut dyn Host,
    ) -> Touched {
        let in_array = (FLASH_BASE..FLASH_BASE + FLASH_BYTES).contains(&access.address);
        match (access.kind, access.address) {
            (AccessKind::Write, _) if in_array => self.program(access, control, host),
            (AccessKind::Write, CONTROL) if access.value & STRT != 0 && status & BUSY != 0 => {
                self.erasing = region(access.value).map(|(first, bytes)| match self.begin() {
                    Share::None => (first, 0),
                    Share::Part => (first, bytes / 2),
                    Share::All => (first, bytes),
                });
                Touched::EraseBegan
            }
            (AccessKind::Read, STATUS) if value & BUSY == 0 => {
                if let Some((first, bytes)) = self.erasing.take() {
                    erase(first, bytes, host);
                }
                Touched::Nothing
            }
            _ => Touched::Nothing,
        }
    }

    /// The part restarts or loses its supply: an erase under way stops half done.
    pub(super) fn cut(&mut self, host: &mut dyn Host) {
        if let Some((first, bytes)) = self.erasing.take() {
            erase(first, bytes / 2, host);
        }
    }

    fn program(&mut self, access: &Access, control: u64, host: &mut dyn Host) -> Touched {
        let width = match (control >> 8) & 3 {
            0 => Width::W8,
            1 => Width::W16,
            2 => Width::W32,
            _ => Width::W64,
        };
        if control & LOCK != 0 || control & PG == 0 || access.width != width {
            return Touched::Refused;
        }
        let old = host.read(access.address, access.width).unwrap_or(0);
        let stored = match self.begin() {
            Share::None => old,
            // Which bits are quick and which slow differs from store to store.
            Share::Part => {
                old & (access.value | self.operations.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 16)
            }
            Share::All => old & access.value,
        };
        let _ = host.program(access.address, access.width, stored);
        Touched::Nothing
    }
}

fn region(control: u64) -> Option<(u64, u64)> {
    if control & MER != 0 {
        return Some((FLASH_BASE, FLASH_BYTES));
    }
    let sector = usize::try_from((control >> 3) & 0xF).ok()?;
    if control & SER == 0 || sector >= SECTOR_BYTES.len() {
        return None;
    }
    let offset: u64 = SECTOR_BYTES[..sector].iter().sum();
    Some((FLASH_BASE + offset, SECTOR_BYTES[sector]))
}

fn erase(first: u64, bytes: u64, host: &mut dyn Host) {
    for address in (first..first + bytes).step_by(4) {
        let _ = host.program(address, Width::W32, u64::from(u32::MAX));
    }
}

/// The whole array, as a programmer would read it out.
pub(super) fn read_out(host: &mut dyn Host) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(FLASH_BYTES as usize);
    for address in (FLASH_BASE..FLASH_BASE + FLASH_BYTES).step_by(4) {
        let word = host
            .read(address, Width::W32)
            .unwrap_or(u64::from(u32::MAX));
        bytes.extend_from_slice(&(word as u32).to_le_bytes());
    }
    bytes
}
