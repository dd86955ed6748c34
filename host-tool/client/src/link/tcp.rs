//! A line to a machine behind a TCP server that passes the bytes of its serial port in real time.

use std::io;
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use crate::link::halves::{Halves, READ, WRITE};
use crate::link::{OpenError, Reason};

/// Connects to `HOST:PORT`, with a time limit for each address of the host.
///
/// # Errors
/// [`OpenError`] if the name is unknown or no server listens there.
pub fn open(host_port: &str, limit: Duration) -> Result<Halves, OpenError> {
    let connected = host_port.to_socket_addrs().and_then(|mut addresses| {
        let none = "the host name has no address";
        let mut found = Err(io::Error::other(none));
        while found.is_err()
            && let Some(address) = addresses.next()
        {
            found = TcpStream::connect_timeout(&address, limit);
        }
        halves(found?)
    });
    connected.map_err(|io| OpenError {
        place: format!("tcp:{host_port}"),
        reason: Reason::Unreachable,
        why: io.to_string(),
        remedy: "start the server first (`virtual-bench serve`), and check host and port".into(),
    })
}

fn halves(stream: TcpStream) -> io::Result<Halves> {
    // Send small frames at once: a stop must not wait for more data.
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(READ))?;
    stream.set_write_timeout(Some(WRITE))?;
    Ok(Halves {
        reader: Box::new(stream.try_clone()?),
        writer: Box::new(stream),
        end: "the other end closed the connection",
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::TcpListener;

    #[test]
    fn an_address_without_a_listener_is_unreachable() {
        let free = TcpListener::bind("127.0.0.1:0").expect("a port");
        let at = free.local_addr().expect("an address").to_string();
        assert!(open(&at, WRITE).is_ok());
        drop(free);
        let error = open(&at, WRITE).err().expect("nobody listens");
        assert_eq!(error.reason, Reason::Unreachable);
        assert_eq!(error.place, format!("tcp:{at}"));
    }
}
