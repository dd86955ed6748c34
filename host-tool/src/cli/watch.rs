//! `watch`: prints a line per machine and second until Ctrl-C; with `--json` each line is a JSON object. It moves and
//! stops nothing, goes through the owner of a line, and gives up its own line to any process that needs it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, Once, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use client::address::Address;
use client::decimal::ShortSeconds;
use client::error::ClientError;
use client::{Observer, identity, visible};
use lab::operations::arguments::{Which, above_zero};
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::{DONE, Failure};
use lab::operations::finder::Finder;
use lab::operations::interrupt;
use lab::operations::panel::{self, Contact, Panel, TELEMETRY_MS};
use protocol::system::{DeviceKind, Event};
use protocol::table::Telemetry;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

/// Arguments of `watch`.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// The machines.
    #[command(flatten)]
    pub which: Which,
    /// End after this time in s; otherwise with Ctrl-C or another signal.
    #[arg(long, value_name = "S", value_parser = above_zero::<ShortSeconds>)]
    pub for_s: Option<ShortSeconds>,
}

/// Interval between two lines of a machine.
const LINE: Duration = Duration::from_secs(1);

/// Interval between two status requests, us. Each goes through the owner of the line.
const ASK_US: u64 = 250_000;

/// Longest wait for bytes before the machine is asked again or the line is given up, us.
const SLICE_US: u64 = 20_000;

/// Interval between attempts to connect, and time for which a line is left to another process.
const AGAIN: Duration = Duration::from_millis(500);

/// Time limit for exiting after a signal: a machine may just be opened.
const LEAVING: Duration = Duration::from_secs(3);

/// A signal to end has come. Global, because a process has one handler.
static SIGNALLED: AtomicBool = AtomicBool::new(false);

struct Machine {
    kind: DeviceKind,
    address: Address,
    panel: Mutex<Panel>,
}

impl Machine {
    // If a thread has panicked while holding the lock, show what is there.
    fn panel(&self) -> MutexGuard<'_, Panel> {
        self.panel.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observer for &Machine {
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.panel().sample(sample, missed, Instant::now());
    }
    fn event(&mut self, event: &Event) {
        self.panel().event(event);
    }
}

pub(crate) fn watch(
    args: &WatchArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut machines = vec![];
    for kind in finder.machines(&args.which)? {
        let address = finder.resolve(kind)?;
        machines.push(Machine {
            panel: Mutex::new(Panel::new(kind, address.to_string())),
            kind,
            address,
        });
    }
    leave_by_signal();
    let end = (args.for_s).map(|time| Instant::now() + Duration::from_micros(time.0.into()));
    // The lines are the result: no object follows them.
    let in_json = std::mem::take(&mut screen.json);
    let leaving = AtomicBool::new(false);
    thread::scope(|scope| {
        for machine in &machines {
            let leaving = &leaving;
            let thread = thread::Builder::new();
            thread
                .spawn_scoped(scope, move || follow(machine, finder, leaving))
                .map_err(|why| {
                    leaving.store(true, Ordering::Relaxed);
                    Failure::no_thread(why)
                })?;
        }
        let mut next = Instant::now() + LINE;
        loop {
            let is_over = || {
                SIGNALLED.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end)
            };
            rest_until(next, is_over);
            next += LINE;
            for machine in &machines {
                let text = line(&machine.panel(), in_json);
                screen.say(&text);
            }
            if screen.out.flush().is_err() || is_over() {
                break;
            }
        }
        leaving.store(true, Ordering::Relaxed);
        Ok(Value::Null)
    })
}

fn line(panel: &Panel, in_json: bool) -> String {
    let now = Instant::now();
    if !in_json {
        return panel.line(now);
    }
    let (lost, owner) = match &panel.contact {
        Contact::Lost(why) => (Some(why), None),
        Contact::Owned => (None, None),
        Contact::Broker(owner) => (None, Some(owner)),
    };
    let line = json!({
        "machine": identity::kind_name(panel.kind),
        "place": panel.place,
        "no_contact": lost,
        "owner": owner,
        "status": panel.rig.map_or(json!(panel.capsule), |status| json!(status)),
        "speed_um_s": panel.speed_um_s(now),
        "missed_samples": panel.quality.missed,
    });
    visible::json(&line.to_string()).into_owned()
}

/// A signal only exits: watching never stops a machine.
fn leave_by_signal() {
    static HANDLER: Once = Once::new();
    HANDLER.call_once(|| {
        interrupt::on_signals(|_| {
            SIGNALLED.store(true, Ordering::Relaxed);
            thread::sleep(LEAVING);
            std::process::exit(DONE.into());
        });
    });
}

/// Keeps the panel of a machine up to date, and reconnects whenever the line is lost.
fn follow(mut machine: &Machine, finder: &Finder<'_>, leaving: &AtomicBool) {
    while !leaving.load(Ordering::Relaxed) {
        match connection(&mut machine, finder, leaving) {
            Ok(()) => {}
            Err(Failure::Client(error)) if error.is_owner_gone() => {}
            Err(failure) => machine.panel().contact = Contact::Lost(failure.in_one_line()),
        }
        rest_until(Instant::now() + AGAIN, || leaving.load(Ordering::Relaxed));
    }
}

fn rest_until(end: Instant, is_over: impl Fn() -> bool) {
    while Instant::now() < end && !is_over() {
        thread::sleep(Duration::from_millis(10));
    }
}

/// Connects and observes until the connection is lost, a signal comes, or another process needs the line.
fn connection(
    machine: &mut &Machine,
    finder: &Finder<'_>,
    leaving: &AtomicBool,
) -> Result<(), Failure> {
    let mut device = finder.open(machine.kind, &machine.address, LinkPurpose::Watch)?;
    device.ask_once(true);
    device.hello(finder.connector.nonce())?;
    device.require(machine.kind)?;
    let owned = device.owner().is_none();
    if owned {
        device.set_telemetry(TELEMETRY_MS)?;
    }
    machine.panel().contact = match device.owner() {
        None => Contact::Owned,
        Some(owner) => Contact::Broker(owner.to_string()),
    };
    let mut asked_us = None;
    while !leaving.load(Ordering::Relaxed) && !device.is_line_wanted() {
        let now_us = device.now_us();
        let due = asked_us.is_none_or(|asked_us| now_us >= asked_us + ASK_US);
        if machine.panel().take_changed() || due {
            asked_us = Some(now_us);
            match panel::ask(&mut device, || machine.panel()) {
                // The owner is busy and will answer later.
                Ok(()) | Err(ClientError::Owned { busy: true, .. }) => {}
                Err(error) => return Err(error.into()),
            }
        }
        if device.interrupted().is_some() {
            // Another process has sent a stop through this one.
            device.settle()?;
            device.forget_stop();
        }
        device.observe(SLICE_US, machine)?;
    }
    if owned {
        // Ignore an error: the line is given up in any case.
        let _ = device.set_telemetry(0);
    }
    Ok(())
}
