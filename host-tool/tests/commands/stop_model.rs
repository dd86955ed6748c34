//! An exhaustive model of stopping, with all interleavings of the steps up to a bounded depth. Its parts: a server's
//! requests, courier and worker around the real [`lab::operations::stops::Book`], another process that begins a run and
//! dies, one that takes over its line, and a rig.
//!
//! Two simplifications: a frame reaches the rig as soon as it is written (in reality within a millisecond), and no
//! process freezes between its last look at the stops and the write that follows.

use std::collections::HashSet;
use std::fs;
use std::path::Path;

use lab::operations::stops::{Ask, Book};
use protocol::system::Urgent;

/// Longest path that is explored.
const DEPTH: usize = 14;

/// Safeguards that can be removed, to see that the model finds the fault that each prevents.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Mends {
    /// Only the machine confirms a stop.
    confirmation: bool,
    /// An order older than a stop is refused.
    age: bool,
    /// A motion lives only as long as the host that began it.
    life: bool,
    /// A stop that the owner of the line does not take goes around it.
    past: bool,
}

const ALL: Mends = Mends {
    confirmation: true,
    age: true,
    life: true,
    past: true,
};

/// Hosts that begin motions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Host {
    Server,
    Other,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Motion {
    by: Host,
    /// Clock when the motion was ordered.
    ordered: u8,
    /// Ticks since the host that keeps the motion alive was last heard.
    silent: u8,
}

/// A press of stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Press {
    ask: Ask,
    at: u8,
    /// The answer: `Some(true)` says that the machine stands.
    told: Option<bool>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Order {
    after: u64,
    at: u8,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Courier {
    Idle,
    /// The courier has taken all presses up to this stop.
    Taken(u64),
    Answered(u64),
    Failed(u64),
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct State {
    /// Number of orders and presses so far. It puts everything that people do in order.
    clock: u8,
    book: Book,
    presses: Vec<Press>,
    queue: Vec<Order>,
    /// The worker has taken this order and has not sent it yet.
    taken: Option<Order>,
    courier: Courier,
    /// The rig answers.
    alive: bool,
    /// Its broker admits clients.
    open: bool,
    motion: Option<Motion>,
    /// Number of the last press before the latest stop that the rig has seen.
    seen: u8,
    other_lives: bool,
    other_began: bool,
    reset: bool,
}

impl State {
    fn new() -> Self {
        Self {
            clock: 0,
            book: Book::default(),
            presses: vec![],
            queue: vec![],
            taken: None,
            courier: Courier::Idle,
            alive: true,
            open: true,
            motion: None,
            seen: 0,
            other_lives: true,
            other_began: false,
            reset: false,
        }
    }

    fn stops(&mut self) {
        self.motion = None;
        self.seen = self.clock;
    }

    /// All states that may follow.
    fn next(&self, mends: Mends) -> Result<Vec<Self>, String> {
        let mut all = vec![];
        let mut then = |act: &dyn Fn(&mut Self)| {
            let mut state = self.clone();
            act(&mut state);
            all.push(state);
        };
        // Steps of people.
        if self.presses.len() < 3 {
            then(&|state| {
                state.clock += 1;
                let ask = state.book.ask(Urgent::Stop);
                let at = state.clock;
                let told = None;
                state.presses.push(Press { ask, at, told });
            });
        }
        if self.queue.is_empty() && self.taken.is_none() && self.clock < 5 {
            then(&|state| {
                state.clock += 1;
                let after = state.book.asked();
                let at = state.clock;
                state.queue.push(Order { after, at });
            });
        }
        // Steps of the courier.
        let waits = |press: &&Press| press.told.is_none();
        if self.courier == Courier::Idle && self.presses.iter().any(|press| waits(&press)) {
            then(&|state| state.courier = Courier::Taken(state.book.asked()));
        }
        if let Courier::Taken(asked) = self.courier {
            let reaches = self.alive && (self.open || mends.past);
            then(&|state| {
                if reaches {
                    state.stops();
                    state.courier = Courier::Answered(asked);
                } else {
                    state.courier = Courier::Failed(asked);
                }
            });
            if self.alive {
                // The answer gets lost.
                then(&|state| {
                    state.stops();
                    state.courier = Courier::Failed(asked);
                });
            }
        }
        if let Courier::Answered(asked) = self.courier {
            then(&|state| {
                state.book.confirm(Urgent::Stop, asked);
                state.tell(mends);
            });
        }
        if let Courier::Failed(_) = self.courier {
            then(&|state| state.tell(mends));
        }
        // Steps of the worker: a stop first, then an order.
        if self.alive && self.book.unconfirmed().is_some() && self.taken.is_none() {
            then(&|state| {
                let asked = state.book.asked();
                state.stops();
                state.book.confirm(Urgent::Stop, asked);
            });
        }
        if let (Some(order), None) = (self.queue.first().copied(), self.taken) {
            let overtaken = mends.age && self.book.since(order.after).is_some();
            then(&|state| {
                state.queue.clear();
                if !overtaken {
                    state.taken = Some(order);
                    state.book.order(mends.age.then_some(order.after));
                }
            });
        }
        if let Some(order) = self.taken {
            let interrupted = self.book.wanted().is_some();
            let begins = self.alive && !interrupted && self.motion.is_none();
            if begins {
                // An earlier order must not undo what a person has already been told.
                let undone = self
                    .presses
                    .iter()
                    .find(|press| press.told == Some(true) && press.at > order.at);
                if let Some(press) = undone {
                    return Err(format!(
                        "an order of {} moves after the confirmed stop of {}",
                        order.at, press.at
                    ));
                }
            }
            then(&|state| {
                state.taken = None;
                state.book.order(None);
                if begins {
                    let (by, ordered, silent) = (Host::Server, order.at, 0);
                    state.motion = Some(Motion {
                        by,
                        ordered,
                        silent,
                    });
                }
            });
        }
        // Steps of the other process, its death, and time. The server polls the rig all the time.
        if self.other_lives
            && !self.other_began
            && self.motion.is_none()
            && self.alive
            && self.queue.is_empty()
            && self.taken.is_none()
        {
            then(&|state| {
                state.clock += 1;
                state.other_began = true;
                let (by, ordered, silent) = (Host::Other, state.clock, 0);
                state.motion = Some(Motion {
                    by,
                    ordered,
                    silent,
                });
            });
        }
        if self.other_lives && self.other_began {
            then(&|state| state.other_lives = false);
        }
        if let Some(motion) = self.motion {
            let heard = match (motion.by, mends.life) {
                (Host::Server, _) => true,
                (Host::Other, true) => self.other_lives,
                // Without the safeguard, any host that asks keeps the motion alive.
                (Host::Other, false) => true,
            };
            if motion.by == Host::Other && !self.other_lives && motion.silent == 0 && heard {
                return Err("the run of a dead process goes on".to_owned());
            }
            then(&|state| match &mut state.motion {
                Some(motion) if !heard && motion.silent == 1 => state.motion = None,
                Some(motion) if !heard => motion.silent += 1,
                _ => {}
            });
        }
        // Steps of the rig and its line.
        if self.alive {
            then(&|state| {
                state.alive = false;
                state.motion = None;
            });
            if self.open {
                then(&|state| state.open = false);
            }
            if !self.reset {
                then(&|state| {
                    state.reset = true;
                    state.motion = None;
                });
            }
        }
        Ok(all)
    }

    /// Answers all presses that the courier has taken. The others wait for the next round.
    fn tell(&mut self, mends: Mends) {
        let (Courier::Answered(asked) | Courier::Failed(asked)) = self.courier else {
            return;
        };
        self.courier = Courier::Idle;
        let mut cleared = false;
        for press in &mut self.presses {
            let is_taken = press.ask.number() <= asked || !mends.confirmation;
            if press.told.is_none() && is_taken {
                let confirmed = self.book.is_confirmed(press.ask);
                press.told = Some(confirmed || cleared);
                self.book.withdraw(press.ask);
                // The old fault: an entry cleared for one who gave up was taken for a confirmation by the next.
                cleared = !mends.confirmation;
            }
        }
    }

    /// Checks the invariants of a state.
    fn judge(&self, mends: Mends) -> Result<(), String> {
        for press in &self.presses {
            if press.told == Some(true) && self.seen < press.at {
                return Err(format!(
                    "the press of {} was told a stop that the rig has not seen",
                    press.at
                ));
            }
            if press.told == Some(false) && self.alive && !self.open && !mends.past {
                return Err("a stop did not get past the owner of the line".to_owned());
            }
        }
        Ok(())
    }
}

/// Explores all states. Returns their number, or the first violation.
fn explore(mends: Mends) -> Result<usize, String> {
    let mut seen = HashSet::from([State::new()]);
    let mut edge = vec![State::new()];
    for _ in 0..DEPTH {
        let mut further = vec![];
        for state in &edge {
            for next in state.next(mends)? {
                next.judge(mends)?;
                if seen.insert(next.clone()) {
                    further.push(next);
                }
            }
        }
        edge = further;
    }
    Ok(seen.len())
}

#[test]
fn nothing_goes_wrong_in_any_order_of_events() {
    let states = explore(ALL).unwrap_or_else(|why| panic!("{why}"));
    assert_eq!(states, 546_704);
}

#[test]
fn the_model_finds_what_each_mend_mends() {
    for (mends, finding) in [
        (
            Mends {
                confirmation: false,
                ..ALL
            },
            "was told a stop that the rig has not seen",
        ),
        (
            Mends { age: false, ..ALL },
            "moves after the confirmed stop",
        ),
        (
            Mends { life: false, ..ALL },
            "the run of a dead process goes on",
        ),
        (Mends { past: false, ..ALL }, "did not get past the owner"),
    ] {
        let found = explore(mends).expect_err("found");
        assert!(found.contains(finding), "{mends:?}: {found}");
    }
}

/// The last column of each table of docs/safety.md names a test. All of them exist.
#[test]
fn the_tables_of_the_manual_name_tests_that_exist() {
    let mut tests = String::new();
    let folders = [
        "firmware-rig",
        "firmware-capsule",
        "host-tool",
        "protocol",
        "python",
        "virtual-bench",
    ];
    for folder in folders {
        gather(&Path::new("..").join(folder).join("tests"), &mut tests);
    }
    let manual = include_str!("../../../docs/safety.md");
    let rows = manual
        .lines()
        .filter(|line| line.starts_with("| ") && !line.ends_with("| test |"));
    let mut count = 0;
    for row in rows {
        let name = row.rsplit('`').nth(1).expect("a test");
        let is_there = tests.contains(&format!("#[test]\nfn {name}("))
            || tests.contains(&format!("def {name}(self)"));
        assert!(is_there, "{name}");
        count += 1;
    }
    assert!(count >= 57, "{count} rows");
}

/// Adds the lines of all sources below a folder, without their indentation.
fn gather(folder: &Path, text: &mut String) {
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            gather(&path, text);
        } else if let Ok(source) = fs::read_to_string(&path) {
            for line in source.lines() {
                *text += line.trim_start();
                text.push('\n');
            }
        }
    }
}
