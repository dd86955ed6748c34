//! What is known of the thread, in RAM and as a record in flash, also over a cut of the power in each write.

use device::settings::{Records, SettingsStore};
use firmware_capsule::control::flash::{KNOWN, Kept, TOTALS, Totals};
use firmware_capsule::known::{Calibration, Known};
use firmware_capsule::sense::Counts;
use firmware_capsule::units::{Spooling, Thread};
use protocol::capsule::CapsuleState;
use simulated_machines::chip::{Cut, Flash};

const CALIBRATION: Calibration = Calibration {
    folded: Thread(21_727),
    no_load_ma: 15,
    pull_ma: 62,
    rise: 250,
    lacking: 100,
    back_emf_uv_cps: 207,
};

/// A calibrated capsule whose count is 0 at the unfolded end.
fn known() -> Known {
    let mut known = Known::default();
    known.unfolded_here(Counts(0));
    known.calibration = Some(CALIBRATION);
    known
}

fn again(known: &Known) -> Known {
    let kept = Kept {
        known: *known,
        ..Kept::default()
    };
    let mut later = Kept::default();
    later.load(KNOWN, &kept.record(KNOWN).expect("it fits"));
    later.known
}

#[test]
fn a_record_comes_back() {
    let mut felt = known().resting(Thread(21_700).counts());
    felt.felt = true;
    let mut lost = known();
    lost.lose();
    let mut left = known();
    left.referenced(Thread(21_000));
    assert_eq!(left.remaining, Thread(727));
    // The longest record that motions and settings allow.
    let mut longest = known().resting(Thread(-1_000_000).counts());
    longest.calibration = Some(Calibration {
        folded: Thread(28_000),
        no_load_ma: 30,
        pull_ma: 1_475,
        rise: 1_000,
        lacking: -1_000,
        back_emf_uv_cps: 1_000,
    });
    longest.remaining = Thread(28_000);
    longest.uncertainty = Some(Thread(8_000));
    for known in [Known::default(), known(), felt, lost, left, longest] {
        assert_eq!(again(&known), known);
    }
}

/// Nothing is known then. An older record would tell of a thread that has moved since.
#[test]
fn a_record_that_cannot_be_read_leaves_nothing_known() {
    let record = at(1_000).record(KNOWN).expect("it fits");
    let mut other_version = record.clone();
    other_version[0] += 1;
    let mut impossible = at(1_000);
    impossible.known.calibration = Some(Calibration {
        folded: Thread(7_999),
        ..CALIBRATION
    });
    let impossible = impossible.record(KNOWN).expect("it fits");
    for unreadable in [&record[..9], &[], &other_version, &impossible] {
        let mut kept = at(2_000);
        kept.load(KNOWN, unreadable);
        assert_eq!(kept.known, Known::default(), "{unreadable:?}");
    }
}

/// The place outlives a start, and the state follows from it.
#[test]
fn the_state_follows_from_what_is_known() {
    for (um, felt, uncertainty_um, state) in [
        (0, false, 0, CapsuleState::Unfolded),
        (240, false, 200, CapsuleState::Unfolded),
        (241, false, 0, CapsuleState::Stopped),
        (21_727, false, 0, CapsuleState::Stopped),
        (21_727, true, 0, CapsuleState::Folded),
        (0, false, 201, CapsuleState::Unreferenced),
    ] {
        let mut known = known().resting(Thread(um).counts());
        known.felt = felt;
        known.uncertainty = Some(Thread(uncertainty_um));
        let later = again(&known);
        let thread = later.thread(Counts(0));
        assert!((thread.0 - um).abs() <= 1, "{thread:?}");
        assert_eq!(later.state(Thread(um)), state, "{um} um");
    }
    assert_eq!(
        Known::default().state(Thread(0)),
        CapsuleState::Unreferenced
    );
}

/// Wherever within the next millimetre and the run-out after it the power is cut, the thread is where the record says.
#[test]
fn a_record_within_a_motion_covers_what_comes() {
    for (spooling, um) in [
        (Spooling::Wind, -60..=2_100),
        (Spooling::PayOut, -2_100..=60),
    ] {
        let moving = again(&known().moving(Thread(9_000).counts(), spooling));
        let least = moving.thread(Counts(0));
        let most = least + moving.uncertainty.expect("a doubt");
        for more_um in um {
            let thread = Thread(9_000 + more_um);
            assert!((least..=most).contains(&thread), "{spooling:?} {more_um}");
        }
        // It can be resolved without a hand.
        assert!(moving.uncertainty <= Some(Thread(3_000)));
        assert_eq!(moving.state(least), CapsuleState::Unreferenced);
    }
}

type Store = SettingsStore<Flash, Kept>;

fn start(flash: &Flash) -> Store {
    let (store, usable) = Store::load_with(Flash::holding(flash.bytes()), |_| true);
    assert!(usable);
    store
}

fn at(um: i32) -> Kept {
    Kept {
        known: known().resting(Thread(um).counts()),
        totals: Totals {
            actuations: 7,
            energy_mj: 1_750,
        },
    }
}

/// A cut in any write leaves the old place or the new one, and the totals.
#[test]
fn a_cut_leaves_the_old_record_or_the_new_one() {
    for (seed, cut) in (0..).zip(Cut::ALL) {
        for after in 0..4 {
            let flash = Flash::blank();
            let mut store = Store::load_with(flash.clone(), |_| true).0;
            store.keep(TOTALS, at(1_000)).expect("kept");
            store.keep(KNOWN, at(1_000)).expect("kept");
            store.make_room(20).expect("made");
            flash.cut(after, cut, seed);
            let kept = store.keep_moving(KNOWN, at(2_000)).is_ok();
            let found = *start(&flash).records();
            let (old, new) = (found == at(1_000), found == at(2_000));
            assert!(new || old && !kept, "{cut:?} after {after}: {found:?}");
        }
    }
}

/// The log drops its oldest sector; what was written years ago must not be in it.
#[test]
fn totals_survive_thousands_of_places() {
    let flash = Flash::blank();
    let mut store = Store::load_with(flash.clone(), |_| true).0;
    store.keep(TOTALS, at(0)).expect("kept");
    for motion in 0..100 {
        store.make_room(120).expect("made");
        for place in 0..60 {
            store
                .keep_moving(KNOWN, at(100 * place + motion))
                .expect("kept");
        }
    }
    assert_eq!(*start(&flash).records(), at(100 * 59 + 99));
}
