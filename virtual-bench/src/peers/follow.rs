//! Lets the image of the peers time the steps of one move, and follows its instructions in some windows of them.

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use object::{Object, ObjectSymbol};
use rigless::emulator::{Driver, Hit, HitKind, Host, Settled, Stop, Watch};
use rigless::image::Image;
use rigless::session::Session;
use rigless::soc::Width;
use rigless::time::VirtualNanos;

use crate::bench::BenchError;
use crate::cycles::{Accelerator, Code, Core, code, follow};
use crate::emulator::{ChipOptions, Emulator, Pads, Wiring};
use crate::verdicts::Stroke;

/// Words of the image's mailbox, as `virtual-bench/peers/src/main.rs` has them.
const SINGLE: u64 = 0;
const INTERVAL: u64 = 4;
const EQUAL: u64 = 8;
const STATE: u64 = 12;
const METHOD: u64 = 16;
const ORDER: u64 = 20;
const READY: u64 = 1;
const DONE: u64 = 2;
const REFUSED: u64 = 3;
/// Interval at which the run can stop, ns of virtual time.
const LOOK_NS: u64 = 1_000_000;
/// Most virtual time of a move, ns: the slowest takes 5 s.
const LONGEST_NS: u64 = 60_000_000_000;
/// Number of steps before a window from which instructions are followed, so that the cache fills again.
const MARGIN: u64 = 300;

/// Nothing is soldered to the chip.
#[derive(Debug)]
struct Bare;

impl Wiring for Bare {
    fn look(&mut self, _: &mut Pads<'_>) {}

    fn restarted(&mut self) {}

    fn flash_began(&mut self) {}

    fn powered_off(&mut self) {}
}

/// Cost of the steps of a window.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Cost {
    pub(super) steps: u64,
    pub(super) instructions: u64,
    /// Least and most.
    pub(super) cycles: [u64; 2],
}

impl std::ops::Add for Cost {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let [least, most] = self.cycles;
        Self {
            steps: self.steps + other.steps,
            instructions: self.instructions + other.instructions,
            cycles: [least + other.cycles[0], most + other.cycles[1]],
        }
    }
}

/// A move as a method timed it.
#[derive(Debug, Default)]
pub(super) struct Followed {
    /// Intervals as they were given out, each with the number of steps that take it.
    pub(super) intervals: Vec<(u32, u32)>,
    /// The cost in each window.
    pub(super) costs: Vec<Cost>,
    /// Bytes of the functions of which an instruction was executed in a window.
    pub(super) code_bytes: u64,
}

/// The image, and the facts about it that the bench needs.
pub(super) struct Peers {
    image: Image,
    code: Code,
    mailbox: u64,
    /// Functions: first address, bytes.
    functions: Vec<(u64, u64)>,
    accelerator: Accelerator,
}

impl Peers {
    /// Reads the image; its flash is read as `accelerator` says.
    ///
    /// # Errors
    /// It is missing, or not the image of the peers.
    pub(super) fn read(path: &Path, accelerator: Accelerator) -> Result<Self, BenchError> {
        let bad = |why: String| BenchError::BadImage {
            path: path.to_owned(),
            why,
        };
        let elf = std::fs::read(path).map_err(|why| {
            let path = path.display();
            BenchError::Ended(format!(
                "no image of the peers at {path}: `cargo xtask bench` builds it ({why})"
            ))
        })?;
        let file = object::File::parse(&*elf).map_err(|why| bad(why.to_string()))?;
        let mailbox = file
            .symbols()
            .find(|symbol| symbol.name() == Ok("MAILBOX"))
            .ok_or_else(|| bad("it has no mailbox".into()))?
            .address();
        let functions = file
            .symbols()
            .filter(|symbol| symbol.kind() == object::SymbolKind::Text && symbol.size() > 0)
            // `main` hands the intervals to the bench and belongs to no method.
            .filter(|symbol| !symbol.name().is_ok_and(|name| name.contains("main")))
            .map(|symbol| (symbol.address() & !1, symbol.size()))
            .collect();
        Ok(Self {
            image: Image::new(path, elf.clone(), None).map_err(|why| bad(why.to_string()))?,
            code: code(path)?,
            mailbox,
            functions,
            accelerator,
        })
    }

    /// Runs a method on a move, and follows its instructions in `windows` of steps, in order and apart. `None` if the
    /// method refuses the move.
    ///
    /// # Errors
    /// The emulator failed, or the method panicked or came to no end.
    pub(super) fn run(
        &self,
        method: u32,
        order: &Stroke,
        windows: &[Range<u64>],
    ) -> Result<Option<Followed>, BenchError> {
        let follower = Follower {
            mailbox: self.mailbox,
            order: [
                u64::from(method),
                order.steps,
                order.duration_ticks,
                order.ramp_ticks,
            ],
            windows: windows.to_vec(),
            code: self.code.clone(),
            core: Core::new(self.accelerator),
            touched: vec![false; self.code.bytes.len() / 2],
            following: false,
            begun: None,
            given: 0,
            state: 0,
            seen: Followed::default(),
            asked: false,
            ordered: false,
        };
        let Follower {
            state,
            mut seen,
            touched,
            ..
        } = follow(
            Bare,
            ChipOptions::default(),
            self.image.clone(),
            Arc::default(),
            follower,
        )?;
        match state {
            DONE if seen.costs.len() == windows.len() => {
                seen.code_bytes = self.touched_bytes(&touched);
                Ok(Some(seen))
            }
            REFUSED => Ok(None),
            state => {
                let (costs, given) = (seen.costs.len(), seen.intervals.len());
                let why =
                    format!("method {method}: state {state}, {given} intervals, {costs} windows");
                Err(BenchError::Ended(why))
            }
        }
    }

    fn touched_bytes(&self, touched: &[bool]) -> u64 {
        let is_touched = |(address, bytes): &&(u64, u64)| {
            let first = (address.saturating_sub(self.code.base.into()) / 2) as usize;
            let after = first + (bytes / 2) as usize;
            touched
                .get(first..after)
                .is_some_and(|halves| halves.contains(&true))
        };
        let mut functions: Vec<_> = self.functions.iter().filter(is_touched).collect();
        // Equal functions share an address.
        functions.sort();
        functions.dedup_by_key(|(address, _)| *address);
        functions.iter().map(|(_, bytes)| bytes).sum()
    }
}

struct Follower {
    mailbox: u64,
    order: [u64; 4],
    windows: Vec<Range<u64>>,
    code: Code,
    core: Core,
    /// For each half-word of the code, whether an instruction there was executed within a window.
    touched: Vec<bool>,
    following: bool,
    /// Steps given out, instructions and cycles at the start of the present window.
    begun: Option<(u64, u64, [u64; 2])>,
    given: u64,
    state: u64,
    seen: Followed,
    /// The mailbox is being watched.
    asked: bool,
    /// The order was handed over. Earlier writes were the image clearing its memory.
    ordered: bool,
}

impl Follower {
    fn word(&self, at: u64, host: &mut dyn Host) -> u64 {
        host.read(self.mailbox + at, Width::W32).unwrap_or(0)
    }

    fn watch_all(&mut self, on: bool, host: &mut dyn Host) {
        for address in self.code.addresses() {
            let watch = Watch::Instruction(address.into());
            if on {
                host.watch(watch);
            } else {
                host.unwatch(watch);
            }
        }
        self.following = on;
    }

    fn hand_over(&mut self, host: &mut dyn Host) {
        let [method, rest @ ..] = self.order;
        for (at, value) in (ORDER..).step_by(4).zip(rest) {
            let _ = host.write(self.mailbox + at, Width::W32, value);
        }
        // Write this last: the image waits for it.
        let _ = host.write(self.mailbox + METHOD, Width::W32, method);
        self.ordered = true;
    }

    /// The image has written into its mailbox.
    fn written(&mut self, session: &mut Session<Emulator<Bare>>, host: &mut dyn Host, hit: Hit) {
        match hit.address.wrapping_sub(self.mailbox) {
            STATE => {
                self.state = self.word(STATE, host);
                if self.state == READY {
                    self.hand_over(host);
                }
            }
            SINGLE if self.ordered => {
                let interval = self.word(SINGLE, host);
                self.given((interval as u32, 1), session, host, hit);
            }
            EQUAL if self.ordered => {
                let (interval, steps) = (self.word(INTERVAL, host), self.word(EQUAL, host));
                self.given((interval as u32, steps as u32), session, host, hit);
            }
            _ => {}
        }
    }

    /// The image has given out an interval.
    fn given(
        &mut self,
        interval: (u32, u32),
        session: &mut Session<Emulator<Bare>>,
        host: &mut dyn Host,
        hit: Hit,
    ) {
        self.seen.intervals.push(interval);
        self.given += u64::from(interval.1);
        let Some(window) = self.windows.get(self.seen.costs.len()).cloned() else {
            return;
        };
        let now = (self.given, self.core.instructions, self.core.cycles());
        if !self.following && self.given + MARGIN >= window.start {
            self.watch_all(true, host);
            // The watch takes effect at the next stop.
            session.pause_at(Some(VirtualNanos(hit.at.0 + 1)));
        } else if let Some((steps, instructions, cycles)) = self.begun {
            if self.given >= window.end {
                self.seen.costs.push(Cost {
                    steps: now.0 - steps,
                    instructions: now.1 - instructions,
                    cycles: [now.2[0] - cycles[0], now.2[1] - cycles[1]],
                });
                self.begun = None;
                self.watch_all(false, host);
            }
        } else if self.following && self.given >= window.start && now.1 > 0 {
            self.begun = Some(now);
        }
    }
}

impl Driver<Emulator<Bare>> for Follower {
    fn on_settled(
        &mut self,
        session: &mut Session<Emulator<Bare>>,
        host: &mut dyn Host,
        settled: Settled,
    ) {
        match settled {
            Settled::Hit(hit) if hit.kind == HitKind::Instruction => {
                let address = hit.address as u32;
                self.core.execute(address, &self.code);
                if self.begun.is_some()
                    && let Some(touched) = self
                        .touched
                        .get_mut((address.wrapping_sub(self.code.base) / 2) as usize)
                {
                    *touched = true;
                }
            }
            Settled::Hit(hit) => self.written(session, host, hit),
            settled => crate::emulator::settled(session, host, settled),
        }
    }

    fn on_stop(
        &mut self,
        _: &mut Session<Emulator<Bare>>,
        stop: Stop,
        host: &mut dyn Host,
    ) -> Option<VirtualNanos> {
        if !self.asked {
            self.asked = true;
            host.watch(Watch::Writes {
                address: self.mailbox,
                length: METHOD,
            });
            // The image may have been ready before.
            if self.word(STATE, host) == READY {
                self.hand_over(host);
            }
        }
        let ended = self.state > READY || stop.at.0 > LONGEST_NS;
        (!ended).then_some(VirtualNanos(stop.at.0 + LOOK_NS))
    }
}
