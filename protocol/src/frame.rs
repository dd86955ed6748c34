//! The frame: encoding, decoding and the deframer that finds frames in a stream.

use serde::{Serialize, de::DeserializeOwned};

/// Largest body in bytes; the test `every_message_fits` measures it.
pub const MAX_BODY: usize = 160;
/// Kind, session and sequence.
const HEAD: usize = 4;
const CRC: usize = 4;
/// Largest frame before COBS.
const MAX_RAW: usize = HEAD + MAX_BODY + CRC;
/// Largest COBS block: one byte of overhead per 254.
const MAX_COBS: usize = cobs::max_encoding_length(MAX_RAW);
/// Largest frame on the wire, with both delimiters.
pub const MAX_FRAME: usize = MAX_COBS + 2;

/// CRC-32C with a lookup table, 1 KB of flash: the rig sends up to 200 frames a second.
const CRC32C: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);

/// An encoded frame, ready for the wire.
pub type Encoded = heapless::Vec<u8, MAX_FRAME>;

/// Kinds of frame; see the table in the crate documentation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// Host to device: [`crate::table::Request`].
    Request = 1,
    /// Device to host: [`crate::table::Reply`].
    Reply = 2,
    /// Host to device: [`crate::system::Urgent`].
    Urgent = 3,
    /// Device to host: [`crate::table::Telemetry`].
    Telemetry = 4,
    /// Device to host: [`crate::system::Event`].
    Event = 5,
}

impl Kind {
    const fn from_u8(byte: u8) -> Option<Self> {
        Some(match byte {
            1 => Kind::Request,
            2 => Kind::Reply,
            3 => Kind::Urgent,
            4 => Kind::Telemetry,
            5 => Kind::Event,
            _ => return None,
        })
    }
}

/// Kind, session and sequence number of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    pub kind: Kind,
    /// Session number; 0 outside a session.
    pub session: u8,
    /// Sequence number; the table in the crate documentation says what it counts for each kind.
    pub seq: u16,
}

/// A received frame with a good CRC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Kind, session and sequence number.
    pub header: Header,
    body: &'a [u8],
}

impl Frame<'_> {
    /// The body's bytes.
    pub fn body(&self) -> &[u8] {
        self.body
    }

    /// Decodes the body; `None` if it is not exactly one `T`.
    pub fn decode<T: DeserializeOwned>(&self) -> Option<T> {
        match postcard::take_from_bytes(self.body) {
            Ok((value, [])) => Some(value),
            _ => None,
        }
    }
}

/// The body is longer than [`MAX_BODY`]. Cannot happen for the messages of this crate (test `every_message_fits`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLong;

/// Encodes one frame.
///
/// # Errors
/// [`TooLong`] if the body exceeds [`MAX_BODY`].
pub fn encode<T: Serialize>(header: Header, body: &T) -> Result<Encoded, TooLong> {
    let [low, high] = header.seq.to_le_bytes();
    let mut raw = [0; MAX_RAW];
    raw[..HEAD].copy_from_slice(&[header.kind as u8, header.session, low, high]);
    let body = postcard::to_slice(body, &mut raw[HEAD..HEAD + MAX_BODY]).map_err(|_| TooLong)?;
    let end = HEAD + body.len();
    let crc = CRC32C.checksum(&raw[..end]);
    raw[end..end + CRC].copy_from_slice(&crc.to_le_bytes());
    // The zeros around the block are its delimiters.
    let mut frame = Encoded::from_array([0; MAX_FRAME]);
    let coded = cobs::try_encode(&raw[..end + CRC], &mut frame[1..=MAX_COBS]);
    frame.truncate(coded.map_err(|_| TooLong)? + 2);
    Ok(frame)
}

/// Finds frames in a stream of bytes. Finds the first undamaged frame whatever came before it.
#[derive(Debug)]
pub struct Deframer {
    block: heapless::Vec<u8, MAX_COBS>,
    /// The present block is longer than any frame and is skipped to its end.
    overrun: bool,
    decoded: [u8; MAX_COBS],
    rejected: u32,
}

impl Default for Deframer {
    fn default() -> Self {
        Self::new()
    }
}

impl Deframer {
    pub const fn new() -> Self {
        Self {
            block: heapless::Vec::new(),
            overrun: false,
            decoded: [0; MAX_COBS],
            rejected: 0,
        }
    }

    /// Number of dropped blocks: too long, badly encoded, of unknown kind, or with a wrong CRC.
    pub fn rejected(&self) -> u32 {
        self.rejected
    }

    /// Takes one byte; returns a frame when this byte completes one.
    pub fn push(&mut self, byte: u8) -> Option<Frame<'_>> {
        if byte != 0 {
            self.overrun |= self.block.push(byte).is_err();
            return None;
        }
        let is_whole = !core::mem::take(&mut self.overrun);
        if self.block.is_empty() {
            return None;
        }
        let length = match cobs::decode(&self.block, &mut self.decoded) {
            Ok(report) if is_whole => report.frame_size(),
            _ => 0,
        };
        self.block.clear();
        let Some(header) = check(&self.decoded[..length]) else {
            self.rejected = self.rejected.saturating_add(1);
            return None;
        };
        Some(Frame {
            header,
            body: &self.decoded[HEAD..length - CRC],
        })
    }
}

fn check(raw: &[u8]) -> Option<Header> {
    let (content, crc) = raw.split_last_chunk::<CRC>()?;
    let [kind, session, low, high] = *content.first_chunk::<HEAD>()?;
    (CRC32C.checksum(content) == u32::from_le_bytes(*crc)).then_some(())?;
    Some(Header {
        kind: Kind::from_u8(kind)?,
        session,
        seq: u16::from_le_bytes([low, high]),
    })
}
