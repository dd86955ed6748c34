//! The flash array behind the emulated interface. A store clears bits, an erase sets them. A cut in the middle leaves
//! some of the bits, or half of the sector, unchanged.

use rigless::emulator::{Access, AccessKind, Host};
use rigless::soc::Width;

use super::map::{FLASH_BASE, FLASH_BYTES, SECTOR_BYTES};

/// The sectors that an image may change: 1 to 3. The others hold the image itself.
const SETTINGS: std::ops::Range<u64> = FLASH_BASE + (16 << 10)..FLASH_BASE + (64 << 10);
/// Most foreign changes whose addresses are kept.
const FOREIGN: usize = 16;

/// The interface's control register (RM0383 section 3.8.5).
const CONTROL: u64 = 0x4002_3C10;
const PG: u64 = 1 << 0;
const SER: u64 = 1 << 1;
const MER: u64 = 1 << 2;
const STRT: u64 = 1 << 16;
const LOCK: u64 = 1 << 31;
pub(super) const BUSY: u64 = 1 << 16;

/// How much of an operation is completed.
enum Progress {
    None,
    Part,
    All,
}

/// Effect of a write access on the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Effect {
    /// It did not address the flash.
    Nothing,
    /// A store has begun, or would have begun without the power cut.
    Stored,
    /// An erase has begun.
    EraseBegan,
    /// The chip would refuse this store: locked, not in programming mode, or of the wrong width.
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
    /// First byte and length of the sector being erased.
    erasing: Option<(u64, u64)>,
    /// Stores and erases since power-up.
    operations: u64,
    /// The supply fails at the operation with this number.
    failing: Option<(u64, CutAt)>,
    /// The supply has failed: the array no longer changes.
    failed: bool,
    /// Addresses outside the settings' sectors that the image changed.
    foreign: Vec<u64>,
}

impl Array {
    pub(super) fn operations(&self) -> u64 {
        self.operations
    }

    pub(super) fn has_failed(&self) -> bool {
        self.failed
    }

    /// The first addresses outside the settings' sectors that the image changed.
    pub(super) fn foreign(&self) -> &[u64] {
        &self.foreign
    }

    pub(super) fn fail(&mut self, at: CutAt, operation: u64) {
        self.failing = Some((operation, at));
    }

    /// Counts an operation and returns how much of it is completed.
    fn begin(&mut self) -> Progress {
        if self.failed {
            return Progress::None;
        }
        let number = self.operations;
        self.operations += 1;
        match self.failing {
            Some((operation, at)) if operation == number => {
                self.failed = true;
                match at {
                    CutAt::Before => Progress::None,
                    CutAt::Within => Progress::Part,
                    CutAt::After => Progress::All,
                }
            }
            _ => Progress::All,
        }
    }

    fn judge(&mut self, first: u64, bytes: u64) {
        let own = SETTINGS.start <= first && first + bytes <= SETTINGS.end;
        if !own && self.foreign.len() < FOREIGN && !self.foreign.contains(&first) {
            self.foreign.push(first);
        }
    }

    /// Handles a settled access, with the control and status registers as they are now.
    pub(super) fn settled(
        &mut self,
        access: &Access,
        (control, status): (u64, u64),
        host: &mut dyn Host,
    ) -> Effect {
        if access.kind != AccessKind::Write {
            return Effect::Nothing;
        }
        match access.address {
            address if (FLASH_BASE..FLASH_BASE + FLASH_BYTES).contains(&address) => {
                self.program(access, control, host)
            }
            CONTROL if access.value & STRT != 0 && status & BUSY != 0 => {
                if let Some((first, bytes)) = region(access.value) {
                    self.judge(first, bytes);
                    let bytes = match self.begin() {
                        Progress::None => 0,
                        Progress::Part => bytes / 2,
                        Progress::All => bytes,
                    };
                    self.erasing = Some((first, bytes));
                }
                Effect::EraseBegan
            }
            _ => Effect::Nothing,
        }
    }

    /// Completes an erase when the interface is no longer busy.
    pub(super) fn finish(&mut self, host: &mut dyn Host) {
        if let Some((first, bytes)) = self.erasing.take() {
            erase(first, bytes, host);
        }
    }

    /// Leaves an erase half done, when the part is reset or loses its supply.
    pub(super) fn cut(&mut self, host: &mut dyn Host) {
        if let Some((first, bytes)) = self.erasing.take() {
            erase(first, bytes / 2, host);
        }
    }

    fn program(&mut self, access: &Access, control: u64, host: &mut dyn Host) -> Effect {
        let width = match (control >> 8) & 3 {
            0 => Width::W8,
            1 => Width::W16,
            2 => Width::W32,
            _ => Width::W64,
        };
        if control & LOCK != 0 || control & PG == 0 || access.width != width {
            return Effect::Refused;
        }
        self.judge(access.address, u64::from(access.width.bytes()));
        let old = host.read(access.address, access.width).unwrap_or(0);
        let stored = match self.begin() {
            Progress::None => old,
            // Vary the bits that change before the cut from store to store.
            Progress::Part => {
                old & (access.value | self.operations.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 16)
            }
            Progress::All => old & access.value,
        };
        let _ = host.program(access.address, access.width, stored);
        Effect::Stored
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

/// Contents of the whole array.
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

#[cfg(test)]
mod tests {
    use rigless::device::Level;
    use rigless::emulator::{Error, InterruptLine, Memory};

    use super::*;

    /// Words of a flash; those never stored are erased.
    #[derive(Default)]
    struct Words(std::collections::BTreeMap<u64, u64>);

    impl Memory for Words {
        fn read(&mut self, address: u64, _: Width) -> Result<u64, Error> {
            Ok(self.0.get(&address).copied().unwrap_or(ERASED))
        }

        fn write(&mut self, address: u64, width: Width, _: u64) -> Result<(), Error> {
            Err(Error::Memory { address, width })
        }

        fn program(&mut self, address: u64, _: Width, value: u64) -> Result<(), Error> {
            self.0.insert(address, value);
            Ok(())
        }
    }

    impl Host for Words {
        fn set_interrupt(&mut self, _: InterruptLine, _: Level) {}
        fn request_reset(&mut self) {}
    }

    const ERASED: u64 = 0xFFFF_FFFF;
    /// Word-wise stores, unlocked.
    const STORES: u64 = PG | 2 << 8;
    const PLACE: u64 = FLASH_BASE + (16 << 10);

    #[derive(Default)]
    struct Chip {
        array: Array,
        words: Words,
    }

    impl Chip {
        fn store_with(&mut self, control: u64, width: Width, address: u64, value: u64) -> Effect {
            let access = Access::new(AccessKind::Write, address, width, value);
            self.array.settled(&access, (control, 0), &mut self.words)
        }

        fn store(&mut self, address: u64, value: u64) {
            let effect = self.store_with(STORES, Width::W32, address, value);
            assert_eq!(effect, Effect::Stored);
        }

        fn begin_erase(&mut self, control: u64) {
            let access = Access::new(AccessKind::Write, CONTROL, Width::W32, control | STRT);
            let effect = self.array.settled(&access, (0, BUSY), &mut self.words);
            assert_eq!(effect, Effect::EraseBegan);
        }

        fn erase(&mut self, sector: u64) {
            self.begin_erase(SER | sector << 3);
            self.array.finish(&mut self.words);
        }

        fn at(&mut self, address: u64) -> u64 {
            self.words.read(address, Width::W32).expect("a word")
        }

        /// A chip whose sector 1 and its neighbours hold zeros at their first and last words.
        fn written() -> Self {
            let mut chip = Self::default();
            for address in Self::ENDS {
                chip.store(address, 0);
            }
            chip
        }

        const ENDS: [u64; 4] = [
            PLACE,
            PLACE + (8 << 10) - 4,
            PLACE + (16 << 10) - 4,
            PLACE + (16 << 10),
        ];

        fn ends(&mut self) -> [bool; 4] {
            Self::ENDS.map(|address| self.at(address) == ERASED)
        }
    }

    #[test]
    fn a_store_only_clears_bits() {
        let mut chip = Chip::default();
        chip.store(PLACE, 0xFFFF_0000);
        chip.store(PLACE, 0x0F0F_0F0F);
        assert_eq!(chip.at(PLACE), 0x0F0F_0000);
        chip.store(PLACE, ERASED);
        assert_eq!(chip.at(PLACE), 0x0F0F_0000);
        assert_eq!(
            (chip.array.operations(), chip.array.foreign().len()),
            (3, 0)
        );
    }

    #[test]
    fn an_erase_sets_its_sector_and_no_other() {
        let mut chip = Chip::written();
        chip.begin_erase(SER | 1 << 3);
        assert_eq!(chip.ends(), [false; 4], "it takes its time");
        chip.array.finish(&mut chip.words);
        assert_eq!(chip.ends(), [true, true, true, false]);
        assert_eq!(chip.array.operations(), 5);
    }

    #[test]
    fn a_store_the_interface_is_not_ready_for_does_nothing() {
        let mut chip = Chip::default();
        for (control, width) in [
            (STORES | LOCK, Width::W32),
            (STORES & !PG, Width::W32),
            (STORES, Width::W8),
        ] {
            let effect = chip.store_with(control, width, PLACE, 0);
            assert_eq!(effect, Effect::Refused);
        }
        assert_eq!((chip.at(PLACE), chip.array.operations()), (ERASED, 0));
    }

    #[test]
    fn a_cut_store_leaves_the_old_bits_or_the_new_ones_or_some() {
        let (old, value) = (0xFF00_FFFF, 0x1234_5678);
        let mut partial = 0;
        for at in [CutAt::Before, CutAt::Within, CutAt::After] {
            for number in 0..32 {
                let mut chip = Chip::default();
                for n in 0..number {
                    chip.store(PLACE + 4 + 4 * n, 0);
                }
                chip.store(PLACE, old);
                chip.array.fail(at, number + 1);
                assert!(!chip.array.has_failed());
                chip.store(PLACE, value);
                assert!(chip.array.has_failed());
                let content = chip.at(PLACE);
                match at {
                    CutAt::Before => assert_eq!(content, old),
                    CutAt::Within => {
                        assert_eq!(
                            (content & old, content & (old & value)),
                            (content, old & value)
                        );
                        partial += u32::from(content != old && content != old & value);
                    }
                    CutAt::After => assert_eq!(content, old & value),
                }
                // Without a supply nothing changes.
                chip.store(PLACE, 0);
                chip.erase(1);
                assert_eq!(
                    (chip.at(PLACE), chip.array.operations()),
                    (content, number + 2)
                );
            }
        }
        assert!(partial > 20, "{partial} of 32 in between");
    }

    #[test]
    fn a_cut_erase_leaves_all_or_half_or_none() {
        for (at, expected) in [
            (CutAt::Before, [false; 4]),
            (CutAt::Within, [true, true, false, false]),
            (CutAt::After, [true, true, true, false]),
        ] {
            let mut chip = Chip::written();
            chip.array.fail(at, 4);
            chip.erase(1);
            assert!(chip.array.has_failed());
            assert_eq!(chip.ends(), expected, "{at:?}");
            chip.store(PLACE, 0);
            assert_eq!(chip.ends(), expected, "{at:?}");
        }
    }

    #[test]
    fn a_reset_within_an_erase_leaves_half() {
        let mut chip = Chip::written();
        chip.begin_erase(SER | 1 << 3);
        chip.array.cut(&mut chip.words);
        chip.array.finish(&mut chip.words);
        assert_eq!(chip.ends(), [true, true, false, false]);
    }

    #[test]
    fn changes_of_the_image_itself_are_kept_against_it() {
        let mut chip = Chip::default();
        for own in [SETTINGS.start, SETTINGS.end - 4] {
            chip.store(own, 0);
        }
        (1..=3).for_each(|sector| chip.erase(sector));
        assert!(chip.array.foreign().is_empty());
        chip.store(SETTINGS.end, 0);
        chip.store(SETTINGS.start - 4, 0);
        chip.erase(0);
        chip.erase(5);
        chip.begin_erase(MER);
        let expected = [
            SETTINGS.end,
            SETTINGS.start - 4,
            FLASH_BASE,
            FLASH_BASE + (128 << 10),
        ];
        assert_eq!(chip.array.foreign(), expected);
    }
}
