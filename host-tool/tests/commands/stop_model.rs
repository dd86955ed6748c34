//! A model of stopping, explored exhaustively: a server's requests, courier and keeper around the real
//! [`operations::stops::Book`], another process that begins a run and dies, one that takes its line over, and a rig. All
//! interleavings of their steps to a bounded depth.
//!
//! What the model leaves out: a frame is at the rig as soon as it is written (in earnest within a millisecond), and a
//! process that is frozen between the last look at the stops and the write that follows it.

use std::collections::HashSet;

use operations::stops::{Ask, Book};
use protocol::system::Urgent;

/// The longest path that is followed.
const DEPTH: usize = 14;

/// Mends that can be taken out, to see that the model finds what they mend.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Mends {
    /// Only the machine confirms a stop.
    confirmation: bool,
    /// An order is refused after a stop that is newer.
    age: bool,
    /// The life of a motion is that of whoever began it.
    life: bool,
    /// A stop that the owner of the line does not take goes past it.
    past: bool,
}

const ALL: Mends = Mends {
    confirmation: true,
    age: true,
    life: true,
    past: true,
};

/// Who begins motions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Host {
    Server,
    Other,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Motion {
    by: Host,
    /// When it was ordered.
    ordered: u8,
    /// Ticks since the host that counts was last heard.
    silent: u8,
}

/// Somebody who pressed stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Press {
    ask: Ask,
    at: u8,
    /// `Some(true)`: told that the machine stands.
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
    /// It has taken all presses until this stop.
    Taken(u64),
    Answered(u64),
    Failed(u64),
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct State {
    /// Orders and presses so far; the order of everything that people do.
    clock: u8,
    book: Book,
    presses: Vec<Press>,
    queue: Vec<Order>,
    /// The keeper carries this out and has not sent it yet.
    taken: Option<Order>,
    courier: Courier,
    /// The rig answers.
    alive: bool,
    /// Its door lets guests in.
    open: bool,
    motion: Option<Motion>,
    /// The last press before the stop that the rig has seen last.
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

    /// Everything that may happen next.
    fn next(&self, mends: Mends) -> Result<Vec<Self>, String> {
        let mut all = vec![];
        let mut then = |act: &dyn Fn(&mut Self)| {
            let mut state = self.clone();
            act(&mut state);
            all.push(state);
        };
        // People.
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
        // The courier.
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
                // The answer is lost.
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
        // The keeper: a stop first, then an order.
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
                // What a person was told before may not be undone by what came before it.
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
        // The other process, its death, and time. The server asks the rig all the time.
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
                // Whoever asks something counts.
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
        // The rig and its line.
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

    /// All whom the courier has taken are told, and those that it has not wait for the next.
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
                // Once, what somebody who gave up had cleared was taken for a confirmation by the next.
                cleared = !mends.confirmation;
            }
        }
    }

    /// What must hold in every state.
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

/// Explores everything; returns the number of states, or what went wrong first.
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
    // As docs/stopping.md says.
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

/// docs/stopping.md names a test for each row of its table, and each of them is there.
#[test]
fn the_table_of_the_manual_names_tests_that_exist() {
    let tests = include_str!("../lines/stopping.rs");
    let on_the_image = include_str!("../../../virtual-bench/tests/images/estop.rs");
    let manual = include_str!("../../../docs/stopping.md");
    let rows = manual
        .lines()
        .filter(|line| line.starts_with("| ") && !line.contains("what confirms it"));
    let mut count = 0;
    for row in rows {
        let name = row
            .trim_end_matches([' ', '|'])
            .rsplit("| ")
            .next()
            .expect("a column");
        let name = name.split('`').nth(1).expect("a test");
        let is_there = match name {
            // A file of tests.
            "estop" => on_the_image.contains("#[test]\nfn "),
            name => tests.contains(&format!("#[test]\nfn {name}()")),
        };
        assert!(is_there, "{name}");
        count += 1;
    }
    assert_eq!(count, 13);
}
