//! The settings' log in flash: its content, and what a failing supply leaves of it. The supply is cut before, within
//! and after every write and erasure of a change.

use super::chip::{Cut, Flash, Operation};
use device::{
    settings::{SettingsStore, Values},
    store::{self, Ages, DEFAULTS_RECORD, NAME_RECORD, SECTOR, SECTORS, StorageFailed},
};
use embedded_storage_async::nor_flash::NorFlash as _;
use proptest::prelude::*;
use protocol::settings::{MAX_NAME, SettingKey};
use simulated_machines::dice::Dice;
use std::sync::LazyLock;

pub type Store = SettingsStore<Flash>;
/// The log without settings.
type Log = store::Store<Flash>;

/// The content that a device finds when it starts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Content {
    pub values: Values,
    pub name: String,
}

impl Content {
    pub fn of(store: &Store) -> Self {
        Self {
            values: *store.values(),
            name: store.name().to_owned(),
        }
    }

    pub fn default() -> Self {
        Self {
            values: Values::DEFAULT,
            name: String::new(),
        }
    }
}

/// Starts a device on this flash.
pub fn start(flash: &Flash) -> Store {
    let (store, usable) = Store::load(flash.clone(), |_| true);
    assert!(usable);
    store
}

pub fn name(text: &str) -> heapless::String<MAX_NAME> {
    text.try_into().unwrap()
}

/// A name of the greatest length.
pub fn long_name(number: u32) -> heapless::String<MAX_NAME> {
    name(&format!("{number:0width$}", width = MAX_NAME))
}

/// Settings that were set once, long ago.
pub const KEPT: [(SettingKey, u32); 3] = [
    (SettingKey::FlagUm, 900),
    (SettingKey::StrokeUm, 100_000),
    (SettingKey::ButtonTotalMs, 86_400_000),
];

/// A flash with a short history.
pub fn young() -> Vec<u8> {
    let flash = Flash::blank();
    let mut store = start(&flash);
    for (key, value) in KEPT {
        store.set(key, value).unwrap();
    }
    store.set_name(name("left bench")).unwrap();
    flash.bytes()
}

/// A flash whose next name drops a sector for the second time since [`KEPT`] was set, and the number of that name.
pub static OLD: LazyLock<(Vec<u8>, u32)> = LazyLock::new(|| before_erasure(2));

/// A flash whose next name drops a sector for the `wanted`-th time, and the number of that name.
fn before_erasure(wanted: u32) -> (Vec<u8>, u32) {
    let flash = Flash::holding(young());
    let mut store = start(&flash);
    let mut erasures = 0;
    for number in 0..10_000 {
        let (before, operations) = (flash.bytes(), flash.operations().len());
        store.set_name(long_name(number)).unwrap();
        let erased = |operation: &Operation| matches!(operation, Operation::Erase { .. });
        if flash.operations()[operations..].iter().any(erased) {
            erasures += 1;
        }
        if erasures == wanted {
            return (before, number);
        }
    }
    panic!("no sector was erased");
}

/// A sector whose erasure was cut may look as if it were in use beside the sector that is. Whatever bits it has, the
/// log is read and written on, wherever it stands.
#[test]
fn an_erasure_that_was_cut_spoils_nothing() {
    for wanted in 1..=3 {
        let (image, number) = before_erasure(wanted);
        let old = Content::of(&start(&Flash::holding(image.clone())));
        for (seed, cut) in (0..60).flat_map(|seed| Cut::ALL.map(|cut| (seed, cut))) {
            let flash = Flash::holding(image.clone());
            let mut store = start(&flash);
            flash.cut(0, cut, seed);
            let _ = store.set_name(long_name(number));
            // At a second start, too, that the supply is still too low for: nothing is erased or written.
            let low = usize::from(seed % 2 == 1);
            let context = format!("erasure {wanted}, {cut:?}, seed {seed}, {low} failures");
            let flash = Flash::holding(flash.bytes());
            flash.fail(0..2 * low);
            let mut store = start(&flash);
            assert_eq!(Content::of(&store).values, old.values, "{context}");
            if low > 0 {
                let _ = store.set_name(long_name(number + 1));
                flash.fail(0..0);
                let again = Content::of(&start(&Flash::holding(flash.bytes())));
                assert_eq!(again.values, old.values, "{context}");
            }
            for number in number + 1..number + 4 {
                store.set_name(long_name(number)).expect(&context);
                let again = Content::of(&start(&Flash::holding(flash.bytes())));
                assert_eq!(again.name, *long_name(number), "{context}");
                assert_eq!(again.values, old.values, "{context}");
            }
        }
    }
}

/// Makes a change with a cut in each of its operations. What each cut leaves has to satisfy `is_left`, and has to
/// accept changes as usual.
fn cut_everywhere(
    image: &[u8],
    change: impl Fn(&mut Store) -> Result<(), StorageFailed>,
    is_left: impl Fn(&Content) -> bool,
) -> Vec<Content> {
    let whole = Flash::holding(image.to_vec());
    let mut store = start(&whole);
    let before = Content::of(&store);
    assert_eq!(whole.operations(), [], "a start changes nothing");
    change(&mut store).unwrap();
    let after = Content::of(&store);
    assert_eq!(Content::of(&start(&whole)), after);
    let operations = whole.operations();
    let mut images = Vec::new();
    for (number, operation) in operations.iter().enumerate() {
        for cut in Cut::ALL {
            let context = format!("{cut:?} in {number}: {operation:?}");
            let flash = Flash::holding(image.to_vec());
            let mut store = start(&flash);
            flash.cut(number, cut, number as u64);
            // The values in force are the old ones, or those already in flash.
            if change(&mut store).is_err() {
                assert!(is_left(&Content::of(&store)), "{context}");
            } else {
                assert_eq!(number + 1, operations.len(), "{context}");
                assert_eq!(Content::of(&store), after, "{context}");
            }
            let flash = Flash::holding(flash.bytes());
            let mut store = start(&flash);
            let found = Content::of(&store);
            assert!(is_left(&found), "{context}: {found:?}");
            if number == 0 && cut == Cut::Before {
                assert_eq!(found, before, "{context}");
            }
            if number + 1 == operations.len() && cut == Cut::After {
                assert_eq!(found, after, "{context}");
            }
            // The flash can still be written, and keeps everything else.
            store.set(SettingKey::PullOffUm, 999).expect(&context);
            let again = start(&Flash::holding(flash.bytes()));
            let expected = Content {
                values: found.values.with(SettingKey::PullOffUm, 999).unwrap(),
                ..found.clone()
            };
            assert_eq!(Content::of(&again), expected, "{context}");
            change(&mut store).expect(&context);
            let again = Content::of(&start(&Flash::holding(flash.bytes())));
            assert_eq!(again, Content::of(&store), "{context}");
            images.push(found);
        }
    }
    images
}

/// Checks that a cut change of one value leaves it old or new, and everything else unchanged.
fn old_or_new(image: &[u8], change: impl Fn(&mut Store) -> Result<(), StorageFailed>) {
    let flash = Flash::holding(image.to_vec());
    let mut store = start(&flash);
    let old = Content::of(&store);
    change(&mut store).unwrap();
    let new = Content::of(&store);
    assert_ne!(old, new);
    let images = cut_everywhere(image, change, |found| *found == old || *found == new);
    // Both cases occur.
    assert!(images.contains(&old) && images.contains(&new));
}

#[test]
fn a_cut_leaves_the_old_value_or_the_new_one() {
    let blank = Flash::blank().bytes();
    for image in [blank, young()] {
        old_or_new(&image, |store| store.set(SettingKey::FlagUm, 1_234));
        // A value whose last bytes look blank.
        old_or_new(&image, |store| {
            store.set(SettingKey::ButtonTotalMs, 0x00FF_FFFF)
        });
        old_or_new(&image, |store| store.set_name(name("right bench")));
        old_or_new(&image, |store| store.set_name(long_name(7)));
    }
}

/// A dropped sector loses nothing: neither its name, nor the settings of long ago, nor the new name.
#[test]
fn a_cut_while_a_sector_is_dropped_loses_nothing() {
    let (image, number) = OLD.clone();
    let store = start(&Flash::holding(image.clone()));
    assert_eq!(store.name(), long_name(number - 1).as_str());
    for (key, value) in KEPT {
        assert_eq!(store.values().get(key), value);
    }
    old_or_new(&image, |store| store.set_name(long_name(number)));
    old_or_new(&image, |store| store.set(SettingKey::FlagUm, 1_234));
}

/// Half of a reset would be settings that nobody has chosen.
#[test]
fn a_cut_within_a_reset_leaves_everything_or_only_defaults() {
    for image in [young(), OLD.0.clone()] {
        old_or_new(&image, Store::reset);
    }
}

/// Whichever sector the log drops first, an old value never outlives the reset.
#[test]
fn a_reset_is_not_undone_when_it_grows_old() {
    for before in [0, 150, 300, 450] {
        let flash = Flash::holding(young());
        let mut store = start(&flash);
        for nth in 0..before {
            store.set_name(name(["a", "b"][nth % 2])).unwrap();
        }
        store.reset().unwrap();
        for nth in 0..1_500 {
            store.set_name(name(["c", "d"][nth % 2])).unwrap();
            if nth % 7 == 0 {
                let later = start(&Flash::holding(flash.bytes()));
                assert_eq!(*later.values(), Values::DEFAULT, "{before}, {nth}");
            }
        }
    }
}

/// Values of another firmware may break the rules between settings. Then the defaults are in force until something is
/// set; a name keeps all rules.
#[test]
fn values_that_do_not_go_together_are_not_in_force_and_a_reset_ends_that() {
    let flash = Flash::holding(young());
    let (mut store, usable) = Store::load(flash.clone(), |values| {
        assert_eq!(values.get(SettingKey::FlagUm), 900);
        false
    });
    assert!(!usable);
    assert_eq!(*store.values(), Values::DEFAULT);
    assert_eq!(store.name(), "left bench");
    store.reset().unwrap();
    assert_eq!(Content::of(&store), Content::default());
    let store = start(&Flash::holding(flash.bytes()));
    assert_eq!(Content::of(&store), Content::default());
}

/// A rule that [`KEPT`] breaks and the defaults keep.
fn keeps_the_rule(values: &Values) -> bool {
    values.get(SettingKey::FlagUm) != 900 || values.get(SettingKey::StrokeUm) != 100_000
}

/// Whether it ends the conflict or has nothing to do with it: the value is in force, now and at the next start, and no
/// older value is.
#[test]
fn a_value_that_is_set_in_a_conflict_stays_and_none_from_before_it_revives() {
    for (key, value) in [
        (SettingKey::LinkTimeoutMs, 3_000),
        (SettingKey::FlagUm, 800),
    ] {
        let flash = Flash::holding(young());
        let (mut store, usable) = Store::load(flash.clone(), keeps_the_rule);
        assert!(!usable);
        store.set(key, value).unwrap();
        let set = Content {
            values: Values::DEFAULT.with(key, value).unwrap(),
            name: "left bench".to_owned(),
        };
        assert_eq!(Content::of(&store), set);
        // The conflict is over: a further change is one record.
        let written = flash.operations().len();
        store.set(SettingKey::PullOffUm, 999).unwrap();
        assert!(flash.operations().len() < written + 4, "one record");
        let (store, usable) = Store::load(Flash::holding(flash.bytes()), keeps_the_rule);
        assert!(usable);
        let both = set.values.with(SettingKey::PullOffUm, 999).unwrap();
        assert_eq!(*store.values(), both, "{}", key.name());
        assert_eq!(store.name(), "left bench");
    }
}

/// Two values that break the rule together, of which one is 50 records older.
fn conflict_of_two_ages() -> (Flash, Store) {
    let flash = Flash::blank();
    let mut store = start(&flash);
    store.set(SettingKey::StrokeUm, 100_000).unwrap();
    for nth in 0..50 {
        store.set_name(name(["a", "b"][nth % 2])).unwrap();
    }
    store.set(SettingKey::FlagUm, 900).unwrap();
    (flash, store)
}

/// Names, and with them a capsule's totals, are written for as long as nobody sets a value. Old records are replaced
/// meanwhile, one by one: those of a conflict at once, or long after each other.
#[test]
fn a_conflict_that_grows_old_revives_no_value() {
    let (apart, _) = conflict_of_two_ages();
    for image in [young(), apart.bytes()] {
        let flash = Flash::holding(image);
        let (mut store, usable) = Store::load(flash.clone(), keeps_the_rule);
        assert!(!usable);
        for nth in 0..600 {
            store.set_name(name(["a", "b"][nth % 2])).unwrap();
            let (later, _) = Store::load(Flash::holding(flash.bytes()), keeps_the_rule);
            assert_eq!(*later.values(), Values::DEFAULT, "after {nth}");
        }
    }
}

/// The older of the two records is due to be written again with the next change. That alone would end the conflict, and
/// the other value would be in force.
#[test]
fn a_cut_within_the_end_of_an_old_conflict_revives_no_value() {
    let (flash, mut store) = conflict_of_two_ages();
    for nth in 0..Ages::OLDEST as usize - 50 {
        store.set_name(name(["a", "b"][nth % 2])).unwrap();
    }
    let image = flash.bytes();
    let load = |flash: &Flash| Store::load(flash.clone(), keeps_the_rule);
    type Change = fn(&mut Store) -> Result<(), StorageFailed>;
    let changes: [Change; 3] = [
        |store| store.set(SettingKey::LinkTimeoutMs, 3_000),
        |store| store.set_name(name("c")),
        Store::reset,
    ];
    for (nth, change) in changes.into_iter().enumerate() {
        let whole = Flash::holding(image.clone());
        let (mut store, usable) = load(&whole);
        assert!(!usable);
        change(&mut store).unwrap();
        let new = *store.values();
        for (number, cut) in
            (0..whole.operations().len()).flat_map(|number| Cut::ALL.map(|cut| (number, cut)))
        {
            let flash = Flash::holding(image.clone());
            let mut store = load(&flash).0;
            flash.cut(number, cut, number as u64);
            let _ = change(&mut store);
            let found = *load(&Flash::holding(flash.bytes())).0.values();
            let context = format!("change {nth}, {cut:?} in {number}");
            assert!([Values::DEFAULT, new].contains(&found), "{context}");
        }
    }
}

/// Nothing is in force that flash did not take.
#[test]
fn a_value_that_a_worn_flash_does_not_take_in_a_conflict_is_not_in_force() {
    // From the record that ends the conflict, or from the value's.
    for failing in [0..usize::MAX, 4..usize::MAX] {
        let flash = Flash::holding(young());
        let (mut store, _) = Store::load(flash.clone(), keeps_the_rule);
        flash.fail(failing);
        let set = store.set(SettingKey::LinkTimeoutMs, 3_000);
        assert_eq!(set, Err(StorageFailed));
        assert_eq!(*store.values(), Values::DEFAULT);
        flash.fail(0..0);
        store.set(SettingKey::LinkTimeoutMs, 3_000).unwrap();
        let (later, usable) = Store::load(Flash::holding(flash.bytes()), keeps_the_rule);
        assert!(usable);
        assert_eq!(later.values(), store.values());
    }
}

/// The one was set to another value before, the other was not.
const OUT_OF_RANGE: [SettingKey; 2] = [SettingKey::FlagUm, SettingKey::PullOffUm];

/// A flash with values that only a newer firmware takes.
fn out_of_range() -> Flash {
    let flash = Flash::holding(young());
    let (mut log, loaded) = Log::new(flash.clone()).load(|_, _| {});
    loaded.unwrap();
    for key in OUT_OF_RANGE {
        let record = Values::record(key.range().max + 1);
        log.save(key as u8, &record).unwrap();
    }
    Flash::holding(flash.bytes())
}

/// Its default counts; an older value was replaced, and does not come back. All others count.
#[test]
fn a_value_out_of_range_is_passed_over_and_told() {
    let flash = out_of_range();
    let (mut store, usable) = Store::load(flash.clone(), |_| true);
    assert!(!usable, "it is to be told");
    assert_eq!(flash.operations(), []);
    for (key, value) in KEPT {
        let expected = match key {
            SettingKey::FlagUm => key.range().default,
            _ => value,
        };
        assert_eq!(store.values().get(key), expected, "{}", key.name());
    }
    assert_eq!(store.name(), "left bench");
    // Until other values replace them.
    for key in OUT_OF_RANGE {
        store.set(key, 800).unwrap();
    }
    let store = start(&Flash::holding(flash.bytes()));
    assert!(OUT_OF_RANGE.map(|key| store.values().get(key)) == [800, 800]);
}

/// Else the newer firmware would find it again, although everything was reset.
#[test]
fn a_reset_ends_a_value_out_of_range() {
    let flash = out_of_range();
    let (mut store, _) = Store::load(flash.clone(), |_| true);
    store.reset().unwrap();
    let mut last = None;
    let log = Log::new(Flash::holding(flash.bytes()));
    let (_, read) = log.load(|number, record| last = Some((number, record.to_vec())));
    assert_eq!((read, last), (Ok(()), Some((DEFAULTS_RECORD, vec![]))));
    assert_eq!(Content::of(&start(&flash)), Content::default());
}

/// Another machine's firmware writes an empty record over a setting that is none of its own: nothing was passed over.
#[test]
fn an_empty_record_is_none() {
    let flash = Flash::holding(young());
    let (mut log, loaded) = Log::new(flash.clone()).load(|_, _| {});
    loaded.unwrap();
    log.save(SettingKey::FlagUm as u8, &[]).unwrap();
    let default = SettingKey::FlagUm.range().default;
    let store = start(&Flash::holding(flash.bytes()));
    assert_eq!(store.values().get(SettingKey::FlagUm), default);
}

/// The sectors of a new chip, or of one after an unforeseen cut, may contain anything.
#[test]
fn a_flash_of_noise_can_be_reset() {
    let mut unreadable = 0;
    for seed in 0..40 {
        let mut dice = Dice(seed);
        let mut bytes = Flash::blank().bytes();
        for byte in &mut bytes[SECTORS.start as usize..SECTORS.end as usize] {
            *byte = if seed % 2 == 0 { 0 } else { 0x5A } | dice.bits() as u8;
        }
        // The marks at the start and the end of a sector by which the log recognises one in use.
        for (sector, marks) in (1..).zip([seed % 3, seed % 4, seed % 5]) {
            let sector = sector * SECTOR as usize;
            let width = Flash::WRITE_SIZE;
            bytes[sector..][..width].fill(if marks > 0 { 0 } else { 0xFF });
            let end = sector + SECTOR as usize - width;
            bytes[end..][..width].fill(if marks > 1 { 0 } else { 0xFF });
        }
        let flash = Flash::holding(bytes);
        let (mut store, usable) = Store::load(flash.clone(), |_| true);
        unreadable += u32::from(!usable);
        store.reset().unwrap();
        assert_eq!(Content::of(&store), Content::default(), "{seed}");
        store.set(SettingKey::FlagUm, 900).unwrap();
        let store = start(&Flash::holding(flash.bytes()));
        assert_eq!(store.values().get(SettingKey::FlagUm), 900, "{seed}");
        assert_eq!(store.name(), "");
    }
    assert!(
        unreadable > 0,
        "noise never looked like a record that is too long"
    );
}

/// All three sectors are full: the log has neither a beginning nor an end.
#[test]
fn a_flash_that_is_no_log_is_not_in_force() {
    let flash = Flash::holding(vec![0; SECTORS.end as usize]);
    let (mut store, usable) = Store::load(flash.clone(), |_| true);
    assert!(!usable);
    assert_eq!(Content::of(&store), Content::default());
    assert_eq!(store.set(SettingKey::FlagUm, 900), Err(StorageFailed));
    assert_eq!(Content::of(&store), Content::default());
    store.reset().unwrap();
    store.set(SettingKey::FlagUm, 900).unwrap();
    let store = start(&Flash::holding(flash.bytes()));
    assert_eq!(store.values().get(SettingKey::FlagUm), 900);
}

#[test]
fn a_worn_flash_changes_nothing() {
    let flash = Flash::holding(young());
    let mut store = start(&flash);
    let before = Content::of(&store);
    flash.wear();
    assert_eq!(store.set(SettingKey::FlagUm, 1_234), Err(StorageFailed));
    assert_eq!(store.set_name(name("right bench")), Err(StorageFailed));
    assert_eq!(store.reset(), Err(StorageFailed));
    assert_eq!(Content::of(&store), before);
    assert_eq!(Content::of(&start(&Flash::holding(flash.bytes()))), before);
}

/// Longer than any record of this firmware.
#[test]
fn a_record_that_is_too_long_is_not_written() {
    let flash = Flash::blank();
    let mut log = Log::new(flash.clone());
    assert_eq!(log.save(NAME_RECORD, &[7; 28]), Err(StorageFailed));
    assert_eq!(flash.operations(), []);
    log.save(NAME_RECORD, &[7; 27]).unwrap();
    let mut records = Vec::new();
    let note = |number, record: &[u8]| records.push((number, record.to_vec()));
    Log::new(flash).load(note).1.unwrap();
    assert_eq!(records, [(NAME_RECORD, vec![7; 27])]);
}

/// After thousands of names and several restarts, old settings are still there.
#[test]
fn what_was_set_once_is_kept() {
    let mut flash = Flash::holding(young());
    let mut store = start(&flash);
    for number in 0..3_000 {
        store.set_name(long_name(number)).unwrap();
        if number % 397 == 0 {
            flash = Flash::holding(flash.bytes());
            store = start(&flash);
            assert_eq!(store.name(), long_name(number).as_str());
            for (key, value) in KEPT {
                assert_eq!(store.values().get(key), value, "{number}");
            }
        }
    }
}

/// An order to a device to store something, or a failure of its supply.
#[derive(Clone, Debug)]
enum Step {
    Set(SettingKey, u32),
    Name(u32),
    Reset,
}

fn any_step() -> impl Strategy<Value = Step> {
    let keys = prop::sample::select(vec![
        SettingKey::FlagUm,
        SettingKey::StrokeUm,
        SettingKey::ButtonTotalMs,
    ]);
    prop_oneof![
        4 => (keys, any::<prop::sample::Index>()).prop_map(|(key, value)| {
            let range = key.range();
            let width = (range.max - range.min) as usize + 1;
            Step::Set(key, range.min + value.index(width) as u32)
        }),
        8 => any::<u32>().prop_map(Step::Name),
        1 => Just(Step::Reset),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Any changes with any cuts, even in the first change after a cut: each change leaves the old value or the new
    /// one. The log starts where sectors are dropped.
    #[test]
    fn no_cut_ever_loses_more_than_its_change(
        steps in prop::collection::vec(
            (any_step(), prop::option::of((0..8_usize, 0..Cut::ALL.len(), any::<u64>()))),
            1..40,
        ),
    ) {
        let mut flash = Flash::holding(OLD.0.clone());
        let mut store = start(&flash);
        for (step, cut) in steps {
            let before = Content::of(&store);
            if let Some((after, cut, seed)) = cut {
                flash.cut(after, Cut::ALL[cut], seed);
            }
            let mut expected = before.clone();
            let done = match step {
                Step::Set(key, value) => {
                    expected.values = before.values.with(key, value).unwrap();
                    store.set(key, value)
                }
                Step::Name(number) => {
                    expected.name = long_name(number).as_str().to_owned();
                    store.set_name(long_name(number))
                }
                Step::Reset => {
                    expected = Content::default();
                    store.reset()
                }
            };
            if done.is_ok() {
                prop_assert_eq!(Content::of(&store), expected.clone());
            }
            if cut.is_some() || done.is_err() {
                flash = Flash::holding(flash.bytes());
                store = start(&flash);
                let found = Content::of(&store);
                prop_assert!(found == expected || done.is_err() && found == before);
            }
        }
    }
}
