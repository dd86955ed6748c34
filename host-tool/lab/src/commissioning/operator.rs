//! Operator of a machine, who presses, pulls and measures: a person at the terminal, or the virtual bench's fixture.
//!
//! The fixture listens on its own TCP port. Each side sends lines of text:
//!
//! | line | meaning | answer |
//! |---|---|---|
//! | `do PART on`, `do PART off` | an [`Act`]; the parts are those of [`Part::name`] | `done` |
//! | `read WHAT` | a [`Reading`] | `value N` |
//! | anything else, or what this machine does not have | | `error TEXT` |

use std::fmt;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::str::FromStr;
use std::time::Duration;

use client::error::ClientError;

use crate::commissioning::halt::Halt;
use crate::outcomes;

/// Time allowed for the fixture: pulling a cable takes some seconds.
const PATIENCE: Duration = Duration::from_secs(30);

outcomes! {
    Part {
        /// The home flag, actuated or released.
        HomeFlag: "home-flag",
        /// The far limit, actuated or released.
        FarLimit: "far-limit",
        /// The E-stop button, pressed or released.
        EStop: "e-stop",
        /// The end-of-travel switch beyond home, actuated or released.
        HomeEnd: "home-end",
        /// The end-of-travel switch beyond the far end, actuated or released.
        FarEnd: "far-end",
        /// The read-back jumper D2-A0, plugged or pulled.
        Jumper: "jumper",
        Supply: "motor-supply",
        /// The cable to the host, plugged or pulled.
        Cable: "cable",
        /// The capsule's motor shaft, held or released.
        Rotor: "rotor",
        /// The carriage: `on` moves it to the middle of its travel by hand.
        Carriage: "carriage",
    }
}

outcomes! {
    Reading {
        /// EN (D8) against GND while the reset button is held, mV. The board restarts afterwards.
        EnableInReset: "enable-in-reset-mv",
        /// Distance of the carriage from any fixed point, um, by a caliper.
        Carriage: "carriage-um",
        /// Battery voltage, mV, by a meter.
        Battery: "battery-mv",
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Act {
    pub part: Part,
    /// True: actuated, pressed, plugged, switched on.
    pub on: bool,
}

/// A line sent to the fixture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Instruction {
    Do(Act),
    Read(Reading),
}

impl fmt::Display for Instruction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Do(act) => {
                let how = if act.on { "on" } else { "off" };
                write!(f, "do {} {how}", act.part.name())
            }
            Self::Read(reading) => write!(f, "read {}", reading.name()),
        }
    }
}

impl FromStr for Instruction {
    type Err = String;

    fn from_str(line: &str) -> Result<Self, String> {
        let words: Vec<_> = line.split_whitespace().collect();
        let instruction = match words[..] {
            ["do", name, how @ ("on" | "off")] => {
                let part = Part::ALL.iter().find(|part| part.name() == name);
                let on = how == "on";
                part.map(|part| Self::Do(Act { part: *part, on }))
            }
            ["read", name] => {
                let what = Reading::ALL.iter().find(|what| what.name() == name);
                what.map(|what| Self::Read(*what))
            }
            _ => None,
        };
        instruction.ok_or_else(|| {
            let parts: Vec<_> = Part::ALL.iter().map(|part| part.name()).collect();
            let readings: Vec<_> = Reading::ALL.iter().map(|reading| reading.name()).collect();
            format!(
                "`{line}` is neither `do PART on|off` nor `read WHAT`; parts: {}; what: {}",
                parts.join(", "),
                readings.join(", ")
            )
        })
    }
}

pub type Say<'a> = dyn FnMut(&str) + 'a;

/// Checks the machine for the effect of an act, and keeps its link alive. True once the effect is detected.
pub type Watch<'a> = dyn FnMut() -> Result<bool, ClientError> + 'a;

pub trait Operator {
    fn present(&self) -> bool {
        true
    }

    /// Requests an act, and returns when it is done or when `watch` detects its effect. `shows`: an input shows the
    /// effect. [`Halt::NotShown`] if it is not done.
    fn act(
        &mut self,
        act: Act,
        shows: bool,
        say: &mut Say<'_>,
        watch: &mut Watch<'_>,
    ) -> Result<(), Halt>;

    fn read(&mut self, reading: Reading, say: &mut Say<'_>) -> Result<i64, Halt>;
}

/// No operator: nothing can be done or measured.
#[derive(Clone, Copy, Debug)]
pub struct NoOperator;

/// Result of a step that needs an operator where there is none.
pub(crate) fn needs_operator() -> Halt {
    Halt::NotShown("needs a person at the machine".to_owned())
}

impl Operator for NoOperator {
    fn present(&self) -> bool {
        false
    }

    fn act(&mut self, _: Act, _: bool, _: &mut Say<'_>, _: &mut Watch<'_>) -> Result<(), Halt> {
        Err(needs_operator())
    }

    fn read(&mut self, _: Reading, _: &mut Say<'_>) -> Result<i64, Halt> {
        Err(needs_operator())
    }
}

pub struct RemoteFixture {
    place: String,
    stream: BufReader<TcpStream>,
}

impl RemoteFixture {
    pub fn connect(place: &str) -> std::io::Result<Self> {
        let stream = TcpStream::connect(place)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        Ok(Self {
            place: place.to_owned(),
            stream: BufReader::new(stream),
        })
    }

    fn ask(&mut self, instruction: Instruction, say: &mut Say<'_>) -> Result<Option<i64>, Halt> {
        say(&format!("  fixture: {instruction}"));
        let mut answer = String::new();
        let asked = writeln!(self.stream.get_mut(), "{instruction}")
            .and_then(|()| self.stream.read_line(&mut answer));
        let lost = |why: &str| Halt::FixtureLost(format!("the fixture at {}: {why}", self.place));
        match asked {
            Err(io) => Err(lost(&io.to_string())),
            Ok(0) => Err(lost("the other end closed the connection")),
            Ok(_) => match answer.trim().split_once(' ') {
                None if answer.trim() == "done" => Ok(None),
                Some(("value", number)) => number
                    .parse()
                    .map(Some)
                    .map_err(|_| lost(&format!("no number: {number}"))),
                Some(("error", why)) => Err(Halt::NotShown(why.to_owned())),
                _ => Err(lost(&format!("no answer: {}", answer.trim()))),
            },
        }
    }
}

impl Operator for RemoteFixture {
    fn act(&mut self, act: Act, _: bool, say: &mut Say<'_>, _: &mut Watch<'_>) -> Result<(), Halt> {
        self.ask(Instruction::Do(act), say).map(|_| ())
    }

    fn read(&mut self, reading: Reading, say: &mut Say<'_>) -> Result<i64, Halt> {
        let instruction = Instruction::Read(reading);
        self.ask(instruction, say)?.ok_or_else(|| {
            Halt::FixtureLost(format!("the fixture at {} measured nothing", self.place))
        })
    }
}
