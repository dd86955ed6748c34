//! Requests that both machines answer alike.

use protocol::{
    error::{Field, Refusal},
    events::EventRing,
    system::{Done, LastWords, SetTelemetry},
    table::{Request, Response},
};

/// Shortest and longest interval of telemetry, ms.
pub const TELEMETRY_MS: (u16, u16) = (5, 1_000);

/// What the common requests are answered from.
#[derive(Clone, Copy, Debug)]
pub struct About<'a> {
    /// Events so far.
    pub events: &'a EventRing,
    /// Text of the last panic or processor fault.
    pub last_words: &'a str,
}

impl About<'_> {
    /// Answers a request that changes nothing but the interval of telemetry, which the caller sets; none if the
    /// request is not a common one.
    ///
    /// # Errors
    /// An interval out of range.
    pub fn answer(&self, request: &Request) -> Result<Option<Response>, Refusal> {
        Ok(Some(match request {
            Request::KeepAlive(_) => Response::KeepAlive(Done),
            Request::GetLastWords(_) => Response::GetLastWords(LastWords {
                text: self.last_words.try_into().unwrap_or_default(),
            }),
            Request::SetTelemetry(set) => {
                telemetry_interval(set.period_ms)?;
                Response::SetTelemetry(*set)
            }
            Request::GetEvents(get) => Response::GetEvents(self.events.since(get.from)),
            _ => return Ok(None),
        }))
    }
}

fn telemetry_interval(period_ms: u16) -> Result<(), Refusal> {
    let (min, max) = TELEMETRY_MS;
    if period_ms == 0 || (min..=max).contains(&period_ms) {
        return Ok(());
    }
    Err(Refusal::OutOfRange {
        field: Field::PeriodMs,
        requested: period_ms.into(),
        min: min.into(),
        max: max.into(),
    })
}

/// The interval of telemetry that an accepted request asks for, ms; 0 = none.
#[must_use]
pub fn asked_telemetry_ms(response: &Response) -> Option<u16> {
    match response {
        Response::SetTelemetry(SetTelemetry { period_ms }) => Some(*period_ms),
        _ => None,
    }
}
