//! Writes a record's files on a thread of its own: a disk that hesitates delays neither the link nor a stop.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, OnceLock};
use std::thread::{self, JoinHandle};

/// What is to be written, in this order.
enum Job {
    Append(Vec<u8>),
    Replace(PathBuf, Vec<u8>),
}

/// What could not be written.
#[derive(Clone, Debug)]
pub(crate) struct WriteError {
    /// The file.
    pub(crate) path: PathBuf,
    /// Why.
    pub(crate) why: String,
}

/// A file that grows, and others that are replaced meanwhile.
///
/// What is still to be written waits in memory, so nobody waits for the disk before [`Writer::finish`].
#[derive(Debug)]
pub(crate) struct Writer {
    jobs: Sender<Job>,
    thread: JoinHandle<()>,
    /// The first failure.
    failed: Arc<OnceLock<WriteError>>,
}

impl Writer {
    /// Appends to `file`, which is at `path`.
    pub(crate) fn new(path: PathBuf, file: File) -> Self {
        let (jobs, given) = mpsc::channel();
        let failed = Arc::new(OnceLock::new());
        let first = Arc::clone(&failed);
        Self {
            jobs,
            thread: thread::spawn(move || write(&path, file, given, &first)),
            failed,
        }
    }

    /// What could not be written so far, as soon as the system has said so. It does not wait.
    pub(crate) fn failure(&self) -> Option<&WriteError> {
        self.failed.get()
    }

    /// Appends to the file what is written into it, and never fails.
    pub(crate) fn appender(&self) -> Appender {
        Appender(self.jobs.clone())
    }

    /// Replaces another file as [`replace`] does.
    pub(crate) fn replace(&self, path: PathBuf, bytes: Vec<u8>) {
        let _ = self.jobs.send(Job::Replace(path, bytes));
    }

    /// Waits until everything is written; all appenders have to be gone.
    ///
    /// # Errors
    /// The first thing that could not be written, all later ones of that file neither.
    pub(crate) fn finish(self) -> Result<(), WriteError> {
        drop(self.jobs);
        self.thread.join().expect("it does not panic");
        match self.failed.get() {
            Some(failed) => Err(failed.clone()),
            None => Ok(()),
        }
    }
}

/// The end that grows.
#[derive(Debug)]
pub(crate) struct Appender(Sender<Job>);

impl Write for Appender {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // The thread runs until the last appender is gone; errors are told by `finish`.
        let _ = self.0.send(Job::Append(bytes.to_vec()));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn write(path: &Path, mut file: File, jobs: Receiver<Job>, failed: &OnceLock<WriteError>) {
    let mut appends = true;
    for job in jobs {
        let written = match job {
            // After a gap nothing more, or rows would be missing in the middle.
            Job::Append(_) if !appends => continue,
            Job::Append(bytes) => {
                let written = file.write_all(&bytes);
                appends = written.is_ok();
                written.map_err(|io| (path.to_owned(), io))
            }
            // Tried all the same: it says how the trial ended.
            Job::Replace(path, bytes) => replace(&path, &bytes).map_err(|io| (path, io)),
        };
        if let Err((path, io)) = written {
            let why = io.to_string();
            // Only the first one is kept: it is the cause.
            let _ = failed.set(WriteError { path, why });
        }
    }
}

/// Replaces a file by renaming: a reader finds the old one or the new one, never a part of it.
///
/// # Errors
/// It cannot be written; the old one is still there.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    fs::rename(written(path, bytes)?, path)
}

/// As [`replace`], for a file that must not be there yet.
///
/// # Errors
/// As [`replace`]; [`io::ErrorKind::AlreadyExists`] leaves what is there as it is.
pub fn create(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // Whoever has the name first keeps it. Empty until the rename, which no reader takes for a whole file.
    drop(File::create_new(path)?);
    replace(path, bytes).inspect_err(|_| drop(fs::remove_file(path)))
}

/// The bytes in a file beside `path`.
fn written(path: &Path, bytes: &[u8]) -> io::Result<PathBuf> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    let mut file = File::create(&part)?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        // A part that nobody will ever complete is not left behind.
        .inspect_err(|_| drop(fs::remove_file(&part)))?;
    Ok(part)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::{Duration, Instant};

    #[test]
    fn everything_is_there_at_the_end_and_in_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, other) = (folder.path().join("a.csv"), folder.path().join("a.json"));
        let writer = Writer::new(path.clone(), File::create(&path).expect("new"));
        let mut appender = writer.appender();
        for number in 0..1_000 {
            writeln!(appender, "{number}").expect("never fails");
        }
        writer.replace(other.clone(), b"first".to_vec());
        writer.replace(other.clone(), b"last".to_vec());
        drop(appender);
        writer.finish().expect("written");
        let rows: String = (0..1_000).map(|number| format!("{number}\n")).collect();
        assert_eq!(fs::read_to_string(&path).expect("there"), rows);
        assert_eq!(fs::read(&other).expect("there"), b"last");
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), 2);
    }

    /// A reader that does not read is a disk that does not write.
    #[cfg(unix)]
    #[test]
    fn a_disk_that_stands_delays_nobody() {
        let (reader, pipe) = io::pipe().expect("a pipe");
        let file = File::from(std::os::fd::OwnedFd::from(pipe));
        let writer = Writer::new(PathBuf::from("pipe"), file);
        // Far more than a pipe holds: this would not return if it waited for the reader.
        let mut appender = writer.appender();
        for _ in 0..100 {
            appender.write_all(&[b'x'; 65_536]).expect("never fails");
        }
        drop(appender);
        let read = thread::spawn(move || io::copy(&mut &reader, &mut io::sink()));
        writer.finish().expect("written");
        let count = read.join().expect("it ends").expect("read");
        assert_eq!(count, 100 * 65_536);
    }

    #[test]
    fn a_new_file_never_replaces_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.html");
        create(&path, b"one").expect("new");
        let error = create(&path, b"two").expect_err("there");
        assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(fs::read(&path).expect("there"), b"one");
        replace(&path, b"three").expect("replaced");
        assert_eq!(fs::read(&path).expect("there"), b"three");
        assert_eq!(fs::read_dir(folder.path()).expect("there").count(), 1);
        let nowhere = folder.path().join("no/a.html");
        assert!(create(&nowhere, b"").is_err());
    }

    #[test]
    fn the_first_error_is_told_and_the_sidecar_is_written_all_the_same() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.csv");
        fs::write(&path, b"").expect("new");
        // Opened for reading only: nothing can be appended.
        let writer = Writer::new(path.clone(), File::open(&path).expect("there"));
        let sidecar = folder.path().join("a.json");
        assert!(writer.failure().is_none());
        writer.appender().write_all(b"row\n").expect("never fails");
        // Told while more may come, not only at the end.
        let begun = Instant::now();
        while writer.failure().is_none() && begun.elapsed() < Duration::from_secs(20) {
            thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(writer.failure().expect("told").path, path);
        writer.replace(sidecar.clone(), b"the end".to_vec());
        assert_eq!(writer.finish().expect_err("read only").path, path);
        assert_eq!(fs::read(&sidecar).expect("there"), b"the end");
    }
}
