//! Common parts of both machines' control: its surroundings, and the requests that both answer alike.

use crate::retained::EStop;
use protocol::{
    error::{Field, Refusal},
    events::EventRing,
    system::{Chip, Done, Event, LastWords, SetTelemetry},
    table::{Reply, Request, Response},
};

/// Control's surroundings, in either machine.
pub trait Surroundings {
    /// Device time.
    fn now_us(&self) -> u64;
    /// State of the chip's clock, supply and option bytes.
    fn chip(&self) -> Chip;
    /// How long the host that began the motion has been silent, us.
    fn silence_us(&self) -> u32;
    /// Sets the interval of telemetry, ms; 0 = none.
    fn set_telemetry(&mut self, period_ms: u16);
    /// Keeps an E-stop over a reset, or forgets it.
    fn keep_latched(&mut self, estop: Option<EStop>);
    /// Logs an event, and sends it to the host if one listens.
    fn tell(&mut self, event: &Event);
}

/// Work left after a request, besides the machine's actions. `C` is a change of the data in flash.
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Effect<C> {
    /// Nothing.
    None,
    /// Change the interval of telemetry.
    Telemetry {
        /// In ms; 0 = none.
        period_ms: u16,
    },
    /// Record that a fault was acknowledged.
    Acknowledged,
    /// Write this to flash, then put it into force.
    Store(C),
}

/// Outcome of a request.
#[derive(Clone, Debug)]
pub struct Executed<A, C> {
    /// Answer for the host.
    pub reply: Reply,
    /// Actions of the state machine.
    pub actions: A,
    /// Work besides these.
    pub effect: Effect<C>,
}

impl<A, C> Executed<A, C> {
    /// Outcome of a request that was answered or refused.
    pub fn new(answer: Result<(Response, Effect<C>), Refusal>, actions: A) -> Self {
        let (reply, effect) = match answer {
            Ok((response, effect)) => (Reply::Accepted(response), effect),
            Err(refusal) => (Reply::Refused(refusal), Effect::None),
        };
        Self {
            reply,
            actions,
            effect,
        }
    }
}

/// Data for answering the common requests.
#[derive(Clone, Copy, Debug)]
pub struct About<'a> {
    /// Events so far.
    pub events: &'a EventRing,
    /// Text of the last panic or processor fault.
    pub last_words: &'a str,
    /// Clock, supply and option bytes.
    pub chip: Chip,
}

impl About<'_> {
    /// Answers a request; none if it is not a common one.
    ///
    /// # Errors
    /// An interval out of range.
    pub fn answer<C>(&self, request: &Request) -> Result<Option<(Response, Effect<C>)>, Refusal> {
        let response = match request {
            Request::KeepAlive(_) => Response::KeepAlive(Done),
            Request::GetLastWords(_) => Response::GetLastWords(LastWords {
                text: self.last_words.try_into().unwrap_or_default(),
            }),
            Request::SetTelemetry(set) => {
                let (period_ms, (min, max)) = (set.period_ms, SetTelemetry::PERIOD_MS);
                if period_ms != 0 && !(min..=max).contains(&period_ms) {
                    return Err(Refusal::OutOfRange {
                        field: Field::PeriodMs,
                        requested: period_ms.into(),
                        min: min.into(),
                        max: max.into(),
                    });
                }
                let response = Response::SetTelemetry(*set);
                return Ok(Some((response, Effect::Telemetry { period_ms })));
            }
            Request::GetChip(_) => Response::GetChip(self.chip),
            Request::GetEvents(get) => Response::GetEvents(self.events.since(get.from)),
            _ => return Ok(None),
        };
        Ok(Some((response, Effect::None)))
    }
}
