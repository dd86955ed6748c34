//! Connections of a broker: Unix sockets, guarded by the permissions of their folder.

use std::io::{self, Read};
use std::os::unix::net::UnixStream;
use std::path::Path;

/// Connects to the socket without waiting. The queue of a suspended owner fills with clients that it does not accept,
/// and the system would wait for ever behind a full queue.
///
/// # Errors
/// [`io::ErrorKind::WouldBlock`] if the queue is full; the system's if no owner listens.
pub fn connect(socket: &Path) -> io::Result<UnixStream> {
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
    use std::os::unix::net::UnixListener;
    use std::time::Duration;

    /// Regression: beside an owner that was frozen for hours a stop waited here for ever, instead of going past it.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_queue_of_clients_is_an_error_at_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let socket = folder.path().join("socket");
        let frozen = UnixListener::bind(&socket).expect("bound");
        rustix::net::listen(&frozen, 1).expect("a short queue");
        let (tell, told) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let clients = (0..9).map(|_| connect(&socket));
            let full = clients.filter_map(Result::err).next();
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
