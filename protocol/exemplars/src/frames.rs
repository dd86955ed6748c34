//! Every exemplar as a frame.

use protocol::{
    frame::{Encoded, Header, Kind, encode},
    system::Urgent,
};
use serde::Serialize;
use std::fmt::Debug;

/// Name of a value without its fields: `Rig(Homed { .. })` becomes `Rig.Homed`.
pub fn name(value: &impl Debug) -> String {
    let text = format!("{value:?}");
    let mut name = String::new();
    let mut words = text
        .split(['(', ' ', ')', '{', ','])
        .filter(|word| !word.is_empty());
    while let Some(word) = words
        .next()
        .filter(|word| word.chars().all(char::is_alphanumeric))
    {
        if !name.is_empty() {
            name.push('.');
        }
        name += word;
        if name.matches('.').count() == 3 || word.chars().all(|c| c.is_ascii_digit()) {
            break;
        }
    }
    name
}

/// Frames of these messages, each with the name that `named` gives.
fn frames<T: Serialize>(
    kind: Kind,
    messages: impl IntoIterator<Item = T>,
    named: impl Fn(&T) -> String,
) -> impl Iterator<Item = (String, Encoded)> {
    let header = Header {
        kind,
        session: 0x5a,
        seq: 0x1234,
    };
    messages.into_iter().map(move |message| {
        let kind = format!("{kind:?}").to_lowercase();
        let frame = encode(header, &message).expect("every message fits");
        (format!("{kind} {}", named(&message)), frame)
    })
}

/// Every exemplar with its name, as frames of session 0x5a with the number 0x1234.
pub fn all() -> Vec<(String, Encoded)> {
    let urgent = [Urgent::Stop, Urgent::EStop];
    frames(Kind::Request, super::requests(), name)
        .chain(frames(Kind::Reply, super::replies(), name))
        .chain(frames(Kind::Urgent, urgent, name))
        .chain(frames(Kind::Telemetry, super::telemetry(), name))
        .chain(frames(Kind::Event, super::events(), |event| {
            name(&event.what)
        }))
        .collect()
}
