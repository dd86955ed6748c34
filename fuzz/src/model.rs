//! A second implementation of the line, written from docs/protocol.md: finds frames, and decides which may be
//! executed.

use protocol::frame::{MAX_BODY, MAX_FRAME};

const CRC32C: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);
const HEAD: usize = 4;
const CRC: usize = 4;

/// A good frame, decoded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Good {
    /// Kind, 1 to 5.
    pub kind: u8,
    /// Session number.
    pub session: u8,
    /// Sequence number.
    pub seq: u16,
    /// Its body, decoded from COBS and without the CRC.
    pub body: Vec<u8>,
}

/// A frame with these header fields and this body.
#[must_use]
pub fn frame(kind: u8, session: u8, seq: u16, body: &[u8]) -> Vec<u8> {
    let [low, high] = seq.to_le_bytes();
    let mut raw = [&[kind, session, low, high], body].concat();
    raw.extend(CRC32C.checksum(&raw).to_le_bytes());
    let mut block = vec![0; cobs::max_encoding_length(raw.len()) + 2];
    let length = cobs::encode(&raw, &mut block[1..]);
    block.truncate(length + 2);
    block[length + 1] = 0;
    block
}

/// All good frames in these bytes, and the number of other blocks.
#[must_use]
pub fn read(bytes: &[u8]) -> (Vec<Good>, u32) {
    let (mut good, mut bad) = (vec![], 0);
    let mut blocks: Vec<_> = bytes.split(|byte| *byte == 0).collect();
    // The last block is incomplete: its delimiter is missing.
    blocks.pop();
    for block in blocks.into_iter().filter(|block| !block.is_empty()) {
        match block_frame(block) {
            Some(frame) => good.push(frame),
            None => bad += 1,
        }
    }
    (good, bad)
}

fn block_frame(block: &[u8]) -> Option<Good> {
    if block.len() > MAX_FRAME - 2 {
        return None;
    }
    let raw = uncobs(block)?;
    let (content, crc) = raw.split_last_chunk::<CRC>()?;
    let (&[kind, session, low, high], body) = content.split_first_chunk::<HEAD>()?;
    let is_good = CRC32C.checksum(content) == u32::from_le_bytes(*crc)
        && (1..=5).contains(&kind)
        && body.len() <= MAX_BODY;
    is_good.then(|| Good {
        kind,
        session,
        seq: u16::from_le_bytes([low, high]),
        body: body.to_vec(),
    })
}

/// Each code is the distance to the next code, which stands for a zero byte or for the end.
fn uncobs(mut block: &[u8]) -> Option<Vec<u8>> {
    let mut raw = vec![];
    while let Some((&code, rest)) = block.split_first() {
        let count = usize::from(code).checked_sub(1)?;
        raw.extend(rest.get(..count)?);
        block = &rest[count..];
        if code != 0xFF && !block.is_empty() {
            raw.push(0);
        }
    }
    Some(raw)
}

/// Checks a device's executions: only in the present session, and each sequence number at most once.
#[derive(Debug, Default)]
pub struct AnsweredOnce {
    session: Option<u8>,
    newest: Option<u16>,
}

impl AnsweredOnce {
    /// The device has answered a Hello with this session.
    pub fn greeted(&mut self, session: u8) {
        assert_ne!(session, 0, "0 is no session");
        if self.session != Some(session) {
            *self = Self {
                session: Some(session),
                newest: None,
            };
        }
    }

    /// The present session; 0 before the first.
    #[must_use]
    pub fn session(&self) -> u8 {
        self.session.unwrap_or(0)
    }

    /// Checks the newest executed number.
    pub fn newest_is(&self, seq: Option<u16>) {
        assert_eq!(self.newest, seq, "executed last");
    }

    /// Records that the device executes the request of this frame.
    ///
    /// # Panics
    /// The execution is not allowed.
    pub fn executed(&mut self, session: u8, seq: u16) {
        assert_eq!(Some(session), self.session, "executed outside its session");
        assert!(
            self.is_new(seq),
            "{seq} is executed after {:?}",
            self.newest
        );
        self.newest = Some(seq);
    }

    /// Records a refusal because the host has another protocol; it uses up the number too.
    pub fn refused(&mut self, seq: u16) {
        if self.is_new(seq) {
            self.newest = Some(seq);
        }
    }

    /// Whether a number is newer than all before: half of all numbers come after a given one.
    fn is_new(&self, seq: u16) -> bool {
        let newest = self.newest;
        newest.is_none_or(|newest| (1..0x8000).contains(&seq.wrapping_sub(newest)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_read_as_it_was_made() {
        for length in [0, 1, 160] {
            for byte in [0, 1, 0xFF] {
                let sent = frame(2, 3, 0x1234, &vec![byte; length]);
                let (good, bad) = read(&sent);
                assert_eq!((good.len(), bad), (1, 0));
                assert_eq!((good[0].kind, good[0].session, good[0].seq), (2, 3, 0x1234));
                assert_eq!(good[0].body, vec![byte; length]);
            }
        }
        assert_eq!(read(&frame(2, 3, 4, &[7; 161])), (vec![], 1));
        assert_eq!(read(&frame(6, 3, 4, &[])), (vec![], 1));
        assert_eq!(read(&[0, 1, 2, 3, 0, 4]), (vec![], 1));
    }

    #[test]
    fn what_must_not_be_executed_is_noticed() {
        let bad = |act: fn(&mut AnsweredOnce)| {
            let mut once = AnsweredOnce::default();
            once.greeted(5);
            once.executed(5, 0xFFFF);
            once.executed(5, 3);
            std::panic::catch_unwind(move || act(&mut { once })).is_err()
        };
        assert!(bad(|once| once.executed(5, 3)));
        assert!(bad(|once| once.executed(5, 2)));
        assert!(bad(|once| once.executed(4, 4)));
        assert!(bad(|once| once.greeted(0)));
        assert!(!bad(|once| once.executed(5, 4)));
        assert!(bad(|once| {
            once.refused(9);
            once.executed(5, 9);
        }));
        assert!(!bad(|once| {
            once.greeted(6);
            once.executed(6, 3);
        }));
    }
}
