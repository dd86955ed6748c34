//! Listeners and connections of a door: a Unix socket, or a loopback port on other systems.

use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::path::Path;
use std::time::Duration;

#[cfg(unix)]
use std::os::unix::net::{UnixListener, UnixStream};

/// A listening door.
pub enum Listener {
    /// Guarded by the permissions of its folder.
    #[cfg(unix)]
    Unix(UnixListener),
    /// Guarded by a token.
    Loopback(TcpListener),
}

/// A guest's connection, used on both sides.
#[derive(Debug)]
pub enum Stream {
    #[cfg(unix)]
    Unix(UnixStream),
    Loopback(TcpStream),
}

impl Listener {
    /// Listens at the socket.
    #[cfg(unix)]
    pub fn unix(socket: &Path) -> io::Result<Self> {
        UnixListener::bind(socket).map(Self::Unix)
    }

    /// Listens at a free port of the loopback interface.
    #[cfg_attr(unix, allow(dead_code))]
    pub fn loopback() -> io::Result<Self> {
        TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).map(Self::Loopback)
    }

    /// The port, for a loopback door.
    pub fn port(&self) -> Option<u16> {
        match self {
            #[cfg(unix)]
            Self::Unix(_) => None,
            Self::Loopback(listener) => listener.local_addr().ok().map(|at| at.port()),
        }
    }

    pub fn accept(&self) -> io::Result<Stream> {
        match self {
            #[cfg(unix)]
            Self::Unix(listener) => listener.accept().map(|(stream, _)| Stream::Unix(stream)),
            Self::Loopback(listener) => {
                let (stream, _) = listener.accept()?;
                stream.set_nodelay(true)?;
                Ok(Stream::Loopback(stream))
            }
        }
    }
}

/// Longest wait for a port of this computer. Without a free place in its queue nothing answers.
const LOOPBACK: Duration = Duration::from_secs(1);

#[cfg(unix)]
fn at_once(socket: &Path) -> io::Result<UnixStream> {
    use rustix::fs::{OFlags, fcntl_setfl};
    use rustix::io::{FdFlags, fcntl_setfd};
    use rustix::net::{AddressFamily, SocketAddrUnix, SocketType, connect, socket as open};
    let near = open(AddressFamily::UNIX, SocketType::STREAM, None)?;
    fcntl_setfd(&near, FdFlags::CLOEXEC)?;
    fcntl_setfl(&near, OFlags::NONBLOCK)?;
    connect(&near, &SocketAddrUnix::new(socket)?)?;
    let stream = UnixStream::from(near);
    stream.set_nonblocking(false)?;
    Ok(stream)
}

impl Stream {
    /// Connects to the socket, or to the port if there is one. Never waits: guests that nobody has taken in fill the queue
    /// of an owner that is frozen, and behind a full one the system would wait for ever.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if the queue is full; the system's if no owner listens.
    pub fn connect(socket: &Path, port: Option<u16>) -> io::Result<Self> {
        let Some(port) = port else {
            #[cfg(unix)]
            return at_once(socket).map(Self::Unix);
            #[cfg(not(unix))]
            return Err(io::Error::new(
                io::ErrorKind::NotFound,
                format!("no port for {}", socket.display()),
            ));
        };
        let stream = TcpStream::connect_timeout(&(Ipv4Addr::LOCALHOST, port).into(), LOOPBACK)?;
        stream.set_nodelay(true)?;
        Ok(Self::Loopback(stream))
    }

    pub fn try_clone(&self) -> io::Result<Self> {
        Ok(match self {
            #[cfg(unix)]
            Self::Unix(stream) => Self::Unix(stream.try_clone()?),
            Self::Loopback(stream) => Self::Loopback(stream.try_clone()?),
        })
    }

    pub fn set_read_timeout(&self, limit: Option<Duration>) -> io::Result<()> {
        match self {
            #[cfg(unix)]
            Self::Unix(stream) => stream.set_read_timeout(limit),
            Self::Loopback(stream) => stream.set_read_timeout(limit),
        }
    }

    pub fn set_write_timeout(&self, limit: Option<Duration>) -> io::Result<()> {
        match self {
            #[cfg(unix)]
            Self::Unix(stream) => stream.set_write_timeout(limit),
            Self::Loopback(stream) => stream.set_write_timeout(limit),
        }
    }

    pub fn shut(&self) {
        // It is no error if the connection is already gone.
        let _ = match self {
            #[cfg(unix)]
            Self::Unix(stream) => stream.shutdown(Shutdown::Both),
            Self::Loopback(stream) => stream.shutdown(Shutdown::Both),
        };
    }
}

impl Read for Stream {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        match self {
            #[cfg(unix)]
            Self::Unix(stream) => stream.read(into),
            Self::Loopback(stream) => stream.read(into),
        }
    }
}

impl Write for Stream {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            #[cfg(unix)]
            Self::Unix(stream) => stream.write(bytes),
            Self::Loopback(stream) => stream.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Reads a line of at most `limit` bytes, and no byte beyond its end.
pub fn read_line(from: &mut impl Read, limit: usize) -> io::Result<Vec<u8>> {
    let mut line = vec![];
    let mut byte = [0];
    loop {
        match from.read(&mut byte) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(_) if byte == *b"\n" => return Ok(line),
            Ok(_) if line.len() == limit => return Err(io::ErrorKind::InvalidData.into()),
            Ok(_) => line.push(byte[0]),
            Err(why) if why.kind() == io::ErrorKind::Interrupted => {}
            Err(why) => return Err(why),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: beside an owner that was frozen for hours a stop waited here for ever, instead of going past it.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_queue_of_guests_is_an_error_at_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("door");
        let frozen = UnixListener::bind(&socket).expect("bound");
        rustix::net::listen(&frozen, 1).expect("a short queue");
        let (tell, told) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let guests = (0..9).map(|_| Stream::connect(&socket, None));
            let full = guests.filter_map(Result::err).next();
            let _ = tell.send(full.map(|why| why.kind()));
        });
        let full = told.recv_timeout(Duration::from_secs(10));
        assert_eq!(full, Ok(Some(io::ErrorKind::WouldBlock)));
        drop(frozen);
    }

    #[test]
    fn a_line_is_read_to_its_end_and_no_further() {
        let mut from = &b"one\ntwo"[..];
        assert_eq!(read_line(&mut from, 3).expect("short enough"), b"one");
        assert_eq!(from, b"two");
        assert!(read_line(&mut &b"four\n"[..], 3).is_err());
        assert!(read_line(&mut &b"cut"[..], 9).is_err());
    }
}
