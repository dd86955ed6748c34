//! The files of a line: lock, owner, socket, and marks of stops.
//!
//! All files are in one folder of the user's, by default `/tmp/retrograde-UID`. It is not below `XDG_RUNTIME_DIR`,
//! because that differs in a `cron` job or after `su`, and a stop has to find the socket from everywhere. A line has
//! five files there, named by a hash of the device or address that it resolves to. The owner keeps `.lock` locked as
//! long as it lives; `.owner` describes the owner; `.socket` is the socket. The modification times of `.stop` and
//! `.estop` show whether a stop was requested since a process last read them.

use std::fs::{self, File, TryLockError};
use std::io::{self, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, ToSocketAddrs};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use protocol::session::fnv1a;
use protocol::system::Urgent;

use crate::address::Address;
use crate::broker::stream;
use crate::limited;
use crate::link::owner::{Owner, StopMark};
use crate::link::{OpenError, Reason};
use crate::plain::{self, Locked};

/// Environment variable that names another folder for locks and sockets.
const FOLDER_VARIABLE: &str = "RETROGRADE_RUNTIME_DIR";

/// Location of a line's files.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LineFiles {
    folder: PathBuf,
    key: String,
    place: String,
}

/// Exclusive ownership of a line, until dropped.
#[derive(Debug)]
pub struct Lock {
    line_files: LineFiles,
    owner: Owner,
    // The system releases the lock however the process ends.
    _locked: Locked,
}

impl LineFiles {
    /// The last stops on this line; empty without files, because no other process can then send one.
    pub fn last_stops(line_files: Option<&Self>) -> StopMark {
        line_files.map_or_else(StopMark::default, Self::stop_mark)
    }

    /// Locates the files of the line behind an address; `None` if there is no line to own.
    ///
    /// # Errors
    /// The folder cannot be created, or belongs to another user.
    pub fn of(address: &Address) -> Result<Option<Self>, OpenError> {
        let Some(line) = line(address) else {
            return Ok(None);
        };
        let place = address.to_string();
        let folder = folder().map_err(|why| OpenError {
            place: place.clone(),
            reason: Reason::Other,
            why,
            remedy: format!(
                "every process that uses a machine keeps a lock in a folder that only you can access: fix that folder, or name another with {FOLDER_VARIABLE}"
            ),
        })?;
        Ok(Some(Self::new(folder, &line, place)))
    }

    /// Like [`LineFiles::of`], in another folder, which must exist and be safe from other users.
    pub fn within(folder: &Path, address: &Address) -> Option<Self> {
        Some(Self::new(
            folder.to_owned(),
            &line(address)?,
            address.to_string(),
        ))
    }

    /// The files of a line in this folder.
    pub fn new(folder: PathBuf, line: &str, place: String) -> Self {
        // The hash is the same in every build, and short: the path of a socket may have at most 107 bytes.
        let hash = fnv1a(line.as_bytes());
        Self {
            folder,
            key: format!("{hash:016x}"),
            place,
        }
    }

    fn file(&self, what: &str) -> PathBuf {
        self.folder.join(format!("{}.{what}", self.key))
    }

    pub fn place(&self) -> &str {
        &self.place
    }

    fn error(&self, why: impl ToString) -> OpenError {
        OpenError {
            place: self.place.clone(),
            reason: Reason::Other,
            why: format!("its lock in {}: {}", self.folder.display(), why.to_string()),
            remedy: format!(
                "see that the folder can be written, has free space and holds only files of `retrograde`, or name another with {FOLDER_VARIABLE}"
            ),
        }
    }

    /// Takes the line; `None` if another process has it.
    pub fn claim(&self) -> Result<Option<Lock>, OpenError> {
        let file = plain::open_or_create(&self.file("lock")).map_err(|why| self.error(why))?;
        match Locked::new(file) {
            // A process listens at the socket, so the line is taken, even if a cleaner of `/tmp` has removed the lock.
            Ok(_) if self.is_attended() => Ok(None),
            Ok(locked) => {
                // Remains of an owner that was killed.
                let _ = fs::remove_file(self.file("socket"));
                let _ = fs::remove_file(self.file("owner"));
                Ok(Some(Lock {
                    line_files: self.clone(),
                    owner: Owner::this_process(),
                    _locked: locked,
                }))
            }
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(why)) => Err(self.error(why)),
        }
    }

    /// The last stops on the line.
    #[must_use]
    fn stop_mark(&self) -> StopMark {
        let changed = |urgent| {
            let found = fs::metadata(self.file(stop_file(urgent)));
            found.and_then(|found| found.modified()).ok()
        };
        StopMark {
            stop: changed(Urgent::Stop),
            estop: changed(Urgent::EStop),
        }
    }

    /// Marks for all processes that a stop is being sent. Only the modification time of a file changes, which works on
    /// a full disk. The stop is sent even if this fails.
    ///
    /// Call this before sending the stop. If called later, orders given after the stop was confirmed would be refused.
    pub fn mark_stop(&self, urgent: Urgent) {
        let path = self.file(stop_file(urgent));
        let mark = || plain::open_or_create(&path)?.set_modified(SystemTime::now());
        if mark().is_err() {
            // A link, a pipe or a file that cannot be written: not created by this program.
            let _ = fs::remove_file(&path);
            let _ = mark();
        }
    }

    pub fn owner(&self) -> Option<Owner> {
        let text = plain::read(&self.file("owner"), limited::BY_HAND);
        serde_json::from_slice(&text.ok()?).ok()
    }

    /// Whether the owner seems to listen. A description without a socket belongs to an owner that is starting or
    /// exiting.
    pub fn is_open(&self) -> bool {
        self.file("socket").exists()
    }

    /// Whether a process listens at the socket, even if it does not accept connections.
    fn is_attended(&self) -> bool {
        match self.connect() {
            Ok(_) => true,
            Err(why) => why.kind() == io::ErrorKind::WouldBlock,
        }
    }

    /// Connects to the socket. Its path is fixed, so this works even if the owner's description was removed.
    pub fn connect(&self) -> io::Result<UnixStream> {
        stream::connect(&self.file("socket"))
    }
}

impl Lock {
    /// Binds the socket and publishes its owner.
    pub fn listen(&self) -> Result<UnixListener, OpenError> {
        let listener = UnixListener::bind(self.line_files.file("socket"));
        let listener = listener.map_err(|why| self.line_files.error(why))?;
        self.publish()?;
        Ok(listener)
    }

    fn publish(&self) -> Result<(), OpenError> {
        let line_files = &self.line_files;
        // Write and rename, so that a reader finds the old file or the new one, never a part.
        let (new, file) = (line_files.file("new"), line_files.file("owner"));
        let text = serde_json::to_vec(&self.owner).map_err(|why| line_files.error(why))?;
        // Remains of an owner that was killed. It is removed without being opened, whatever it is.
        let _ = fs::remove_file(&new);
        File::create_new(&new)
            .and_then(|mut part| part.write_all(&text))
            .and_then(|()| fs::rename(&new, &file))
            .map_err(|why| line_files.error(why))
    }

    /// Publishes the owner before its socket is open.
    pub fn announce(&self) -> Result<(), OpenError> {
        // Remove the socket of an owner that was killed: no process listens there.
        let _ = fs::remove_file(self.line_files.file("socket"));
        self.publish()
    }

    pub fn owner(&self) -> &Owner {
        &self.owner
    }

    pub fn line_files(&self) -> &LineFiles {
        &self.line_files
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // Keep the lock file: another process may be about to lock it.
        let _ = fs::remove_file(self.line_files.file("socket"));
        let _ = fs::remove_file(self.line_files.file("owner"));
    }
}

fn stop_file(urgent: Urgent) -> &'static str {
    match urgent {
        Urgent::Stop => "stop",
        Urgent::EStop => "estop",
    }
}

/// Resolves an address, so that two names of one line give the same text.
fn line(address: &Address) -> Option<String> {
    match address {
        Address::Serial(path) => {
            // A missing port has no owner; opening it reports the problem.
            let path = fs::canonicalize(path).ok()?;
            Some(format!("serial {}", path.display()))
        }
        Address::Tcp(place) => {
            let at = place.to_socket_addrs().ok()?.next()?;
            Some(format!("tcp {}", host(at)))
        }
        Address::Auto | Address::Virtual => None,
    }
}

/// Gives `localhost` in IPv4 and IPv6 the same name. Other loopback addresses stay distinct: each may be a tunnel to
/// another machine, and a stop must not use the broker of the wrong one.
fn host(at: SocketAddr) -> String {
    let is_local = match at.ip().to_canonical() {
        IpAddr::V4(ip) => ip == Ipv4Addr::LOCALHOST,
        IpAddr::V6(ip) => ip == Ipv6Addr::LOCALHOST,
    };
    match is_local {
        true => format!("localhost:{}", at.port()),
        false => at.to_string(),
    }
}

/// The folder, created if necessary, and inaccessible to other users.
pub fn folder() -> Result<PathBuf, String> {
    let folder = match std::env::var_os(FOLDER_VARIABLE) {
        Some(folder) if !folder.is_empty() => PathBuf::from(folder),
        _ => {
            let user = rustix::process::geteuid().as_raw();
            PathBuf::from(format!("/tmp/retrograde-{user}"))
        }
    };
    make(&folder).map_err(|why| format!("{}: {why}", folder.display()))?;
    Ok(folder)
}

fn make(folder: &Path) -> Result<(), String> {
    use std::os::unix::fs::{DirBuilderExt, MetadataExt};
    match fs::DirBuilder::new().mode(0o700).create(folder) {
        Err(why) if why.kind() != io::ErrorKind::AlreadyExists => return Err(why.to_string()),
        _ => {}
    }
    // Do not follow a link: anybody may create one in /tmp.
    let found = fs::symlink_metadata(folder).map_err(|why| why.to_string())?;
    if !found.is_dir() {
        return Err("it is not a directory".to_owned());
    }
    if found.uid() != rustix::process::geteuid().as_raw() {
        return Err("it belongs to another user".to_owned());
    }
    if found.mode() & 0o077 != 0 {
        return Err("other users have access to it (`chmod 700`)".to_owned());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::owner::Began;

    fn line_files(folder: &Path, line: &str) -> LineFiles {
        LineFiles::new(folder.to_owned(), line, line.to_owned())
    }

    #[test]
    fn one_owner_at_a_time_and_another_line_is_another_lock() {
        let folder = tempfile::tempdir().expect("a folder");
        let one = line_files(folder.path(), "one");
        let owned = one.claim().expect("possible").expect("free");
        assert!(one.claim().expect("possible").is_none());
        let other = line_files(folder.path(), "other");
        assert!(other.claim().expect("possible").is_some());
        owned.announce().expect("possible");
        let pid = one.owner().expect("announced").pid;
        assert_eq!(pid, std::process::id());
        drop(owned);
        assert!(one.owner().is_none());
        assert!(one.claim().expect("possible").is_some());
    }

    #[test]
    fn names_of_one_line_give_the_same_lock() {
        let lines = [
            "tcp:127.0.0.1:7001",
            "tcp:[::1]:7001",
            "tcp:[::ffff:127.0.0.1]:7001",
        ];
        for text in lines {
            let address = text.parse().expect("an address");
            assert_eq!(line(&address), Some("tcp localhost:7001".to_owned()));
        }
        // Perhaps a tunnel to another machine.
        let other = line(&"tcp:127.0.0.2:7001".parse().expect("an address"));
        assert_eq!(other, Some("tcp 127.0.0.2:7001".to_owned()));
        for text in ["auto", "virtual", "/dev/retrograde-no-such-port"] {
            assert_eq!(line(&text.parse().expect("an address")), None);
        }
    }

    #[test]
    fn every_stop_changes_the_mark_of_its_line_and_of_no_other() {
        let folder = tempfile::tempdir().expect("a folder");
        let (one, other) = (
            line_files(folder.path(), "one"),
            line_files(folder.path(), "other"),
        );
        let began = Began::now();
        let mut marks = vec![one.stop_mark()];
        for n in 0..100 {
            let urgent = if n % 3 == 0 {
                Urgent::EStop
            } else {
                Urgent::Stop
            };
            one.mark_stop(urgent);
            marks.push(one.stop_mark());
            let [.., before, now] = marks[..] else {
                panic!("two marks")
            };
            assert_eq!(now.since(before), Some(urgent));
        }
        assert_eq!(marks[100].since(marks[0]), Some(Urgent::EStop));
        assert_eq!(one.stop_mark().since(marks[100]), None);
        let now = one.stop_mark();
        assert_eq!(now.since(now.before(began)), Some(Urgent::EStop));
        assert_eq!(now.since(now.before(Began::now())), None);
        assert_eq!(other.stop_mark(), StopMark::default());
    }

    #[test]
    fn a_mark_that_is_cleaned_away_is_no_stop() {
        let folder = tempfile::tempdir().expect("a folder");
        let line_files = line_files(folder.path(), "one");
        for urgent in [Urgent::Stop, Urgent::EStop] {
            line_files.mark_stop(urgent);
            let before = line_files.stop_mark();
            fs::remove_file(line_files.file(stop_file(urgent))).expect("as a cleaner does");
            assert_eq!(line_files.stop_mark().since(before), None);
            line_files.mark_stop(urgent);
            assert_eq!(line_files.stop_mark().since(before), Some(urgent));
        }
    }

    /// Regression: a stop waited for ever at a FIFO of one of these names.
    #[test]
    fn a_pipe_in_place_of_any_file_is_waited_for_by_nobody() {
        let place = tempfile::tempdir().expect("a folder");
        let pipes = ["lock", "owner", "socket", "new", "stop", "estop"];
        let (tell, told) = std::sync::mpsc::channel();
        for name in pipes {
            let line_files = line_files(place.path(), name);
            let mode = rustix::fs::Mode::from_raw_mode(0o600);
            rustix::fs::mkfifoat(rustix::fs::CWD, line_files.file(name), mode).expect("a FIFO");
            let tell = tell.clone();
            std::thread::spawn(move || {
                assert!(line_files.owner().is_none());
                for urgent in [Urgent::Stop, Urgent::EStop] {
                    let before = line_files.stop_mark();
                    line_files.mark_stop(urgent);
                    assert_eq!(line_files.stop_mark().since(before), Some(urgent));
                }
                let claimed = line_files
                    .claim()
                    .map(|lock| lock.expect("free").listen().map(drop));
                tell.send((name, claimed.is_ok_and(|opened| opened.is_ok())))
            });
        }
        for _ in pipes {
            let (name, opened) = told
                .recv_timeout(std::time::Duration::from_secs(10))
                .expect("waits for nobody");
            // The lock alone cannot be replaced: another process may hold it.
            assert_eq!(opened, name != "lock", "{name}");
        }
    }

    #[test]
    fn a_folder_that_others_can_enter_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("open");
        assert_eq!(make(&path), Ok(()));
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("mine");
        assert!(make(&path).expect_err("open").contains("chmod 700"));
        let link = folder.path().join("link");
        std::os::unix::fs::symlink(folder.path(), &link).expect("a link");
        assert!(make(&link).expect_err("a link").contains("not a directory"));
    }
}
