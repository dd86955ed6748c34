//! `watch`: shows the machines on one screen, with keys that hold, resume and stop. Without a terminal it prints a
//! line per second.

pub mod draw;
mod feed;
pub mod terminal;

use std::cell::Cell;
use std::io::{self, IsTerminal};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::{self, Scope};
use std::time::{Duration, Instant};

use clap::Args;
use client::decimal::ShortSeconds;
use client::{Pace, identity};
use crossterm::event::{self, Event, KeyCode, KeyEventKind, KeyModifiers};
use lab::operations::arguments::{Which, above_zero};
use lab::operations::failure::{DONE, Failure};
use lab::operations::interrupt;
use lab::operations::panel::{Contact, Panel};
use lab::operations::places::Places;
use protocol::system::{DeviceKind, Urgent};
use ratatui_core::terminal::Terminal;
use serde_json::{Map, Value, json};

use crate::cli::keyboard;
use crate::cli::screen::Screen;
use crate::cli::watch::draw::{Look, draw};
use crate::cli::watch::feed::{Feed, Shared};
use crate::cli::watch::terminal::Output;

/// Arguments of `watch`.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// The machines.
    #[command(flatten)]
    pub which: Which,
    /// Print a line per machine and second instead, as without a terminal.
    #[arg(long)]
    pub plain: bool,
    /// End after this time in s; otherwise with q, or with a signal.
    #[arg(long, value_name = "S", value_parser = above_zero::<ShortSeconds>)]
    pub for_s: Option<ShortSeconds>,
}

/// Interval between two drawings.
const DRAW: Duration = Duration::from_millis(50);

/// Interval between two lines without a terminal.
const LINE: Duration = Duration::from_secs(1);

/// Time allowed for leaving after a signal: a stop may still wait for its confirmation.
const LEAVING: Duration = Duration::from_secs(3);

/// Set once a signal to end has come. Global, because a process has one handler.
static SIGNALLED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// The machines that are watched.
static WATCHED: Mutex<Option<Arc<[Shared]>>> = Mutex::new(None);

fn signalled() -> Arc<AtomicBool> {
    let signalled = SIGNALLED.get_or_init(|| {
        let signalled = Arc::new(AtomicBool::new(false));
        let set = Arc::clone(&signalled);
        // A signal only leaves: watching never stops a machine by itself.
        interrupt::on_signals(move |_| {
            set.store(true, Ordering::Relaxed);
            thread::spawn(leave_by_force);
        });
        signalled
    });
    Arc::clone(signalled)
}

/// Exits after a while: if the terminal is gone, the reader of its keys never returns.
fn leave_by_force() {
    thread::sleep(LEAVING);
    let watched = WATCHED.lock().unwrap_or_else(PoisonError::into_inner);
    let code = match watched.as_deref().map_or(Ok(()), all_confirmed) {
        Ok(()) => DONE,
        Err(failure) => {
            interrupt::tell(&failure.text());
            failure.exit_code()
        }
    };
    std::process::exit(code.into());
}

/// Fails if a stop that a key has ordered was not confirmed.
fn all_confirmed(machines: &[Shared]) -> Result<(), Failure> {
    let told: Vec<_> = machines.iter().filter_map(Shared::unconfirmed).collect();
    match told.is_empty() {
        true => Ok(()),
        false => Err(Failure::Stops { told }),
    }
}

pub(crate) fn watch(
    args: &WatchArgs,
    places: &Places<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut machines = vec![];
    for kind in places.machines(&args.which)? {
        machines.push(Shared::new(kind, places.resolve(kind)?));
    }
    let machines: Arc<[Shared]> = machines.into();
    *WATCHED.lock().unwrap_or_else(PoisonError::into_inner) = Some(Arc::clone(&machines));
    let signalled = signalled();
    let full = !args.plain && !screen.json && screen.terminal && is_full_screen();
    let end = args.for_s.map(|seconds| {
        let limit = Duration::from_micros(seconds.0.into());
        Instant::now() + limit
    });
    let leaving = AtomicBool::new(false);
    let shown = thread::scope(|scope| {
        // Ends the feeds even if the screen panics.
        let leave = Leave(&leaving);
        for shared in machines.iter() {
            let feed = Feed {
                places,
                shared,
                leaving: &leaving,
                met: Cell::default(),
            };
            scope.spawn(move || feed.follow());
        }
        let view = View {
            scope,
            places,
            machines: &machines,
            signalled: &signalled,
            end,
        };
        let shown = if full {
            view.full_screen()
        } else {
            view.lines(screen);
            Ok(())
        };
        drop(leave);
        shown
    });
    all_confirmed(&machines)?;
    shown.map_err(|io| Failure::Output { io })?;
    let mut all = Map::new();
    for shared in machines.iter() {
        let panel = shared.panel();
        let name = identity::kind_name(shared.kind).to_owned();
        let status = match (&panel.rig, &panel.capsule) {
            (Some(status), _) => json!(status),
            (_, Some(status)) => json!(status),
            _ => Value::Null,
        };
        all.insert(
            name,
            json!({ "place": panel.place, "status": status, "missed_samples": panel.quality.missed }),
        );
    }
    Ok(Value::Object(all))
}

/// Ends the feeds when dropped.
struct Leave<'a>(&'a AtomicBool);

impl Drop for Leave<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn is_full_screen() -> bool {
    let dumb = std::env::var("TERM").is_ok_and(|term| term == "dumb");
    !dumb && io::stdout().is_terminal() && keyboard::is_there()
}

/// The screen and its keys.
struct View<'scope, 'env> {
    scope: &'scope Scope<'scope, 'env>,
    places: &'env Places<'env>,
    machines: &'env [Shared],
    signalled: &'env AtomicBool,
    end: Option<Instant>,
}

impl View<'_, '_> {
    fn is_over(&self) -> bool {
        self.signalled.load(Ordering::Relaxed)
            || self.end.is_some_and(|end| Instant::now() >= end)
            || terminal::panicked()
    }

    /// Prints a line per machine and second, until the end or until no reader is left.
    fn lines(&self, screen: &mut Screen<'_>) {
        let mut next = Instant::now() + LINE;
        loop {
            while Instant::now() < next && !self.is_over() {
                thread::sleep(Duration::from_millis(10));
            }
            next += LINE;
            for machine in self.machines {
                let line = machine.panel().line(Instant::now());
                if !screen.tell(&line) {
                    return;
                }
            }
            if self.is_over() {
                return;
            }
        }
    }

    fn full_screen(&self) -> io::Result<()> {
        let look = Look::of_environment();
        let taken = terminal::take()?;
        let result = self.dashboard(look);
        drop(taken);
        result
    }

    fn dashboard(&self, look: Look) -> io::Result<()> {
        let mut terminal = Terminal::new(Output::new())?;
        terminal.clear()?;
        while !self.is_over() {
            let panels: Vec<Panel> = self
                .machines
                .iter()
                .map(|machine| machine.panel().clone())
                .collect();
            terminal.draw(|frame| draw(&panels, look, Instant::now(), frame.buffer_mut()))?;
            let next = Instant::now() + DRAW;
            while event::poll(next.saturating_duration_since(Instant::now()))? {
                if self.key(&event::read()?) {
                    return Ok(());
                }
                if Instant::now() >= next {
                    break;
                }
            }
        }
        Ok(())
    }

    /// Handles a key; true if the person leaves.
    fn key(&self, event: &Event) -> bool {
        let Event::Key(key) = event else {
            return false;
        };
        if key.kind == KeyEventKind::Release {
            return false;
        }
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        match key.code {
            KeyCode::Char('c' | 'd') if control => return true,
            KeyCode::Char(_) if control => {}
            KeyCode::Char('q' | 'Q') => return true,
            KeyCode::Char('e' | 'E') => self.stop(Urgent::EStop),
            KeyCode::Char('s' | 'S' | ' ') => self.stop(Urgent::Stop),
            KeyCode::Char('h' | 'H') => self.pace(Pace::Hold),
            KeyCode::Char('r' | 'R') => self.pace(Pace::Resume),
            _ => {}
        }
        false
    }

    fn stop(&self, urgent: Urgent) {
        for machine in self.machines {
            machine.stop(urgent);
            if matches!(machine.panel().contact, Contact::Lost(_)) {
                // Use a thread of its own: the feed may be busy for seconds opening a line.
                let places = self.places;
                self.scope.spawn(move || machine.stop_directly(places));
            }
        }
    }

    fn pace(&self, pace: Pace) {
        for machine in self.machines {
            // Only the rig has runs to hold and resume.
            if machine.kind == DeviceKind::Rig {
                machine.pace(pace);
            }
        }
    }
}
