//! Identifies the other end from its bytes when no machine answers Hello.

use std::fmt;

use protocol::frame::{Deframer, Kind};

/// Bytes kept for a diagnosis.
pub(crate) const OVERHEARD: usize = 1_024;

/// Longest excerpt of a text in a message, characters.
const EXCERPT: usize = 40;

/// Presumed kind of the other end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sign {
    Silence,
    /// The sent bytes come back.
    Echo,
    /// A machine that sends but does not receive.
    Deaf,
    Web,
    Ssh,
    /// Another instrument that sends text; the beginning of the text.
    Text(String),
    /// Bytes that are neither text nor frames; their number.
    Noise(usize),
}

/// Identifies the sender of these bytes.
pub fn sign(bytes: &[u8]) -> Sign {
    if bytes.is_empty() {
        return Sign::Silence;
    }
    let mut deframer = Deframer::new();
    for byte in bytes {
        match deframer.push(*byte).map(|frame| frame.header.kind) {
            // Only hosts send these, so they are an echo of our own.
            Some(Kind::Request | Kind::Urgent) => return Sign::Echo,
            Some(Kind::Reply | Kind::Telemetry | Kind::Event) => return Sign::Deaf,
            None => {}
        }
    }
    let has = |text: &[u8]| bytes.windows(text.len()).any(|window| window == text);
    if has(b"HTTP/") {
        return Sign::Web;
    }
    if has(b"SSH-") {
        return Sign::Ssh;
    }
    let printable = |byte: &&u8| matches!(byte, b' '..=b'~' | b'\r' | b'\n' | b'\t');
    let readable = bytes.iter().filter(printable).count();
    // Require 90 %: two in five random bytes are printable.
    if bytes.len() >= 4 && readable * 10 >= bytes.len() * 9 {
        let text = String::from_utf8_lossy(bytes);
        let words: Vec<_> = text.split_whitespace().collect();
        let line = words.join(" ");
        let shown = line.chars().filter(|c| !c.is_control());
        return Sign::Text(shown.take(EXCERPT).collect());
    }
    Sign::Noise(bytes.len())
}

impl fmt::Display for Sign {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Silence => f.write_str("nothing comes from there"),
            Self::Echo => f.write_str("what is sent there comes back"),
            Self::Deaf => f.write_str("a machine sends from there, and does not hear"),
            Self::Web => f.write_str("a web server is there"),
            Self::Ssh => f.write_str("an SSH server is there"),
            Self::Text(text) => write!(f, "some other instrument is there; it sends \"{text}\""),
            Self::Noise(count) => write!(
                f,
                "{count} bytes came from there, and none of them make a frame"
            ),
        }
    }
}

impl Sign {
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::Silence => {
                "is the board powered, is this its port (`retrograde doctor`), does `--baud` match the firmware (115200), and is Retrograde's firmware on it (`cargo rig`, `cargo capsule`)?"
            }
            Self::Echo => {
                "receive and transmit are joined: a loop-back plug, a terminal that echoes, or a board whose serial wires are bridged"
            }
            Self::Deaf => {
                "check the wire from the computer to the board (its RX, PA3), and that no other program has the port"
            }
            Self::Web | Self::Ssh => {
                "the port is another program's: give the one that `virtual-bench serve`, or your serial server, says"
            }
            Self::Text(_) => "`retrograde doctor` lists the ports; choose the board's",
            Self::Noise(_) => {
                "does `--baud` match the firmware (115200)? If so, it is another instrument: `retrograde doctor` lists the ports"
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use protocol::frame::{Header, encode};
    use protocol::rig::GetRigStatus;
    use protocol::system::Urgent;
    use protocol::table::{Endpoint, Reply};

    use super::*;

    #[test]
    fn each_kind_of_other_end_is_told_from_its_bytes() {
        let header = |kind| Header {
            kind,
            session: 1,
            seq: 1,
        };
        let request = encode(header(Kind::Request), &GetRigStatus.into_request()).expect("fits");
        let reply = encode(header(Kind::Reply), &Reply::Urgent(Urgent::Stop)).expect("fits");
        let cut = [&[7, 9][..], &request, &[1]].concat();
        for (bytes, expected) in [
            (&b""[..], Sign::Silence),
            (&request, Sign::Echo),
            (&cut, Sign::Echo),
            (&reply, Sign::Deaf),
            (b"HTTP/1.1 400 Bad Request\r\n\r\n<html>", Sign::Web),
            (b"SSH-2.0-OpenSSH_9.2\r\n", Sign::Ssh),
            (
                b"KEITHLEY,\x07 2400\r\n 1.0\r\n",
                Sign::Text("KEITHLEY, 2400 1.0".to_owned()),
            ),
            (&[0xF3; 30], Sign::Noise(30)),
            (b"abc", Sign::Noise(3)),
            (b"123456789\x01", Sign::Text("123456789".to_owned())),
            (b"12345678\x01\x02", Sign::Noise(10)),
        ] {
            assert_eq!(sign(bytes), expected, "{bytes:?}");
        }
    }

    #[test]
    fn no_instrument_can_write_to_the_terminal_or_fill_it() {
        let long = [b"\x1b[2J".repeat(2), b"x".repeat(1_000)].concat();
        let text = sign(&long).to_string();
        assert!(text.len() < 120 && !text.contains('\x1b'), "{text:?}");
    }
}
