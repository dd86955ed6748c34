//! Addresses of machines as the user writes them: `auto`, a serial port, `tcp:HOST:PORT`, or `virtual`.

use std::convert::Infallible;
use std::fmt;
use std::str::FromStr;

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// The one board of the wanted kind among the ST-LINK ports.
    Auto,
    /// A serial port: `/dev/ttyACM0`, `COM3`.
    Serial(String),
    /// `HOST:PORT` of a TCP server that speaks the same bytes, also written `tcp:HOST:PORT`.
    Tcp(String),
    /// The virtual bench in this process.
    Virtual,
}

/// The reason why a text is not an address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AddressError {
    #[error("empty: use `auto`, a serial port such as /dev/ttyACM0, `tcp:HOST:PORT`, or `virtual`")]
    Empty,
    /// A port that no server can have.
    #[error("port {0} does not exist: ports are 1 to 65535")]
    Port(String),
    /// `tcp:` without a host or without a port.
    #[error("`{0}` has no host or no port: write `tcp:HOST:PORT`, for example tcp:127.0.0.1:7001")]
    Tcp(String),
}

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        match text {
            "" => Err(AddressError::Empty),
            "auto" => Ok(Self::Auto),
            "virtual" => Ok(Self::Virtual),
            _ => match text.strip_prefix("tcp:").or_else(|| server(text)) {
                Some(rest) => match rest.rsplit_once(':') {
                    Some((host, port))
                        if !host.is_empty() && port.parse::<u16>().is_ok_and(|port| port > 0) =>
                    {
                        Ok(Self::Tcp(rest.to_owned()))
                    }
                    Some((host, port))
                        if !host.is_empty()
                            && !port.is_empty()
                            && port.bytes().all(|byte| byte.is_ascii_digit()) =>
                    {
                        Err(AddressError::Port(port.to_owned()))
                    }
                    _ => Err(AddressError::Tcp(text.to_owned())),
                },
                None => Ok(Self::Serial(text.to_owned())),
            },
        }
    }
}

/// An address as the user gave it, or the reason why it cannot be read. The error is reported later, so that a mistyped
/// address of one machine does not prevent a stop of the other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Given {
    pub text: String,
    pub address: Result<Address, AddressError>,
}

impl FromStr for Given {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(Self {
            text: text.to_owned(),
            address: text.parse(),
        })
    }
}

/// `HOST:PORT` without its `tcp:`. Apart from paths, neither names of machines nor serial ports end in a colon and a
/// number.
fn server(text: &str) -> Option<&str> {
    let (host, port) = text.rsplit_once(':')?;
    let number = !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit());
    (number && !host.is_empty() && !host.contains(['/', '\\'])).then_some(text)
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Serial(port) => f.write_str(port),
            Self::Tcp(place) => write!(f, "tcp:{place}"),
            Self::Virtual => f.write_str("virtual"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_and_places_are_told_apart() {
        for (text, address) in [
            ("auto", Ok(Address::Auto)),
            ("virtual", Ok(Address::Virtual)),
            ("Auto", Ok(Address::Serial("Auto".to_owned()))),
            ("host:7001", Ok(Address::Tcp("host:7001".to_owned()))),
            // A path that ends like a server's port is still a path, on either system.
            ("/dev/a:1", Ok(Address::Serial("/dev/a:1".to_owned()))),
            ("a\\b:1", Ok(Address::Serial("a\\b:1".to_owned()))),
            (":7001", Ok(Address::Serial(":7001".to_owned()))),
            ("host:", Ok(Address::Serial("host:".to_owned()))),
            ("host:x", Ok(Address::Serial("host:x".to_owned()))),
            (
                "tcp:host:x",
                Err(AddressError::Tcp("tcp:host:x".to_owned())),
            ),
            ("tcp:host:", Err(AddressError::Tcp("tcp:host:".to_owned()))),
            (
                "tcp::99999",
                Err(AddressError::Tcp("tcp::99999".to_owned())),
            ),
            ("tcp:host:0", Err(AddressError::Port("0".to_owned()))),
            ("host:99999", Err(AddressError::Port("99999".to_owned()))),
            ("tcp:[::1]:7001", Ok(Address::Tcp("[::1]:7001".to_owned()))),
            ("tcp:", Err(AddressError::Tcp("tcp:".to_owned()))),
            ("", Err(AddressError::Empty)),
        ] {
            assert_eq!(text.parse::<Address>(), address, "{text}");
            if let Ok(address) = &address {
                assert_eq!(address.to_string().parse(), Ok(address.clone()), "{text}");
            }
        }
    }
}
