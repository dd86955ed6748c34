//! A model in memory of the STM32L412's flash: double words with a check code, pages, and a supply that can fail
//! meanwhile.

// Each test file uses only a part of it.
#![allow(dead_code)]

use device::{
    double_words::{DOUBLE_WORD, DoubleWords, PAGE, Sectors},
    store::SECTORS,
};
use embedded_storage_async::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
pub use simulated_machines::chip::{Cut, Error, Operation, Random, Supply};
use std::{
    ops::Range,
    sync::{Arc, Mutex, MutexGuard},
};

/// State of a double word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum State {
    Blank,
    Programmed,
    /// Its check code is wrong.
    Unreadable,
    /// Reads as blank, but accepts nothing except zeros.
    Stuck,
}

impl State {
    const ALL: [Self; 4] = [Self::Blank, Self::Programmed, Self::Unreadable, Self::Stuck];
}

#[derive(Debug)]
struct Array {
    bytes: Vec<u8>,
    states: Vec<State>,
    supply: Supply,
}

/// The double words of a flash; clones share them.
#[derive(Clone, Debug)]
struct Cells(Arc<Mutex<Array>>);

/// The flash as the store sees it; clones share its content.
#[derive(Clone, Debug)]
pub struct Flash(Sectors<Cells>);

const SIZE: usize = SECTORS.end as usize;

impl Flash {
    pub fn blank() -> Self {
        Self::holding(vec![0xFF; SIZE])
    }

    /// A flash after a start, with this content: bytes alone, or followed by the states as from [`Flash::bytes`].
    pub fn holding(mut bytes: Vec<u8>) -> Self {
        let states = bytes.split_off(SIZE);
        assert!([0, SIZE / DOUBLE_WORD].contains(&states.len()));
        let states = bytes
            .chunks(DOUBLE_WORD)
            .enumerate()
            .map(|(index, double_word)| {
                let blank = double_word == [0xFF; DOUBLE_WORD];
                match states
                    .get(index)
                    .map(|state| State::ALL[usize::from(*state)])
                {
                    Some(State::Blank) | None if blank => State::Blank,
                    Some(State::Blank) | None => State::Programmed,
                    Some(state) => state,
                }
            })
            .collect();
        Self(Sectors(Cells(Arc::new(Mutex::new(Array {
            bytes,
            states,
            supply: Supply::new(),
        })))))
    }

    fn array(&self) -> MutexGuard<'_, Array> {
        self.0.0.0.lock().unwrap()
    }

    /// The content, followed by the state of each double word.
    pub fn bytes(&self) -> Vec<u8> {
        let array = self.array();
        let states = array.states.iter().map(|state| *state as u8);
        array.bytes.iter().copied().chain(states).collect()
    }

    /// Writes and page erasures since the start.
    pub fn operations(&self) -> Vec<Operation> {
        self.array().supply.operations.clone()
    }

    /// Makes the supply fail in the operation after `after` more.
    pub fn cut(&self, after: usize, cut: Cut, seed: u64) {
        self.array().supply.cut(after, cut, seed);
    }

    pub fn wear(&self) {
        self.fail(0..usize::MAX);
    }

    /// Makes these operations fail, counted from now on.
    pub fn fail(&self, failing: Range<usize>) {
        self.array().supply.fail(failing);
    }

    /// Makes the first blank double word behind `from` impossible to program; reading does not show that.
    pub fn stick(&self, from: u32) {
        let mut array = self.array();
        let from = from as usize / DOUBLE_WORD;
        let blank = |state: &State| *state == State::Blank;
        let index = from + array.states[from..].iter().position(blank).unwrap();
        array.states[index] = State::Stuck;
    }

    /// Number of unreadable double words.
    pub fn unreadable(&self) -> usize {
        let unreadable = |state: &&State| **state == State::Unreadable;
        self.array().states.iter().filter(unreadable).count()
    }
}

impl Array {
    fn put(&mut self, index: usize, bytes: [u8; DOUBLE_WORD], state: State) {
        self.bytes[index * DOUBLE_WORD..][..DOUBLE_WORD].copy_from_slice(&bytes);
        self.states[index] = state;
    }

    fn get(&self, index: usize) -> [u8; DOUBLE_WORD] {
        let bytes = &self.bytes[index * DOUBLE_WORD..][..DOUBLE_WORD];
        bytes.try_into().unwrap()
    }

    /// Leaves a double word as an interrupted operation might: anything between `bytes` and blank, with a check code
    /// that is right or wrong.
    /// not.
    fn leave_torn(&mut self, index: usize, bytes: [u8; DOUBLE_WORD]) {
        let noise = self.supply.noise.next().to_le_bytes();
        let mut torn = bytes;
        for (byte, noise) in torn.iter_mut().zip(noise) {
            *byte |= noise;
        }
        match self.supply.noise.below(4) {
            0 => self.put(index, [0xFF; DOUBLE_WORD], State::Blank),
            1 => self.put(index, torn, State::Programmed),
            _ => self.put(index, torn, State::Unreadable),
        }
    }
}

impl DoubleWords for Cells {
    type Error = Error;

    fn read(&mut self, offset: u32) -> Option<[u8; DOUBLE_WORD]> {
        assert!(SECTORS.contains(&offset) && offset.is_multiple_of(DOUBLE_WORD as u32));
        let array = self.0.lock().unwrap();
        let index = offset as usize / DOUBLE_WORD;
        (array.states[index] != State::Unreadable).then(|| array.get(index))
    }

    fn program(&mut self, offset: u32, bytes: [u8; DOUBLE_WORD]) -> Result<(), Error> {
        assert!(SECTORS.contains(&offset) && offset.is_multiple_of(DOUBLE_WORD as u32));
        let mut array = self.0.lock().unwrap();
        let cut = array.supply.begin(Operation::Write { offset, words: 2 })?;
        let index = offset as usize / DOUBLE_WORD;
        let zeros = bytes == [0; DOUBLE_WORD];
        if array.states[index] == State::Stuck && !zeros {
            return Err(Error::Worn);
        }
        let blank = array.states[index] == State::Blank;
        assert!(
            blank || zeros,
            "a double word is programmed twice at {offset:#x}"
        );
        match cut {
            Cut::Before => {}
            Cut::After => array.put(index, bytes, State::Programmed),
            _ => array.leave_torn(index, bytes),
        }
        array.supply.end()
    }

    fn erase(&mut self, page: u32) -> Result<(), Error> {
        assert!(SECTORS.contains(&page) && page.is_multiple_of(PAGE));
        let mut array = self.0.lock().unwrap();
        let cut = array.supply.begin(Operation::Erase { sector: page })?;
        let count = PAGE as usize / DOUBLE_WORD;
        let first = page as usize / DOUBLE_WORD;
        let blank = match cut {
            Cut::Before => return array.supply.end(),
            Cut::After => 0..count,
            Cut::BlankAtBothEnds => 0..0,
            Cut::Within { done, .. } => 0..done.min(4) * count / 4,
        };
        for within in 0..count {
            let index = first + within;
            let ends = cut == Cut::BlankAtBothEnds && [0, count - 1].contains(&within);
            if blank.contains(&within) || ends {
                array.put(index, [0xFF; DOUBLE_WORD], State::Blank);
            } else {
                let bytes = array.get(index);
                array.leave_torn(index, bytes);
            }
        }
        array.supply.end()
    }
}

impl ErrorType for Flash {
    type Error = Error;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = Sectors::<Cells>::READ_SIZE;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Error> {
        self.array().supply.end()?;
        self.0.read(offset, bytes).await
    }

    fn capacity(&self) -> usize {
        self.0.capacity()
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = Sectors::<Cells>::WRITE_SIZE;
    const ERASE_SIZE: usize = Sectors::<Cells>::ERASE_SIZE;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Error> {
        self.0.erase(from, to).await
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        self.0.write(offset, bytes).await
    }
}
