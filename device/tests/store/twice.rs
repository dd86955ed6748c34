//! Two cuts of the supply: one in a change, and one in the next change after it, each in every operation and in every
//! way. The first one may leave a log that no undisturbed device ever has.

use device::store::StorageFailed;
use protocol::settings::SettingKey;

use super::chip::{Cut, Flash};
use super::log::{Content, OLD, Store, long_name, name, start, young};

/// A change of the content.
#[derive(Clone, Copy, Debug)]
enum Change {
    Set(SettingKey, u32),
    Name(&'static str),
    LongName(u32),
    Reset,
}

impl Change {
    fn make(self, store: &mut Store) -> Result<(), StorageFailed> {
        match self {
            Self::Set(key, value) => store.set(key, value),
            Self::Name(text) => store.set_name(name(text)),
            Self::LongName(number) => store.set_name(long_name(number)),
            Self::Reset => store.reset(),
        }
    }

    /// The content after this change of `before`.
    fn on(self, before: &Content) -> Content {
        let mut after = before.clone();
        match self {
            Self::Set(key, value) => after.values = before.values.with(key, value).unwrap(),
            Self::Name(text) => after.name = text.to_owned(),
            Self::LongName(number) => after.name = long_name(number).as_str().to_owned(),
            Self::Reset => after = Content::default(),
        }
        after
    }
}

/// A flash on which this change was cut in its operation `number`; none if it has no such operation.
fn cut(image: &[u8], change: Change, number: usize, cut: Cut) -> Option<Vec<u8>> {
    let flash = Flash::holding(image.to_vec());
    let mut store = start(&flash);
    flash.cut(number, cut, number as u64);
    let done = change.make(&mut store);
    // A change that is not cut has succeeded, and has no more operations.
    (done.is_err() || flash.operations().len() > number).then(|| flash.bytes())
}

/// The content is that of before or of after.
fn check(image: &[u8], before: &Content, change: Change, context: &str) -> Content {
    let found = Content::of(&start(&Flash::holding(image.to_vec())));
    assert!(
        found == *before || found == change.on(before),
        "{context}: {found:?}"
    );
    found
}

/// Cuts `first` everywhere, and `second` everywhere on what each of these has left. Returns the number of pairs.
fn cut_twice(image: &[u8], first: Change, second: Change) -> usize {
    let before = Content::of(&start(&Flash::holding(image.to_vec())));
    let mut pairs = 0;
    for one in 0.. {
        let images = Cut::ALL.map(|way| (way, cut(image, first, one, way)));
        if images.iter().all(|(_, image)| image.is_none()) {
            break;
        }
        for (way, image) in images {
            let Some(image) = image else { continue };
            let context = format!("{first:?}, {way:?} in {one}");
            let found = check(&image, &before, first, &context);
            for other in 0.. {
                let images = Cut::ALL.map(|way| (way, cut(&image, second, other, way)));
                if images.iter().all(|(_, image)| image.is_none()) {
                    break;
                }
                for (way, image) in images {
                    let Some(image) = image else { continue };
                    let context = format!("{context}; {second:?}, {way:?} in {other}");
                    let found = check(&image, &found, second, &context);
                    writes(&image, &found, &context);
                    pairs += 1;
                }
            }
        }
    }
    pairs
}

/// The flash takes a further change and keeps everything else.
fn writes(image: &[u8], found: &Content, context: &str) {
    let flash = Flash::holding(image.to_vec());
    let change = Change::Set(SettingKey::PullOffUm, 999);
    change.make(&mut start(&flash)).expect(context);
    let again = Content::of(&start(&Flash::holding(flash.bytes())));
    assert_eq!(again, change.on(found), "{context}");
}

const SMALL: [Change; 4] = [
    Change::Set(SettingKey::FlagUm, 1_234),
    // A value whose last bytes look blank.
    Change::Set(SettingKey::ButtonTotalMs, 0x00FF_FFFF),
    Change::Name("right bench"),
    Change::LongName(7),
];

#[test]
fn two_cuts_lose_no_more_than_their_changes() {
    let mut pairs = 0;
    for image in [Flash::blank().bytes(), young()] {
        for first in SMALL {
            for second in SMALL {
                pairs += cut_twice(&image, first, second);
            }
        }
    }
    assert!(pairs > 1_000, "{pairs}");
}

/// The log is about to drop a sector, which has settings of long ago.
#[test]
fn two_cuts_while_a_sector_is_dropped_lose_no_more_than_their_changes() {
    let (image, number) = OLD.clone();
    let next = Change::LongName(number);
    for second in [next, SMALL[0]] {
        assert!(cut_twice(&image, next, second) > 100);
    }
}

/// A reset that is cut, and done again; or another change after it.
#[test]
fn two_cuts_around_a_reset_leave_everything_or_only_defaults() {
    for second in [Change::Reset, SMALL[0]] {
        assert!(cut_twice(&young(), Change::Reset, second) > 100);
    }
}
