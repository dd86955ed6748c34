//! Common parts of both machines' control: its surroundings, and the requests that both answer alike.

use crate::{retained::EStop, settings::Values};
use heapless::String;
use protocol::{
    error::{Field, Refusal},
    events::EventRing,
    settings::{GetSetting, MAX_NAME, Name, Setting, SettingRule},
    system::{Chip, DeviceKind, Done, Event, LastWords, SetTelemetry},
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
    fn send_event(&mut self, event: &Event);
}

/// A change of the settings in flash. `S` is the machine's own type of settings, made from all values.
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change<S> {
    Value {
        setting: Setting,
        settings: S,
    },
    Name(String<MAX_NAME>),
    /// Restores the defaults of all values and of the name.
    Reset,
}

/// Work that control does after a request, besides the machine's actions.
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Effect<S> {
    None,
    /// Change the interval of telemetry.
    Telemetry {
        /// In ms; 0 = none.
        period_ms: u16,
    },
    /// Record that a fault was acknowledged.
    Acknowledged,
    /// Write this to flash, then put it into force.
    Store(Change<S>),
}

#[derive(Clone, Debug)]
pub struct Executed<A, S> {
    pub reply: Reply,
    pub actions: A,
    /// Work besides these.
    pub effect: Effect<S>,
}

impl<A, S> Executed<A, S> {
    /// Result of a request that was answered or refused.
    pub fn new(answer: Result<(Response, Effect<S>), Refusal>, actions: A) -> Self {
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
    pub kind: DeviceKind,
    pub events: &'a EventRing,
    /// Text of the last panic or processor fault.
    pub last_words: &'a str,
    /// Clock, supply and option bytes.
    pub chip: Chip,
    /// Settings as single values.
    pub values: &'a Values,
    pub name: &'a str,
}

impl About<'_> {
    /// Answers a request; none if it is not a common one. `may_change` tells whether the settings may be changed now;
    /// `settings` converts all values.
    ///
    /// # Errors
    /// An interval or a setting out of range, a setting that contradicts others, a name with control characters, or a
    /// change at the wrong time.
    pub fn answer<S>(
        &self,
        request: &Request,
        may_change: impl FnOnce() -> Result<(), Refusal>,
        settings: impl FnOnce(&Values) -> Result<S, SettingRule>,
    ) -> Result<Option<(Response, Effect<S>)>, Refusal> {
        let store = |response, change| Ok(Some((response, Effect::Store(change))));
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
            Request::GetSetting(GetSetting { key }) if key.is_of(self.kind) => {
                Response::GetSetting(Setting {
                    key: *key,
                    value: self.values.get(*key),
                })
            }
            Request::GetName(_) => Response::GetName(Name {
                name: self.name.try_into().unwrap_or_default(),
            }),
            Request::SetSetting(setting) if setting.key.is_of(self.kind) => {
                may_change()?;
                let (setting, key) = (*setting, setting.key);
                let values = self.values.with(key, setting.value)?;
                let settings =
                    settings(&values).map_err(|rule| Refusal::SettingRule { key, rule })?;
                let change = Change::Value { setting, settings };
                return store(Response::SetSetting(setting), change);
            }
            Request::SetName(name) => {
                may_change()?;
                // A terminal would obey an escape sequence in the name.
                if name.name.chars().any(char::is_control) {
                    return Err(Refusal::NameNotPrintable);
                }
                let change = Change::Name(name.name.clone());
                return store(Response::SetName(name.clone()), change);
            }
            Request::FactoryReset(_) => {
                may_change()?;
                return store(Response::FactoryReset(Done), Change::Reset);
            }
            _ => return Ok(None),
        };
        Ok(Some((response, Effect::None)))
    }
}
