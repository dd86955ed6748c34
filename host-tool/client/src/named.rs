//! Files that the user names, including links, pipes and devices. Opening never waits.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::{OFlags, fcntl_getfl, fcntl_setfl};
use rustix::io::Errno;

use crate::plain;

/// The remedy for an error of the file system.
#[must_use]
pub fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "free space on that disk",
        ErrorKind::FileTooLarge if error.raw_os_error().is_some() => {
            "raise the limit of file sizes (`ulimit -f`), or take a disk that holds larger files"
        }
        ErrorKind::PermissionDenied => "give yourself the permission to write there",
        ErrorKind::ReadOnlyFilesystem => "make that disk writable",
        ErrorKind::NotFound => "make its folder",
        ErrorKind::IsADirectory => "name a file in it",
        ErrorKind::InvalidFilename => "shorten its name",
        ErrorKind::AlreadyExists
        | ErrorKind::NotADirectory
        | ErrorKind::InvalidInput
        | ErrorKind::FileTooLarge => "take another path: something else is there",
        ErrorKind::NotConnected => "start what is at its other end first",
        _ => "check that disk, and its cable or server",
    }
}

/// The error for a pipe without another end.
pub(crate) fn unattended() -> io::Error {
    io::Error::new(
        ErrorKind::NotConnected,
        "no process is at the other end of this pipe",
    )
}

/// Opens a file without waiting for the other end of a pipe or for the carrier of a line.
pub(crate) fn open(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
    options.custom_flags(i32::try_from(flags.bits()).unwrap_or_default());
    let file = options.open(path).map_err(|io| {
        match io.raw_os_error() == Some(Errno::NXIO.raw_os_error()) {
            true => unattended(),
            false => io,
        }
    })?;
    fcntl_setfl(&file, fcntl_getfl(&file)? - OFlags::NONBLOCK)?;
    Ok(file)
}

/// Opens a file for reading. A pipe without a writer reads as empty.
pub(crate) fn open_to_read(path: &Path) -> io::Result<File> {
    open(path, OpenOptions::new().read(true))
}

/// Whether the path leads to a terminal, a pipe or a device, such as /dev/stdout, where no file is replaced.
#[must_use]
pub fn is_device(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir())
}

/// Writes a file: a plain one completely or not at all, and an existing one only with `force`. A device or a pipe is
/// written to directly.
///
/// # Errors
/// Those of the file, with [`ErrorKind::AlreadyExists`] without `force`; nothing has changed then.
pub fn write(
    path: &Path,
    force: bool,
    fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> io::Result<()> {
    let filled = |file: &File| {
        let mut out = BufWriter::new(file);
        fill(&mut out)?;
        out.flush()
    };
    // Follow a link only if the user allows its target to be replaced.
    let is_link = fs::symlink_metadata(path).is_ok() && !plain::is_file(path);
    if is_device(path) || (force && is_link) {
        let file = open(path, OpenOptions::new().write(true).truncate(true))?;
        return match filled(&file) {
            Err(io) if io.kind() == ErrorKind::BrokenPipe => Ok(()),
            written => written,
        };
    }
    plain::put(path, force, filled)
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::sync::mpsc::channel;
    use std::thread;
    use std::time::Duration;

    use super::*;
    use crate::limited;

    /// Regression: commands waited for ever at a pipe, and one whose reader had read enough was a failure.
    #[test]
    fn a_pipe_is_waited_for_by_nobody_and_its_reader_may_leave() {
        let place = tempfile::tempdir().expect("a folder");
        let pipe = place.path().join("pipe");
        let mode = rustix::fs::Mode::from_raw_mode(0o600);
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, mode).expect("a FIFO");
        let (tell, told) = channel();
        let path = pipe.clone();
        thread::spawn(move || {
            let long = |out: &mut dyn Write| out.write_all(&[b'x'; 1 << 20]);
            for result in [
                limited::read(&path, 9).map(drop),
                write(&path, false, long),
                write(&path, true, long),
            ] {
                let kind = result.expect_err("nobody").kind();
                tell.send(kind == ErrorKind::NotConnected).expect("heard");
            }
            let reader = open_to_read(&path).expect("there");
            let written = thread::spawn(move || write(&path, false, long));
            let mut some = [0; 10];
            while let Ok(0) = (&reader).read(&mut some) {}
            drop(reader);
            let written = written.join().expect("no panic");
            tell.send(written.is_ok()).expect("heard");
        });
        for _ in 0..4 {
            let is_right = told.recv_timeout(Duration::from_secs(10));
            assert_eq!(is_right, Ok(true), "waits, or is wrong");
        }
        // Who writes may be slow.
        let slow = thread::spawn({
            let pipe = pipe.clone();
            move || {
                let mut to = OpenOptions::new().write(true).open(pipe).expect("a pipe");
                thread::sleep(Duration::from_millis(50));
                to.write_all(b"late").expect("read");
            }
        });
        let mut reads = limited::read(&pipe, 9);
        while reads.is_err() {
            reads = limited::read(&pipe, 9);
        }
        assert_eq!(reads.expect("read"), b"late");
        slow.join().expect("no panic");
    }
}
