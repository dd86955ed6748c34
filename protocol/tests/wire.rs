//! The bytes on the wire. A change here is a change of the protocol: raise the version, then write the snapshot anew
//! with `INSTA_UPDATE=always cargo test -p protocol --test all wire`.

use protocol::{
    frame::{Deframer, Kind, MAX_BODY, encode},
    system::{Event, Urgent},
    table::{Impact, Reply, Request, SCHEMA_KEY, Telemetry},
};
use std::fmt::Write;

#[test]
fn golden_bytes_of_every_message() {
    let mut text = format!("schema key {SCHEMA_KEY:016x}\n");
    for (name, frame) in exemplars::frames::all() {
        let _ = write!(text, "{name:<48} ");
        for byte in &frame {
            let _ = write!(text, "{byte:02x}");
        }
        text.push('\n');
    }
    insta::assert_snapshot!("golden", text);
}

/// The exemplars cover the table: every row has golden bytes for its request and its response.
#[test]
fn every_row_has_exemplars() {
    for name in Request::NAMES {
        let request = exemplars::requests()
            .iter()
            .any(|request| request.name() == *name);
        let response = exemplars::responses()
            .iter()
            .any(|response| exemplars::frames::name(response).starts_with(name));
        assert!(request && response, "{name} has no exemplar");
    }
}

#[test]
fn every_request_stands_in_the_table_of_the_manual() {
    let page = include_str!("../../docs/protocol.md");
    for request in exemplars::requests() {
        let name = request.name();
        let number = Request::NAMES.iter().position(|known| *known == name);
        let changes = match request.impact() {
            Impact::None => "nothing",
            Impact::Fault => "the fault",
            Impact::Flash => "flash",
            Impact::Pace => "the run",
            Impact::Motion => "moves",
        };
        let row = format!("\n| {} | `{name}` | {changes} |", number.unwrap());
        assert!(page.contains(&row), "docs/protocol.md lacks a row {row}");
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
    // The bound is tight enough to reveal a message that grows.
    assert!(longest + 40 > MAX_BODY, "{longest}");
}

#[test]
fn every_frame_comes_back() {
    for (name, bytes) in exemplars::frames::all() {
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
