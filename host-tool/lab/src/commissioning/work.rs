//! Commissioning session with a machine: helpers for all measurements.

pub mod rig;

use std::path::PathBuf;

use client::subject::Subject;
use client::{Device, Unobserved};
use protocol::settings::SettingKey;
use serde_json::{Map, Value};

use crate::commissioning::halt::Halt;
use crate::commissioning::operator::{Act, Operator, Part, Reading};

/// Interval between two status requests, us.
pub(crate) const POLL_US: u64 = 50_000;
/// Time limit for finding a board after a reset or after its cable was plugged in, us.
const RETURN_US: u64 = 30_000_000;

#[derive(Clone, Debug)]
pub struct Options {
    /// Cycles of the read-back test, of two strokes each.
    pub read_back_cycles: u16,
    /// Cycles of the run at the end.
    pub cycles: u16,
    /// Duration of the clock comparison, us.
    pub clock_us: u64,
    pub image: Option<PathBuf>,
}

/// Opens the machine again after a reset or after unplugging; the text says why that fails.
pub type Reopen<'a> = dyn Fn() -> Result<Device, String> + 'a;

pub struct Work<'a> {
    pub device: Device,
    pub subject: Subject,
    pub options: Options,
    operator: &'a mut dyn Operator,
    say: &'a mut dyn FnMut(&str),
    reopen: &'a Reopen<'a>,
    supply: Option<bool>,
    pub(crate) measured: Map<String, Value>,
}

impl<'a> Work<'a> {
    pub fn new(
        device: Device,
        subject: Subject,
        options: Options,
        operator: &'a mut dyn Operator,
        say: &'a mut dyn FnMut(&str),
        reopen: &'a Reopen<'a>,
    ) -> Self {
        Self {
            device,
            subject,
            options,
            operator,
            say,
            reopen,
            supply: None,
            measured: Map::new(),
        }
    }

    pub fn has_operator(&self) -> bool {
        self.operator.present()
    }

    pub fn say(&mut self, text: &str) {
        (self.say)(text);
    }

    pub fn note(&mut self, name: &str, value: impl Into<Value>) {
        self.measured.insert(name.to_owned(), value.into());
    }

    /// Takes the measurements made since the last call.
    pub fn take_measured(&mut self) -> Map<String, Value> {
        std::mem::take(&mut self.measured)
    }

    pub fn setting(&self, key: SettingKey) -> u32 {
        self.subject.setting(key)
    }

    /// Number of the board's starts since its supply was switched on: a new one shows a reset.
    pub fn boot_id(&self) -> Option<u32> {
        self.device.identity().map(|identity| identity.boot_id)
    }

    pub fn pause(&mut self, duration_us: u64) -> Result<(), Halt> {
        self.device.idle(duration_us, &mut Unobserved)?;
        self.unless_aborted()
    }

    /// Ends a measurement whose operator has quit.
    pub fn unless_aborted(&self) -> Result<(), Halt> {
        match self.device.interrupted() {
            Some(_) => Err(Halt::Aborted),
            None => Ok(()),
        }
    }

    /// Requests an act whose effect no input shows.
    pub fn hand(&mut self, part: Part, on: bool) -> Result<(), Halt> {
        let device = &mut self.device;
        let mut keep = || {
            device.idle(POLL_US, &mut Unobserved)?;
            Ok(false)
        };
        self.operator
            .act(Act { part, on }, false, self.say, &mut keep)?;
        self.unless_aborted()
    }

    pub fn read(&mut self, reading: Reading) -> Result<i64, Halt> {
        let value = self.operator.read(reading, self.say)?;
        self.unless_aborted()?;
        Ok(value)
    }

    /// Has the cable pulled and plugged in, and finds the board again.
    pub fn pull_the_cable(&mut self) -> Result<(), Halt> {
        let device = &mut self.device;
        let mut gone = || Ok(device.idle(POLL_US, &mut Unobserved).is_err());
        let act = |on| Act {
            part: Part::Cable,
            on,
        };
        self.operator.act(act(false), true, self.say, &mut gone)?;
        self.operator
            .act(act(true), false, self.say, &mut || Ok(false))
            .and_then(|()| self.unless_aborted())?;
        self.find_again()
    }

    pub fn find_again(&mut self) -> Result<(), Halt> {
        // Drop the link first: a port is opened exclusively.
        self.device.hang_up();
        self.unless_aborted()?;
        let begin = std::time::Instant::now();
        loop {
            match (self.reopen)() {
                Ok(device) => {
                    self.device = device;
                    return self.unless_aborted();
                }
                Err(why) if begin.elapsed().as_micros() > RETURN_US.into() => {
                    return Err(Halt::Defect(format!("the board does not come back: {why}")));
                }
                Err(_) => {
                    // Fails without a link, but notices that the operator quits.
                    let _ = self.device.keep_alive();
                    self.unless_aborted()?;
                    std::thread::sleep(std::time::Duration::from_millis(300));
                }
            }
        }
    }
}
