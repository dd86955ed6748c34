//! Every exemplar as a frame.

use protocol::{
    frame::{Encoded, Header, Kind, encode},
    system::Urgent,
};
use serde::Serialize;
use std::fmt::Debug;

fn frame<T: Serialize>(kind: Kind, body: &T) -> Encoded {
    encode(
        Header {
            kind,
            session: 0x5a,
            seq: 0x1234,
        },
        body,
    )
    .expect("every message fits")
}

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

/// Every exemplar with its name, as frames of session 0x5a with the number 0x1234.
pub fn all() -> Vec<(String, Encoded)> {
    let mut frames = Vec::new();
    for message in super::requests() {
        frames.push((
            format!("request {}", name(&message)),
            frame(Kind::Request, &message),
        ));
    }
    for message in super::replies() {
        frames.push((
            format!("reply {}", name(&message)),
            frame(Kind::Reply, &message),
        ));
    }
    for message in [Urgent::Stop, Urgent::EStop] {
        frames.push((
            format!("urgent {}", name(&message)),
            frame(Kind::Urgent, &message),
        ));
    }
    for message in super::telemetry() {
        frames.push((
            format!("telemetry {}", name(&message)),
            frame(Kind::Telemetry, &message),
        ));
    }
    for message in super::events() {
        frames.push((
            format!("event {}", name(&message.what)),
            frame(Kind::Event, &message),
        ));
    }
    frames
}
