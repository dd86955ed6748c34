//! State that survives a reset: the number of starts, a latched E-stop, the last words. After a power cut the RAM
//! holds anything.

use device::{
    identity::reset_cause,
    last_words::{Draft, LONGEST, of_a_panic},
    retained::{
        EStop, Retained, WORDS, Words, keep_clock_failed, keep_last_words, keep_latched, pass_on,
        start,
    },
};
use proptest::prelude::*;
use protocol::system::ResetCause;

/// The RAM that survives a reset.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Ram(Vec<u32>);

impl Ram {
    fn blank() -> Self {
        Self(vec![0; WORDS])
    }
}

impl Words for Ram {
    fn get(&self, index: usize) -> u32 {
        self.0[index]
    }

    fn set(&mut self, index: usize, value: u32) {
        self.0[index] = value;
    }
}

fn text(previous: &Retained) -> Option<&str> {
    previous.last_words.as_deref()
}

#[test]
fn starts_are_counted_from_one() {
    let mut ram = Ram::blank();
    for number in 1..=5 {
        let previous = Retained {
            boot_id: number,
            last_words: None,
            latched: None,
            clock_failed: false,
            cause: None,
        };
        assert_eq!(start(&mut ram), previous);
    }
    // The counter is the word that changes.
    let before = ram.clone();
    start(&mut ram);
    let counter = (0..WORDS).find(|index| ram.0[*index] != before.0[*index]);
    ram.set(counter.unwrap(), u32::MAX);
    assert_eq!(start(&mut ram).boot_id, 0, "after 4,294,967,295 starts");
    assert_eq!(start(&mut ram).boot_id, 1);
}

#[test]
fn an_emergency_stop_stays_latched_until_it_is_forgotten() {
    let mut ram = Ram::blank();
    start(&mut ram);
    for estop in [EStop::Loop, EStop::Frame, EStop::Loop] {
        keep_latched(&mut ram, Some(estop));
        for _ in 0..3 {
            assert_eq!(start(&mut ram).latched, Some(estop));
        }
    }
    keep_latched(&mut ram, None);
    assert_eq!(start(&mut ram).latched, None);
}

/// The words in RAM that mark a latched E-stop and an earlier start.
#[test]
fn a_latched_stop_counts_only_with_a_start_before() {
    for estop in [EStop::Loop, EStop::Frame] {
        let mut ram = Ram::blank();
        keep_latched(&mut ram, Some(estop));
        // After power-on the mark is a random content of the RAM.
        assert_eq!(start(&mut ram).latched, None);
        assert_eq!(start(&mut ram).latched, None, "nor later");
    }
}

#[test]
fn last_words_are_told_once() {
    let mut ram = Ram::blank();
    start(&mut ram);
    keep_last_words(&mut ram, b"tasks/link.rs:1");
    keep_latched(&mut ram, Some(EStop::Frame));
    let previous = start(&mut ram);
    assert_eq!(text(&previous), Some("tasks/link.rs:1"));
    assert!(previous.boot_id == 2 && previous.latched == Some(EStop::Frame));
    assert_eq!(start(&mut ram).last_words, None);
    // Shorter last words do not end in the rest of longer ones.
    keep_last_words(&mut ram, b"oh");
    assert_eq!(text(&start(&mut ram)), Some("oh"));
    keep_last_words(&mut ram, b"");
    assert_eq!(text(&start(&mut ram)), Some(""));
}

#[test]
fn only_a_reset_by_itself_with_last_words_is_a_panic() {
    use ResetCause::*;
    let silent = start(&mut Ram::blank());
    let mut ram = Ram::blank();
    keep_last_words(&mut ram, b"oh");
    let reported = start(&mut ram);
    for cause in [PowerOn, Pin, Panic, Watchdog, Software] {
        assert_eq!(reset_cause(cause, &silent), cause);
        let expected = if cause == Software { Panic } else { cause };
        assert_eq!(reset_cause(cause, &reported), expected);
    }
}

/// A start that resets the chip again on purpose passes everything on to the next start, once: words, E-stop, failed
/// clock, and its own cause.
#[test]
fn a_start_that_takes_the_place_of_another_is_told_what_that_one_was() {
    use ResetCause::*;
    for cause in [PowerOn, Pin, Panic, Watchdog, Software] {
        for (words, estop, failed) in [(true, None, true), (false, Some(EStop::Loop), false)] {
            let mut ram = Ram::blank();
            start(&mut ram);
            keep_latched(&mut ram, estop);
            if words {
                keep_last_words(&mut ram, b"oh");
            }
            if failed {
                keep_clock_failed(&mut ram);
            }
            let before = start(&mut ram);
            pass_on(&mut ram, &before, cause);
            let after = start(&mut ram);
            let expected = Retained {
                boot_id: before.boot_id + 1,
                cause: Some(cause),
                ..before
            };
            assert_eq!(after, expected);
            assert_eq!(reset_cause(Software, &after), cause);
            // Another reset came between: that one is the cause.
            assert_eq!(reset_cause(Watchdog, &after), Watchdog);
            assert_eq!(start(&mut ram).cause, None);
        }
    }
}

/// The end of a long file name, and only whole addresses.
#[test]
fn a_panic_leaves_place_message_and_callers() {
    let callers = [0x0801_2AF0, 0x0801_0000, 0];
    let words = |file: &str, message: &str| {
        let Draft(words) = of_a_panic(file, 7, message, callers.iter().copied().cycle());
        words.as_str().to_owned()
    };
    assert_eq!(
        words("motion/src/run.rs", "attempt to add with overflow"),
        "panic at motion/src/run.rs:7: attempt to add with overflow, called from 0x8012af0 0x8010000 0x0 0x8012af0 0x8010000"
    );
    let long = words(&"x/".repeat(100), "oh");
    let expected = format!("panic at {}:7: oh, called from 0x8012af0", "x/".repeat(20));
    assert!(long.starts_with(&expected), "{long}");
    for message in 0..2 * LONGEST {
        let words = words("a.rs", &"m".repeat(message));
        assert!(words.len() <= LONGEST);
        let (_, reported) = words.split_once(", called from").unwrap_or_default();
        for address in reported.split_whitespace() {
            let address = u32::from_str_radix(&address[2..], 16).expect(&words);
            assert!(callers.contains(&address), "{words}");
        }
    }
}

/// The next image may be a different one: it has to find the words where this one left them.
#[test]
fn the_layout_stays() {
    let mut ram = Ram::blank();
    start(&mut ram);
    keep_latched(&mut ram, Some(EStop::Loop));
    let text = b"tasks/link.rs:12";
    keep_last_words(&mut ram, text);
    let head = [0x5245_5430, 1, 0x5245_5431, 0x5245_5430, 16, 0xC578_7616];
    assert_eq!(ram.0[..6], head);
    let letters: Vec<_> = text.iter().map(|letter| u32::from(*letter)).collect();
    assert_eq!(ram.0[6..22], letters);
    keep_latched(&mut ram, Some(EStop::Frame));
    assert_eq!(ram.0[2], 0x5245_5432);
    assert_eq!(WORDS, 128);
}

proptest! {
    /// RAM after power-on: the start counts as the first one, nothing is latched, there is nothing to report, and
    /// later starts are normal.
    #[test]
    fn a_ram_of_noise_says_nothing(noise in prop::collection::vec(any::<u32>(), WORDS)) {
        let mut ram = Ram(noise);
        let first = Retained { boot_id: 1, last_words: None, latched: None, clock_failed: false, cause: None };
        prop_assert_eq!(start(&mut ram), first);
        prop_assert_eq!(start(&mut ram).boot_id, 2);
    }

    #[test]
    fn any_text_comes_back(bytes in prop::collection::vec(any::<u8>(), 0..2 * LONGEST)) {
        let mut ram = Ram::blank();
        keep_last_words(&mut ram, &bytes);
        let reported = start(&mut ram).last_words.unwrap();
        // Characters that are not ASCII lose their highest bit.
        let ascii: Vec<u8> = bytes.iter().take(LONGEST).map(|byte| byte & 0x7F).collect();
        prop_assert_eq!(reported.as_bytes(), ascii.as_slice());
    }

    /// A supply that fails for a moment flips bits: last words are reported unchanged or not at all.
    #[test]
    fn damaged_last_words_are_not_told(
        words in "[ -~]{0,120}",
        flips in prop::collection::vec((0..WORDS, 0..32_u32), 1..4),
    ) {
        let mut ram = Ram::blank();
        start(&mut ram);
        keep_last_words(&mut ram, words.as_bytes());
        for (index, bit) in flips {
            ram.0[index] ^= 1 << bit;
        }
        if let Some(reported) = text(&start(&mut ram)) {
            prop_assert_eq!(reported, words);
        }
    }
}

/// A single flipped bit in any letter of any text is noticed.
#[test]
fn last_words_with_a_wrong_bit_are_not_told() {
    let words = "panic, called from 0x801a2b4 0x80107c0 0x8012f3e";
    let mut kept = Ram::blank();
    start(&mut kept);
    keep_last_words(&mut kept, words.as_bytes());
    assert_eq!(text(&start(&mut kept.clone())), Some(words));
    let first = (0..WORDS).find(|index| kept.0[*index] == u32::from(b'p'));
    let first = first.expect("the text lies in RAM, one letter per word");
    for index in first..first + words.len() {
        for bit in 0..32 {
            let mut tipped = kept.clone();
            tipped.0[index] ^= 1 << bit;
            assert_eq!(text(&start(&mut tipped)), None, "letter {index}, bit {bit}");
        }
    }
}

/// Reported once, and not after the supply was off.
#[test]
fn a_clock_that_failed_is_told_once() {
    let mut ram = Ram::blank();
    assert!(!start(&mut ram).clock_failed);
    keep_clock_failed(&mut ram);
    assert!(start(&mut ram).clock_failed);
    assert!(!start(&mut ram).clock_failed);
}
