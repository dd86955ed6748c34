//! Serves a machine on TCP in real time, like a serial port.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::Duration;

use host_tool::link::Link;

use crate::bench::BenchError;
use crate::hands::Plug;
use crate::pace::Pace;

/// Interval between two looks at the socket while the machine is early.
const REST: Duration = Duration::from_micros(500);

/// A machine behind a port of the loopback interface.
pub struct Server {
    listener: TcpListener,
}

impl Server {
    /// Listens on `port`, or on a free one if it is 0.
    ///
    /// # Errors
    /// [`BenchError::Listen`] when the port is taken.
    pub fn listen(port: u16) -> Result<Self, BenchError> {
        let refused = |why| BenchError::Listen {
            address: format!("127.0.0.1:{port}"),
            why,
        };
        let listener = TcpListener::bind(("127.0.0.1", port)).map_err(refused)?;
        listener.set_nonblocking(true).map_err(refused)?;
        Ok(Self { listener })
    }

    /// The port it listens on.
    #[must_use]
    pub fn port(&self) -> u16 {
        self.listener
            .local_addr()
            .map_or(0, |address| address.port())
    }

    /// Runs the machine behind `link` forever, for one client at a time: the latest to connect. Connecting and
    /// disconnecting have no effect on the machine. While `plug` is out there is no client, and what the machine sends is
    /// lost.
    ///
    /// # Errors
    /// [`BenchError::Ended`] when the machine is gone.
    pub fn serve(&self, link: &mut dyn Link, plug: &Plug) -> Result<(), BenchError> {
        let mut pace = Pace::new(link.now_us());
        let mut client: Option<TcpStream> = None;
        let mut buffer = [0; 4096];
        loop {
            if let Ok((stream, _)) = self.listener.accept()
                && stream.set_nonblocking(true).is_ok()
            {
                let _ = stream.set_nodelay(true);
                client = Some(stream);
            }
            if !plug.is_in() {
                client = None;
            }
            let heard = client
                .as_mut()
                .map_or(Ok(0), |client| read(client, &mut buffer));
            match heard {
                Ok(count) if count > 0 => {
                    link.send(&buffer[..count]).map_err(ended)?;
                }
                Ok(_) => {}
                Err(_) => client = None,
            }
            let Some(until_us) = pace.until_us(link.now_us()) else {
                std::thread::sleep(REST);
                continue;
            };
            let count = link.receive(&mut buffer, until_us).map_err(ended)?;
            let written = client
                .as_mut()
                .map_or(Ok(()), |client| write(client, &buffer[..count]));
            if written.is_err() {
                client = None;
            }
        }
    }
}

fn ended(why: impl std::fmt::Display) -> BenchError {
    BenchError::Ended(why.to_string())
}

fn read(client: &mut TcpStream, buffer: &mut [u8]) -> std::io::Result<usize> {
    match client.read(buffer) {
        Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
        Err(why) if matches!(why.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => Ok(0),
        other => other,
    }
}

/// Does not block: a client that does not read loses its connection, so the machine is not delayed.
fn write(client: &mut TcpStream, bytes: &[u8]) -> std::io::Result<()> {
    client.write_all(bytes)
}
