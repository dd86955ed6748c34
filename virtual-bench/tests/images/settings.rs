//! The rig's settings on the image: persistent, checked, and safe against a power cut at every flash operation.

use std::sync::OnceLock;

use crate::common::{RigRun, flash_operations, is_made, rig, rig_from_flash};
use protocol::{
    settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey},
    system::DeviceKind,
    table::{Endpoint, Request},
};
use virtual_bench::emulator::CutAt;

fn get(rig: &mut RigRun, key: SettingKey) -> u32 {
    let got = rig.device.call(GetSetting { key }).expect("it answers");
    assert_eq!(got.key, key);
    got.value
}

/// Sends the request and lets it be executed, to its end or to the cut.
fn begin(rig: &RigRun, request: Request) {
    rig.send(&request, 0);
    for _ in 0..20 {
        rig.pass(50_000);
        let cut = rig.bench.visit(|visit| visit.flash_is_cut());
        if cut.expect("the bench runs") {
            return;
        }
    }
    panic!("the operation was never reached\n{}", rig.log());
}

#[test]
fn settings_are_the_defaults_at_first_and_survive_reset_and_power() {
    let mut rig = rig();
    for key in SettingKey::of(DeviceKind::Rig) {
        assert_eq!(get(&mut rig, key), key.range().default, "{}", key.name());
    }
    assert_eq!(flash_operations(&rig.bench), 0, "a start writes nothing");
    rig.set(SettingKey::SeekUmS, 15_000);
    rig.set(SettingKey::SeekUmS, 12_000);
    let name = Name {
        name: "bench 3".try_into().expect("short"),
    };
    assert_eq!(rig.device.call(name.clone()).expect("accepted"), name);
    rig.reset(2);
    assert_eq!(get(&mut rig, SettingKey::SeekUmS), 12_000);
    rig.power_cycle(9);
    assert_eq!(get(&mut rig, SettingKey::SeekUmS), 12_000);
    assert_eq!(rig.device.call(GetName).expect("a name"), name);
    let accepted = rig.device.home().expect("homing is accepted");
    assert_eq!(accepted.seek_um_s, 12_000, "the setting is in force");
    rig.device.call(FactoryReset).expect_err("it moves");
    let homed = rig.device.wait_homing(&accepted, &mut client::Unobserved);
    homed.expect("homed");
    rig.device.call(FactoryReset).expect("accepted");
    rig.power_cycle(9);
    for key in SettingKey::of(DeviceKind::Rig) {
        assert_eq!(get(&mut rig, key), key.range().default, "{}", key.name());
    }
    assert!(rig.device.call(GetName).expect("a name").name.is_empty());
    rig.check_clean_after(1, 0);
}

/// Changes a setting and cuts the supply before, within and after each of its stores.
#[test]
fn a_cut_at_every_store_leaves_the_old_value_or_the_new_one() {
    let mut rig = rig();
    let key = SettingKey::PullOffUm;
    rig.set(key, 2_000);
    let before = flash_operations(&rig.bench);
    rig.set(key, 2_001);
    let stores = flash_operations(&rig.bench) - before;
    assert!((3..40).contains(&stores), "{stores} stores per change");
    let (mut old, mut new, mut value) = (0, 0, 2_001);
    for number in 0..stores {
        for at in [CutAt::Before, CutAt::Within, CutAt::After] {
            cut_within_a_change(&mut rig, key, &mut value, number, at, (&mut old, &mut new));
        }
    }
    assert!(old > 0 && new > 0, "{old} old, {new} new");
    rig.home();
    rig.check_clean(0);
}

fn cut_within_a_change(
    rig: &mut RigRun,
    key: SettingKey,
    value: &mut u32,
    number: u64,
    at: CutAt,
    (old, new): (&mut u32, &mut u32),
) {
    let wanted = *value + 1;
    rig.visit(move |visit| {
        let done = visit.flash_operations();
        visit.cut_flash(at, done + number);
    });
    let change = Setting { key, value: wanted };
    begin(rig, change.into_request());
    rig.power_cycle(9);
    let found = get(rig, key);
    assert!(
        found == *value || found == wanted,
        "store {number} cut {at:?}: {found} is neither {value} nor {wanted}\n{}",
        rig.log()
    );
    *(if found == wanted { new } else { old }) += 1;
    // Nothing else has changed, and the store still works.
    assert_eq!(get(rig, SettingKey::SeekUmS), 20_000);
    rig.set(key, wanted + 1);
    assert_eq!(get(rig, key), wanted + 1);
    *value = wanted + 1;
}

/// A part of a reset would be settings that nobody has chosen.
#[test]
fn a_cut_within_a_reset_leaves_all_values_or_none() {
    let mut rig = rig();
    let values = [
        (SettingKey::PullOffUm, 2_000),
        (SettingKey::SeekUmS, 12_000),
        (SettingKey::FlagUm, 900),
    ];
    let mut counts = [0, 0];
    let cuts = [CutAt::Before, CutAt::Within, CutAt::After];
    for (number, at) in (0..).flat_map(|number| cuts.map(|at| (number, at))) {
        for (key, value) in values {
            rig.set(key, value);
        }
        let done = flash_operations(&rig.bench);
        rig.visit(move |visit| visit.cut_flash(at, done + number));
        rig.send(&FactoryReset.into_request(), 0);
        rig.pass(300_000);
        let cut = rig.bench.visit(|visit| visit.flash_is_cut());
        if !cut.expect("the bench runs") {
            break;
        }
        rig.power_cycle(9);
        let found = values.map(|(key, _)| get(&mut rig, key));
        let defaults = values.map(|(key, _)| key.range().default);
        assert!(
            found == values.map(|(_, value)| value) || found == defaults,
            "store {number} cut {at:?}: {found:?}\n{}",
            rig.log()
        );
        counts[usize::from(found == defaults)] += 1;
    }
    assert!(counts[0] > 2 && counts[1] > 0, "{counts:?}");
}

/// A name that takes as much flash as the longest record.
pub(crate) fn long_name(number: u32) -> Name {
    let name = format!("{number:024}").as_str().try_into();
    Name {
        name: name.expect("it has 24 bytes"),
    }
}

fn name(rig: &mut RigRun) -> Name {
    rig.device.call(GetName).expect("a name")
}

/// Settings set once at the start, before everything else.
const KEPT: [(SettingKey, u32); 2] = [
    (SettingKey::SeekUmS, 15_000),
    (SettingKey::LocateUmS, 1_500),
];

/// Names a rig until that erases a sector for the `erasures`th time. Returns the flash before the last naming, its
/// number and its number of operations.
fn until_a_sector_is_erased(erasures: u32) -> (Vec<u8>, u32, u64) {
    let mut rig = rig();
    for (key, value) in KEPT {
        rig.set(key, value);
    }
    let mut before = rig.visit(|visit| visit.flash());
    let mut found = 0;
    for number in 1..5_000 {
        let before_operations = flash_operations(&rig.bench);
        let given = rig.device.call(long_name(number));
        given.unwrap_or_else(|error| panic!("name {number}: {error}\n{}", rig.log()));
        let after = rig.visit(|visit| visit.flash());
        // A store only clears bits, so a bit that was set shows an erase.
        if before.iter().zip(&after).any(|(old, new)| new & !old != 0) {
            found += 1;
            if found == erasures {
                return (
                    before,
                    number,
                    flash_operations(&rig.bench) - before_operations,
                );
            }
        }
        before = after;
    }
    panic!("no sector was erased");
}

/// The first time, which several tests begin with: the flash before the naming, and its number.
pub(crate) fn about_to_erase() -> (Vec<u8>, u32) {
    static FIRST: OnceLock<(Vec<u8>, u32)> = OnceLock::new();
    let first = FIRST.get_or_init(|| {
        let (flash, number, _) = until_a_sector_is_erased(1);
        (flash, number)
    });
    first.clone()
}

/// Cuts the supply within each operation of the naming that erases a sector. Settings made once at the start must
/// survive: by the second erase, their first records are gone for good.
#[test]
fn a_cut_within_a_change_that_erases_a_sector_loses_nothing() {
    let (flash, number, count) = until_a_sector_is_erased(2);
    let (old, new) = (long_name(number - 1), long_name(number));
    let (mut olds, mut news) = (0, 0);
    let cuts = (0..count).flat_map(|operation| {
        [CutAt::Before, CutAt::Within, CutAt::After].map(|at| (operation, at))
    });
    // A host test tries every operation, in memory (`device/tests/store.rs`).
    for (trial, (operation, at)) in cuts.enumerate() {
        if !is_made(trial, 5) {
            continue;
        }
        let mut rig = rig_from_flash(flash.clone());
        rig.visit(move |visit| visit.cut_flash(at, operation));
        begin(&rig, new.clone().into_request());
        rig.power_cycle(9);
        let found = name(&mut rig);
        assert!(
            found == old || found == new,
            "operation {operation} of {count} cut {at:?}: {found:?}\n{}",
            rig.log()
        );
        *(if found == new { &mut news } else { &mut olds }) += 1;
        for (key, value) in KEPT {
            assert_eq!(get(&mut rig, key), value, "{operation} {at:?}");
        }
        rig.set(SettingKey::PullOffUm, 999);
        rig.power_cycle(9);
        assert_eq!(get(&mut rig, SettingKey::PullOffUm), 999);
        assert_eq!(name(&mut rig), found);
    }
    assert!(olds > 0 && news > 0, "{olds} old, {news} new");
}

/// An interrupted erase can leave a sector's first and last words blank, but not the words between.
#[test]
fn a_sector_that_only_looks_blank_is_erased_before_it_is_used() {
    const SECTOR: usize = 16 * 1024;
    // All three sectors are full; the first is the next to be erased.
    let (mut flash, number) = about_to_erase();
    let words = &mut flash[SECTOR..2 * SECTOR];
    words[..4].fill(0xFF);
    words[SECTOR - 4..].fill(0xFF);
    let mut rig = rig_from_flash(flash);
    assert_eq!(name(&mut rig), long_name(number - 1));
    rig.device.call(long_name(number)).expect("accepted");
    rig.power_cycle(9);
    assert_eq!(name(&mut rig), long_name(number));
}
