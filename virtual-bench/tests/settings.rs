//! The rig's settings on the image: kept, checked, and safe against a cut of the supply at every flash operation.

mod common;

use common::{RigRun, rig};
use host_tool::{error::ClientError, link::Link};
use protocol::{
    error::Refusal,
    frame::{Header, Kind, encode},
    rig::{RigEvent, RigState},
    settings::{FactoryReset, GetName, GetSetting, Name, Setting, SettingKey, SettingRule},
    system::What,
    table::Command,
};
use virtual_bench::{emulator::CutAt, link::VirtualLink};

fn get(rig: &mut RigRun, key: SettingKey) -> u32 {
    let got = rig.device.call(GetSetting { key }).expect("it answers");
    assert_eq!(got.key, key);
    got.value
}

fn set(rig: &mut RigRun, key: SettingKey, value: u32) -> Result<Setting, ClientError> {
    rig.device.call(Setting { key, value })
}

/// Sends the request and lets it be carried out, to its end or to the cut.
fn begin(rig: &RigRun, key: SettingKey, value: u32) {
    let header = Header {
        kind: Kind::Request,
        session: rig.device.identity().expect("a session").session,
        // Ahead of the client's own numbers, and not so far that it would count as behind.
        seq: 20_000,
    };
    let frame = encode(header, &Setting { key, value }.into_request()).expect("it fits");
    let mut link = VirtualLink::new(&rig.bench, "a second hand on the line");
    link.send(&frame).expect("the bench runs");
    for _ in 0..20 {
        rig.bench.advance_us(50_000).expect("the bench runs");
        let cut = rig.bench.visit(|visit| visit.flash_is_cut());
        if cut.expect("the bench runs") {
            return;
        }
    }
    panic!("the operation was never reached\n{}", rig.log());
}

fn power_cycle(rig: &mut RigRun) {
    rig.bench.power_cycle(1_000_000).expect("the bench runs");
    rig.bench.advance_us(300_000).expect("the bench runs");
    rig.device.hello(9).expect("it answers again");
}

fn operations(rig: &RigRun) -> u64 {
    rig.bench
        .visit(|visit| visit.flash_operations())
        .expect("the bench runs")
}

#[test]
fn settings_are_the_defaults_at_first_and_survive_reset_and_power() {
    let mut rig = rig();
    for key in SettingKey::ALL {
        assert_eq!(get(&mut rig, key), key.range().default, "{}", key.name());
    }
    assert_eq!(operations(&rig), 0, "a start writes nothing");
    set(&mut rig, SettingKey::SeekUmS, 15_000).expect("accepted");
    set(&mut rig, SettingKey::SeekUmS, 12_000).expect("accepted");
    let name = Name {
        name: "bench 3".try_into().expect("short"),
    };
    assert_eq!(rig.device.call(name.clone()).expect("accepted"), name);
    rig.bench.reset().expect("the bench runs");
    rig.bench.advance_us(300_000).expect("the bench runs");
    rig.device.hello(2).expect("it answers again");
    assert_eq!(get(&mut rig, SettingKey::SeekUmS), 12_000);
    power_cycle(&mut rig);
    assert_eq!(get(&mut rig, SettingKey::SeekUmS), 12_000);
    assert_eq!(rig.device.call(GetName).expect("a name"), name);
    let accepted = rig.device.home().expect("homing is accepted");
    assert_eq!(accepted.seek_um_s, 12_000, "the setting is in force");
    rig.device.call(FactoryReset).expect_err("it moves");
    let _ = rig
        .device
        .wait_homing(&accepted, &mut host_tool::client::Unobserved)
        .expect("homed");
    rig.device.call(FactoryReset).expect("accepted");
    power_cycle(&mut rig);
    for key in SettingKey::ALL {
        assert_eq!(get(&mut rig, key), key.range().default, "{}", key.name());
    }
    assert!(rig.device.call(GetName).expect("a name").name.is_empty());
    rig.check_clean(0);
}

#[test]
fn what_cannot_be_is_refused_and_nothing_is_written() {
    let mut rig = rig();
    let refused = |rig: &mut RigRun, key, value, expected| match set(rig, key, value) {
        Err(ClientError::Refused { refusal, .. }) => assert_eq!(refusal, expected),
        other => panic!("{other:?}"),
    };
    for key in SettingKey::ALL {
        let range = key.range();
        for value in [range.min.checked_sub(1), range.max.checked_add(1)] {
            let Some(requested) = value else { continue };
            let expected = Refusal::SettingRange { key, requested };
            refused(&mut rig, key, requested, expected);
        }
    }
    let (key, rule) = (SettingKey::Microsteps, SettingRule::Microsteps);
    refused(&mut rig, key, 24, Refusal::SettingRule { key, rule });
    let (key, rule) = (SettingKey::Microsteps, SettingRule::HomingWithinStepRate);
    refused(&mut rig, key, 256, Refusal::SettingRule { key, rule });
    rig.home();
    let before = operations(&rig);
    rig.device.run(common::paper(1)).expect("accepted");
    refused(
        &mut rig,
        SettingKey::SeekUmS,
        10_000,
        Refusal::RigBusy(RigState::Running),
    );
    assert_eq!((before, operations(&rig)), (0, 0), "nothing was written");
}

/// Other microsteps are other positions: the rig has to be homed again, and then moves by the new ones.
#[test]
fn a_change_of_the_axis_takes_the_position_away() {
    let mut rig = common::homed();
    set(&mut rig, SettingKey::LinkTimeoutMs, 2_000).expect("accepted");
    assert!(rig.device.rig_status().expect("a status").homed);
    set(&mut rig, SettingKey::StrokeUm, 100_000).expect("accepted");
    let status = rig.device.rig_status().expect("a status");
    assert_eq!((status.homed, status.state), (false, RigState::Unhomed));
    rig.home();
    match rig.device.run(common::paper(1)) {
        Err(ClientError::Refused {
            refusal: Refusal::OutOfRange { max: 100_000, .. },
            ..
        }) => {}
        other => panic!("{other:?}"),
    }
}

/// One change of a setting, its supply cut before, within and after each of its stores.
#[test]
fn a_cut_at_every_store_leaves_the_old_value_or_the_new_one() {
    let mut rig = rig();
    let key = SettingKey::PullOffUm;
    set(&mut rig, key, 2_000).expect("accepted");
    let before = operations(&rig);
    set(&mut rig, key, 2_001).expect("accepted");
    let stores = operations(&rig) - before;
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
    rig.bench
        .visit(move |visit| {
            let done = visit.flash_operations();
            visit.cut_flash(at, done + number);
        })
        .expect("the bench runs");
    begin(rig, key, wanted);
    power_cycle(rig);
    let found = get(rig, key);
    assert!(
        found == *value || found == wanted,
        "store {number} cut {at:?}: {found} is neither {value} nor {wanted}\n{}",
        rig.log()
    );
    *(if found == wanted { new } else { old }) += 1;
    // Nothing else has changed, and the store still works.
    assert_eq!(get(rig, SettingKey::SeekUmS), 20_000);
    set(rig, key, wanted + 1).expect("it still can be set");
    assert_eq!(get(rig, key), wanted + 1);
    *value = wanted + 1;
}

/// The change number `changes` of one key on a new rig is the first that erases a sector.
fn until_a_sector_is_full(stop_before: Option<u32>) -> (RigRun, u32, u64) {
    let mut rig = rig();
    for (key, value) in [
        (SettingKey::SeekUmS, 15_000),
        (SettingKey::LocateUmS, 1_500),
    ] {
        set(&mut rig, key, value).expect("accepted");
    }
    let mut usual = u64::MAX;
    for change in 0..5_000 {
        if stop_before == Some(change) {
            return (rig, change, 0);
        }
        let before = operations(&rig);
        set(&mut rig, FILLED, filled(change)).unwrap_or_else(|error| {
            let again = rig.device.hello(3);
            panic!(
                "change {change}: {error}; {} operations; {again:?}\n{}",
                operations(&rig) - before,
                rig.log()
            )
        });
        let count = operations(&rig) - before;
        // Turning over to an empty sector takes a few more stores; moving records to make room takes many.
        if count > usual.saturating_mul(3) {
            return (rig, change, count);
        }
        usual = usual.min(count);
    }
    panic!("no sector was ever erased");
}

const FILLED: SettingKey = SettingKey::PullOffUm;

fn filled(change: u32) -> u32 {
    1_000 + change
}

/// The change that erases a sector and moves what is still needed, its supply cut within each of its operations.
#[test]
fn a_cut_within_a_change_that_erases_a_sector_loses_nothing() {
    let (mut rig, change, count) = until_a_sector_is_full(None);
    let last = filled(change);
    power_cycle(&mut rig);
    assert_eq!(get(&mut rig, FILLED), last);
    let (rig, ..) = until_a_sector_is_full(Some(change));
    let flash = rig
        .bench
        .visit(|visit| visit.flash())
        .expect("the bench runs");
    let (mut old, mut new) = (0, 0);
    for number in 0..count {
        for at in [CutAt::Before, CutAt::Within] {
            let mut rig = common::rig_from_flash(flash.clone());
            rig.bench
                .visit(move |visit| visit.cut_flash(at, number))
                .expect("the bench runs");
            begin(&rig, FILLED, last);
            power_cycle(&mut rig);
            let found = get(&mut rig, FILLED);
            let before = filled(change - 1);
            assert!(
                found == before || found == last,
                "operation {number} of {count} cut {at:?}: {found} is neither {before} nor {last}\n{}",
                rig.log()
            );
            *(if found == last { &mut new } else { &mut old }) += 1;
            assert_eq!(
                get(&mut rig, SettingKey::SeekUmS),
                15_000,
                "{number} {at:?}"
            );
            assert_eq!(
                get(&mut rig, SettingKey::LocateUmS),
                1_500,
                "{number} {at:?}"
            );
            set(&mut rig, FILLED, 999).expect("it still can be set");
            power_cycle(&mut rig);
            assert_eq!(get(&mut rig, FILLED), 999, "{number} {at:?}");
        }
    }
    // The new value is written after everything else, and its very last operation makes it count.
    assert!(old > 0, "{count} operations: {old} old, {new} new");
}

#[test]
fn a_change_is_an_event() {
    let mut rig = rig();
    set(&mut rig, SettingKey::DeadManMs, 200).expect("accepted");
    let events = rig.device.take_events().expect("events");
    let changed = What::Rig(RigEvent::SettingChanged(SettingKey::DeadManMs));
    assert!(
        events.iter().any(|event| event.what == changed),
        "{events:?}"
    );
}
