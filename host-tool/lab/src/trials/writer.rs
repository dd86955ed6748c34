//! Writes a record's files on its own thread, so that a slow disk delays neither the link nor a stop.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, OnceLock};
use std::thread::{self, JoinHandle};

use client::plain::replace;

use crate::trials::trial::RecordError;

/// A task of the writing thread; tasks run in order.
enum Job {
    Append(Vec<u8>),
    Replace(PathBuf, Vec<u8>),
}

/// Destination of the rows of a growing file.
pub(crate) trait Sink: Write + Send + 'static {
    /// Waits until everything written is on the disk.
    fn sync(&mut self) -> io::Result<()>;
}

impl Sink for File {
    fn sync(&mut self) -> io::Result<()> {
        match self.sync_data() {
            // A pipe or a terminal has no disk.
            Err(error) if error.kind() == io::ErrorKind::InvalidInput => Ok(()),
            result => result,
        }
    }
}

/// A file that grows, and others that are replaced.
///
/// Pending writes wait in memory, so no caller waits for the disk before [`Writer::finish`].
#[derive(Debug)]
pub(crate) struct Writer {
    jobs: Sender<Job>,
    thread: JoinHandle<()>,
    failed: Arc<OnceLock<RecordError>>,
}

impl Writer {
    /// Writes to the end of `file`, whose path is `path`.
    ///
    /// # Errors
    /// The system refuses to start a thread.
    pub(crate) fn new(path: PathBuf, file: impl Sink) -> io::Result<Self> {
        let (jobs, given) = mpsc::channel();
        let failed = Arc::new(OnceLock::new());
        let first = Arc::clone(&failed);
        Ok(Self {
            jobs,
            thread: thread::Builder::new().spawn(move || write(&path, file, given, &first))?,
            failed,
        })
    }

    /// The first failed write so far. Does not wait.
    pub(crate) fn failure(&self) -> Option<&RecordError> {
        self.failed.get()
    }

    /// A writer that appends to the file; writing to it never fails.
    pub(crate) fn appender(&self) -> Appender {
        Appender(self.jobs.clone())
    }

    /// Replaces another file as [`client::plain::replace`] does.
    pub(crate) fn replace(&self, path: PathBuf, bytes: Vec<u8>) {
        let _ = self.jobs.send(Job::Replace(path, bytes));
    }

    /// Waits until everything is on the disk; drop all appenders first. A file written afterwards, such as the sidecar
    /// that calls the record complete, then cannot survive a power cut without the rows.
    ///
    /// # Errors
    /// The first failed write. After a failed append, nothing more is appended to that file.
    pub(crate) fn finish(self) -> Result<(), RecordError> {
        drop(self.jobs);
        self.thread.join().expect("it does not panic");
        match self.failed.get() {
            Some(failed) => Err(failed.clone()),
            None => Ok(()),
        }
    }
}

/// Queues bytes for the thread that writes the file.
#[derive(Debug)]
pub(crate) struct Appender(Sender<Job>);

impl Write for Appender {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // Cannot fail: the thread runs until the last appender is dropped. `finish` reports errors.
        let _ = self.0.send(Job::Append(bytes.to_vec()));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn write(path: &Path, mut file: impl Sink, jobs: Receiver<Job>, failed: &OnceLock<RecordError>) {
    let mut appends = true;
    let fail = |path: &Path, io: io::Error| {
        // Keep the first failure only: it is the cause.
        let _ = failed.set(RecordError::write(path, io));
    };
    for job in jobs {
        let written = match job {
            // Append nothing after a failure: rows would be missing in the middle.
            Job::Append(_) if !appends => continue,
            Job::Append(bytes) => {
                let written = file.write_all(&bytes);
                appends = written.is_ok();
                written.map_err(|io| (path.to_owned(), io))
            }
            // Try this even after a failure: it says how the trial ended.
            Job::Replace(path, bytes) => replace(&path, &bytes).map_err(|io| (path, io)),
        };
        if let Err((path, io)) = written {
            fail(&path, io);
        }
    }
    if let Err(io) = file.sync() {
        fail(path, io);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use client::plain::create;
    use std::fs;
    use std::time::{Duration, Instant};

    #[test]
    fn everything_is_there_at_the_end_and_in_order() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, other) = (folder.path().join("a.csv"), folder.path().join("a.json"));
        let writer =
            Writer::new(path.clone(), File::create(&path).expect("new")).expect("a thread");
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

    /// A file of which a test sees what was synced.
    struct Disk(Arc<std::sync::Mutex<Vec<&'static str>>>);

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().expect("free").push("written");
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Sink for Disk {
        fn sync(&mut self) -> io::Result<()> {
            self.0.lock().expect("free").push("synced");
            Err(io::Error::other("no space"))
        }
    }

    /// Else a power cut could leave a sidecar that calls the record complete beside a file that is cut short.
    #[test]
    fn what_is_finished_is_on_the_disk() {
        let log = Arc::default();
        let writer = Writer::new(PathBuf::from("a.csv"), Disk(Arc::clone(&log))).expect("a thread");
        writer.appender().write_all(b"row\n").expect("never fails");
        let error = writer.finish().expect_err("it was not synced");
        assert_eq!(error.why, "no space");
        assert_eq!(*log.lock().expect("free"), ["written", "synced"]);
    }

    /// A pipe whose reader does not read acts as a disk that does not write.
    #[test]
    fn a_disk_that_stands_delays_nobody() {
        let (reader, pipe) = io::pipe().expect("a pipe");
        let file = File::from(std::os::fd::OwnedFd::from(pipe));
        let writer = Writer::new(PathBuf::from("pipe"), file).expect("a thread");
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
        // Open for reading only, so that appending fails.
        let writer =
            Writer::new(path.clone(), File::open(&path).expect("there")).expect("a thread");
        let sidecar = folder.path().join("a.json");
        assert!(writer.failure().is_none());
        writer.appender().write_all(b"row\n").expect("never fails");
        // The failure is visible while more may come, not only at the end.
        let begun = Instant::now();
        while writer.failure().is_none() && begun.elapsed() < Duration::from_secs(20) {
            thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(writer.failure().expect("told").path, path);
        writer.replace(sidecar.clone(), b"the end".to_vec());
        assert_eq!(writer.finish().expect_err("read only").path, path);
        assert_eq!(fs::read(&sidecar).expect("there"), b"the end");
    }

    /// A disk that is full once, and then has space again: what it took, and how often it was asked.
    struct Hiccup(Arc<std::sync::Mutex<Vec<Vec<u8>>>>, u32);

    impl Write for Hiccup {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.1 += 1;
            if self.1 == 2 {
                return Err(io::Error::other("no space"));
            }
            self.0.lock().expect("free").push(bytes.to_vec());
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Sink for Hiccup {
        fn sync(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn nothing_is_appended_behind_a_hole() {
        let taken = Arc::default();
        let writer =
            Writer::new(PathBuf::from("a.csv"), Hiccup(Arc::clone(&taken), 0)).expect("a thread");
        let mut appender = writer.appender();
        for row in ["1\n", "2\n", "3\n"] {
            appender.write_all(row.as_bytes()).expect("never fails");
        }
        drop(appender);
        assert_eq!(writer.finish().expect_err("full").why, "no space");
        assert_eq!(*taken.lock().expect("free"), [b"1\n".to_vec()]);
    }
}
