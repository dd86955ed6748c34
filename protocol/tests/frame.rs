//! Frames in a stream: the longest frame, bytes that are no frame, and the counters.

use crate::parties::Raw;
use protocol::frame::{Deframer, Header, Kind, MAX_BODY, MAX_FRAME, TooLong, encode};

const HEADER: Header = Header {
    kind: Kind::Reply,
    session: 0xFF,
    seq: 0xFFFF,
};

/// The bodies of all frames in a stream.
fn bodies(deframer: &mut Deframer, bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut found = vec![];
    for &byte in bytes {
        found.extend(deframer.push(byte).map(|frame| frame.body().to_vec()));
    }
    found
}

/// Frames these bytes with a correct CRC.
fn with_crc(content: &[u8]) -> Vec<u8> {
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI).checksum(content);
    let raw = [content, &crc.to_le_bytes()].concat();
    let mut block = vec![0; raw.len() + 2];
    let length = cobs::encode(&raw, &mut block);
    block.truncate(length);
    [&[0], &block[..], &[0]].concat()
}

#[test]
fn a_body_of_the_greatest_size_fits_and_one_byte_more_does_not() {
    for byte in [0x00, 0xA5, 0xFF] {
        let body = [byte; MAX_BODY + 1];
        let frame = encode(HEADER, &Raw(body[1..].to_vec())).expect("it fits");
        assert_eq!(frame.len(), MAX_FRAME, "no room is wasted");
        assert_eq!(bodies(&mut Deframer::new(), &frame), [&body[1..]]);
        assert_eq!(encode(HEADER, &Raw(body.to_vec())), Err(TooLong));
    }
    assert_eq!(encode(HEADER, &Raw(vec![1; 10 * MAX_BODY])), Err(TooLong));
}

#[test]
fn good_frames_and_bare_delimiters_are_not_counted() {
    let mut deframer = Deframer::new();
    let frame = encode(HEADER, &Raw(b"body".to_vec())).unwrap();
    let stream = [&[0, 0, 0], &frame[..], &[0, 0], &frame[..]].concat();
    assert_eq!(bodies(&mut deframer, &stream), [b"body", b"body"]);
    assert_eq!(deframer.rejected(), 0);
}

#[test]
fn each_bad_block_is_counted_once() {
    let good = encode(HEADER, &Raw(b"body".to_vec())).unwrap();
    let mut flipped = good.to_vec();
    flipped[5] ^= 0x10;
    let cases: [(&str, Vec<u8>); 6] = [
        ("a flipped bit", flipped),
        ("a run that ends before its length", vec![0, 9, 1, 2, 0]),
        ("no room for head and CRC", with_crc(&[])),
        ("no room for the head", with_crc(&[2, 1, 1])),
        ("a kind that does not exist", with_crc(&[6, 1, 1, 0, 7])),
        ("kind 0", with_crc(&[0, 1, 1, 0, 7])),
    ];
    let mut deframer = Deframer::new();
    for (count, (what, bytes)) in (1..).zip(&cases) {
        assert!(bodies(&mut deframer, bytes).is_empty(), "{what}");
        assert_eq!(deframer.rejected(), count, "{what}");
        assert_eq!(bodies(&mut deframer, &good), [b"body"], "after {what}");
    }
}

#[test]
fn noise_longer_than_any_frame_is_one_bad_block() {
    let good = encode(HEADER, &Raw(b"body".to_vec())).unwrap();
    let mut deframer = Deframer::new();
    for (count, length) in (1..).zip([MAX_FRAME - 1, MAX_FRAME, 1_000]) {
        assert!(bodies(&mut deframer, &vec![0x55; length]).is_empty());
        // The frame's leading delimiter ends the noise.
        assert_eq!(bodies(&mut deframer, &good), [b"body"], "{length}");
        assert_eq!(deframer.rejected(), count, "{length}");
    }
}

/// A good frame of the greatest length is rejected if more bytes follow before the delimiter.
#[test]
fn a_frame_does_not_end_before_its_delimiter() {
    let longest = encode(HEADER, &Raw(vec![0xA5; MAX_BODY])).unwrap();
    let (end, unfinished) = longest.split_last().unwrap();
    let mut deframer = Deframer::new();
    let stream = [unfinished, &[1, 1], &[*end]].concat();
    assert!(bodies(&mut deframer, &stream).is_empty());
    assert_eq!(deframer.rejected(), 1);
    assert_eq!(bodies(&mut deframer, &longest).len(), 1);
}
