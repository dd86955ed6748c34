//! The bytes on the wire. A change here is a change of the protocol: raise the version, then regenerate with
//! `BLESS=1 cargo test -p protocol --test wire`.

#[allow(missing_docs, dead_code, unreachable_pub)]
mod exemplars;

use protocol::{
    frame::{Deframer, Encoded, Header, Kind, MAX_BODY, encode},
    system::{Event, Urgent},
    table::{Reply, Request, SCHEMA_KEY, TABLE, Telemetry},
};
use serde::Serialize;
use std::{fmt::Debug, fmt::Write, fs, path::Path};

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

/// Name without its fields: `Rig(Homed { .. })` becomes `Rig.Homed`.
fn name(value: &impl Debug) -> String {
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

fn all_frames() -> Vec<(String, Encoded)> {
    let mut frames = Vec::new();
    for message in exemplars::requests() {
        frames.push((
            format!("request {}", name(&message)),
            frame(Kind::Request, &message),
        ));
    }
    for message in exemplars::replies() {
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
    for message in exemplars::telemetry() {
        frames.push((
            format!("telemetry {}", name(&message)),
            frame(Kind::Telemetry, &message),
        ));
    }
    for message in exemplars::events() {
        frames.push((
            format!("event {}", name(&message.what)),
            frame(Kind::Event, &message),
        ));
    }
    frames
}

#[test]
fn golden_bytes_of_every_message() {
    let mut text = format!("schema key {SCHEMA_KEY:016x}\n");
    for (name, frame) in all_frames() {
        let _ = write!(text, "{name:<48} ");
        for byte in &frame {
            let _ = write!(text, "{byte:02x}");
        }
        text.push('\n');
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden.txt");
    if std::env::var_os("BLESS").is_some() {
        fs::write(&path, &text).expect("golden.txt can be written");
    }
    let golden = fs::read_to_string(&path).expect("golden.txt is part of the sources");
    for (was, is) in golden.lines().zip(text.lines()) {
        assert_eq!(
            was, is,
            "the wire format changed: raise the version, then regenerate with BLESS=1"
        );
    }
    assert_eq!(
        golden.lines().count(),
        text.lines().count(),
        "messages without golden bytes: regenerate with BLESS=1"
    );
}

/// The exemplars cover the table: no row without golden bytes for its request and its response.
#[test]
fn every_row_has_exemplars() {
    for row in TABLE {
        let request = exemplars::requests()
            .iter()
            .any(|request| request.row().name == row.name);
        let response = exemplars::responses()
            .iter()
            .any(|response| name(response).starts_with(row.name));
        assert!(request && response, "{} has no exemplar", row.name);
    }
}

#[test]
fn every_message_fits() {
    let longest = exemplars::replies()
        .iter()
        .map(|reply| postcard::to_stdvec(reply).unwrap().len())
        .max()
        .unwrap();
    assert!(longest <= MAX_BODY, "{longest}");
    // The bound is tight enough to notice a message that grows.
    assert!(longest + 40 > MAX_BODY, "{longest}");
}

#[test]
fn every_frame_comes_back() {
    for (name, bytes) in all_frames() {
        let mut deframer = Deframer::new();
        let (last, before) = bytes.split_last().unwrap();
        for byte in before {
            assert!(
                deframer.push(*byte).is_none(),
                "{name}: a frame before its end"
            );
        }
        let frame = deframer
            .push(*last)
            .unwrap_or_else(|| panic!("{name} was not recognised"));
        assert_eq!((frame.header.session, frame.header.seq), (0x5a, 0x1234));
        let again = match frame.header.kind {
            Kind::Request => encode(frame.header, &frame.decode::<Request>().unwrap()),
            Kind::Reply => encode(frame.header, &frame.decode::<Reply>().unwrap()),
            Kind::Urgent => encode(frame.header, &frame.decode::<Urgent>().unwrap()),
            Kind::Telemetry => encode(frame.header, &frame.decode::<Telemetry>().unwrap()),
            Kind::Event => encode(frame.header, &frame.decode::<Event>().unwrap()),
        };
        assert_eq!(again.unwrap(), bytes, "{name}");
    }
}

#[test]
fn trailing_bytes_are_not_a_message() {
    let frame_bytes = encode(
        Header {
            kind: Kind::Request,
            session: 1,
            seq: 2,
        },
        &(exemplars::requests()[1].clone(), 0_u8),
    );
    let mut deframer = Deframer::new();
    let bytes = frame_bytes.unwrap();
    let (last, before) = bytes.split_last().unwrap();
    before
        .iter()
        .for_each(|byte| assert!(deframer.push(*byte).is_none()));
    assert_eq!(deframer.push(*last).unwrap().decode::<Request>(), None);
}
