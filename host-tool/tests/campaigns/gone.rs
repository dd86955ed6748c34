//! A machine that is gone while a campaign asks, and comes back: the session goes on with the same one, and with no
//! other.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering};

use client::address::Address;
use client::link::{Link, LinkError, OpenError, Reason};
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::campaign::conduct::Machines;
use lab::campaign::ledger::{AttemptOutcome, TrialStatus};
use lab::operations::connector::{Connector, LinkPurpose};
use lab::trials::experiment::PAPER_RUN;
use protocol::rig::{Hold, MoveTo};
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};
use simulated_machines::machine::{Script, World, estop, link};

use crate::campaign_run::{Place, WIDTH, clamped, small_plan};
use crate::support::tool::{Memory, ready};

/// A bench that is switched off while the first question waits, and is back after so many attempts to reach it.
struct Restarted {
    first: Memory,
    then: Memory,
    rigs: AtomicU32,
    /// Attempts to reach the rig in vain.
    vain: Mutex<u32>,
    /// Whether the first line learns of a stop once it is lost.
    stopped: bool,
}

/// A line that learns of a stop once the machine behind it has been switched off.
struct Learns(Box<dyn Link>);

impl Link for Learns {
    fn place(&self) -> String {
        self.0.place()
    }
    fn now_us(&self) -> u64 {
        self.0.now_us()
    }
    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.0.send(bytes)
    }
    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.0.receive(buffer, deadline_us)
    }
    fn stopped(&mut self) -> Option<Urgent> {
        (self.now_us() > OFF_US).then_some(Urgent::Stop)
    }
}

/// When the first session is lost. Connecting takes less.
const OFF_US: u64 = 3_000_000;

impl Restarted {
    fn new(then: Script, vain: u32) -> Self {
        let mut first = Script::new(DeviceKind::Rig);
        first.world = vec![(OFF_US, World::Reset)];
        let capsule = Script::new(DeviceKind::Capsule);
        Self {
            first: Memory::with(vec![first, capsule.clone()]),
            then: Memory::with(vec![then, capsule]),
            rigs: AtomicU32::new(0),
            vain: Mutex::new(vain),
            stopped: false,
        }
    }
}

impl Connector for Restarted {
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        if kind == DeviceKind::Capsule || self.rigs.fetch_add(1, Ordering::SeqCst) == 0 {
            let link = self.first.open(kind, address, baud, purpose)?;
            return Ok(match kind == DeviceKind::Rig && self.stopped {
                true => Box::new(Learns(link)),
                false => link,
            });
        }
        let mut vain = self.vain.lock().expect("free");
        if *vain > 0 {
            *vain -= 1;
            return Err(OpenError {
                place: address.to_string(),
                reason: Reason::Absent,
                why: "it is switched off".to_owned(),
                remedy: "switch it on".to_owned(),
            });
        }
        self.then.open(kind, address, baud, purpose)
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

#[track_caller]
fn nothing_moved(memory: &Memory) {
    let heard = memory.heard();
    let moved = heard.contains(&"Home") || heard.contains(&"Run");
    assert!(!moved, "{heard:?}");
}

/// The answers up to the checklist of the first trial.
const UP_TO_THE_TRIAL: [(&str, &str); 6] = [
    ("you can still answer", ""),
    ("Reading 1 of 2: D", "24.4"),
    ("Reading 2 of 2: D", "24.4"),
    ("Clamp both rollers", ""),
    ("Reading 1 of 2: i", "20.4"),
    ("Reading 2 of 2: i", "20.4"),
];

#[test]
fn the_same_machine_is_reached_again_where_it_is_needed() {
    let at = Place::of(&small_plan(&[]));
    let bench = Restarted::new(Script::new(DeviceKind::Rig), 1);
    let lines = [
        &UP_TO_THE_TRIAL[..],
        &[
            ("Trial 1 of 6", ""),
            ("it is switched off; switch it on; Enter tries again", ""),
            ("the machine is back, and the same", ""),
            ("Displacement of the tail", "12.5"),
            ("Clamp both rollers", "q"),
        ],
    ];
    let shown = at.answered(&bench, 130, lines.concat());
    let campaign = at.whole();
    let first = campaign.state.trial(1).expect("there");
    assert_eq!(first.status(), TrialStatus::Done);
    assert_eq!(first.attempts.len(), 1);
    // The new session knows no position, so it homes.
    let heard = bench.then.heard();
    assert!(
        heard.contains(&"Home") && heard.contains(&"Run"),
        "{heard:?}"
    );
    assert_eq!(shown.matches("you can still answer").count(), 1, "{shown}");
}

/// Regression: the stop was thrown away with the old line, and the next Enter began the attempt.
#[test]
fn a_stop_that_came_while_the_machine_was_gone_holds_for_the_new_session() {
    let at = Place::of(&small_plan(&[]));
    let bench = Restarted {
        stopped: true,
        ..Restarted::new(Script::new(DeviceKind::Rig), 0)
    };
    let lines = [
        &UP_TO_THE_TRIAL[..],
        &[
            ("Trial 1 of 6", ""),
            ("a stop was requested: nothing begins", "q"),
        ],
    ];
    at.answered(&bench, 130, lines.concat());
    nothing_moved(&bench.then);
}

#[test]
fn another_machine_is_named_and_nothing_moves() {
    let mut other = Script::new(DeviceKind::Rig);
    other.uid = *b"another rig\0";
    let mut changed = Script::new(DeviceKind::Rig);
    changed.settings = vec![(SettingKey::LinkTimeoutMs, 2_000)];
    for (then, says) in [
        (other, "rig identity uid is \"616e6f7468657220726967"),
        (changed, "rig settings link_timeout_ms is 2000, was 1000"),
    ] {
        let at = Place::of(&small_plan(&[]));
        let bench = Restarted::new(then, 0);
        let lines = [&UP_TO_THE_TRIAL[..], &[("Trial 1 of 6", "")]].concat();
        let shown = at.answered(&bench, 3, lines);
        assert!(shown.contains(says), "{shown}");
        let resume = format!("`retrograde campaign run {}`", at.out);
        assert!(shown.contains(&resume), "{shown}");
        nothing_moved(&bench.then);
        let campaign = at.whole();
        let first = campaign.state.trial(1).expect("there");
        assert_eq!(first.attempts.len(), 0, "no attempt has begun");
        assert_eq!(campaign.readings.sets[1].values.len(), 2, "{shown}");
    }
}

/// A motion that is under way when a session begins, or when a machine is back, belongs to an attempt that nobody looks
/// after.
#[test]
fn a_machine_that_moves_for_nobody_is_stopped_before_anything_else() {
    let running = Script {
        running: Some((PAPER_RUN, 2_000_000)),
        ..Script::new(DeviceKind::Rig)
    };
    let at = Place::of(&small_plan(&[]));
    let memory = Memory::with(vec![running.clone(), Script::new(DeviceKind::Capsule)]);
    let lines = vec![("rollers OFF", "q")];
    let shown = at.answered(&memory, 130, lines);
    let told = "The rig was still moving without a host: it was stopped.";
    assert!(shown.contains(told), "{shown}");
    assert!(memory.heard().contains(&"Urgent"), "{:?}", memory.heard());

    let bench = Restarted::new(running, 0);
    let lines = [
        &UP_TO_THE_TRIAL[..],
        &[
            ("Trial 1 of 6", ""),
            ("the rig was moving without a host: it was stopped", ""),
            ("Displacement of the tail", "q"),
        ],
    ];
    at.answered(&bench, 130, lines.concat());
    let heard = bench.then.heard();
    let place_of = |name| heard.iter().position(|heard| *heard == name);
    let stopped = place_of("Urgent").expect("it was stopped");
    assert!(
        place_of("Home").is_some_and(|homed| homed > stopped),
        "{heard:?}"
    );
}

/// A latched fault is told with what to do, and nothing moves.
#[test]
fn a_fault_is_told_before_the_rollers_move() {
    let mut faulted = Script::new(DeviceKind::Rig);
    faulted.world = estop(0);
    let at = Place::of(&small_plan(&[]));
    let memory = Memory::with(vec![faulted, Script::new(DeviceKind::Capsule)]);
    let lines = [&WIDTH[..], &clamped("20.4"), &[("Trial 1 of 6", "")]].concat();
    let shown = at.answered(&memory, 3, lines);
    assert!(shown.contains("the rig has a fault: "), "{shown}");
    let words = shown.split_whitespace().collect::<Vec<_>>().join(" ");
    let goes_on = format!("`retrograde campaign run {}`", at.out);
    let help = format!("remove its cause, `retrograde ack rig`, then {goes_on}");
    assert!(words.contains(&help), "{shown}");
    nothing_moved(&memory);
    let outcome = at.whole().state.trials[0].attempts[0].outcome;
    assert_eq!(outcome, Some(AttemptOutcome::Refused));
}

/// A session that was killed has left the machines as they were.
#[test]
fn every_motion_for_nobody_is_stopped() {
    type Begin = fn(&mut Device);
    let none: Begin = |_| {};
    let home: Begin = |rig| {
        rig.home().expect("accepted");
    };
    let moves: Begin = |rig| {
        let to = MoveTo {
            position_um: 100_000,
            speed_um_s: 10_000,
        };
        rig.call(to).expect("accepted");
    };
    let held: Begin = |rig| {
        rig.run(PAPER_RUN).expect("accepted");
        rig.idle(1_000_000, &mut Unobserved).expect("there");
        rig.call(Hold).expect("accepted");
        rig.idle(1_000_000, &mut Unobserved).expect("there");
    };
    let fold: Begin = |capsule| {
        capsule.fold().expect("accepted");
    };
    let ready_rig = || ready(DeviceKind::Rig);
    for (script, rig_does, capsule_does, stopped) in [
        (Script::new(DeviceKind::Rig), home, none, &["rig"][..]),
        (ready_rig(), moves, none, &["rig"]),
        (ready_rig(), held, none, &["rig"]),
        (ready_rig(), none, fold, &["capsule"]),
        (ready_rig(), moves, fold, &["rig", "capsule"]),
        (ready_rig(), none, none, &[]),
    ] {
        let connect = |script: Script| {
            let kind = script.kind;
            Device::connect(link(script).0, kind, 1).expect("there")
        };
        let (mut rig, mut capsule) = (connect(script), connect(ready(DeviceKind::Capsule)));
        rig_does(&mut rig);
        capsule_does(&mut capsule);
        let mut machines = Machines::new(rig, Some(capsule), None).expect("there");
        assert_eq!(machines.come_to_rest().expect("confirmed"), stopped);
    }
}
