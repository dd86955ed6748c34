//! Plain files of a folder that somebody else may have made: a link is never followed, a FIFO never waited for, a
//! device never opened, and no file is read beyond its limit.

use std::ffi::OsString;
use std::fs::{self, File, TryLockError};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, Read, Write};
use std::ops::Deref;
use std::path::{Path, PathBuf};

use crate::limited;

/// Limit for the telemetry of one trial, and for any file that is hashed, bytes: 2.5 million rows.
pub const TELEMETRY: u64 = 256 << 20;

/// Longest line of a table, bytes.
pub const LINE: usize = 64 << 10;

/// Suffix of a file that is about to replace another one.
pub const PART: &str = ".part";

/// The error for a path that names something else than a plain file.
fn not_plain() -> io::Error {
    let why = "it is no plain file, and links, pipes and devices are not opened here";
    io::Error::new(io::ErrorKind::InvalidInput, why)
}

/// Opens a plain file for reading.
///
/// # Errors
/// Those of the file; it is a link, or something else that is no plain file.
pub fn open(path: &Path) -> io::Result<File> {
    opened(path, fs::OpenOptions::new().read(true))
}

/// Opens an existing plain file for reading and writing.
///
/// # Errors
/// As [`open`].
pub fn open_to_write(path: &Path) -> io::Result<File> {
    opened(path, fs::OpenOptions::new().read(true).write(true))
}

/// Opens a plain file for writing, which is created empty if it is missing.
///
/// # Errors
/// As [`open`].
pub fn open_or_create(path: &Path) -> io::Result<File> {
    let mut options = fs::OpenOptions::new();
    opened(path, options.write(true).create(true).truncate(false))
}

fn opened(path: &Path, options: &mut fs::OpenOptions) -> io::Result<File> {
    // A special file must not even be opened: that alone may wait, or have an effect.
    match fs::symlink_metadata(path) {
        Ok(found) if !found.is_file() => return Err(not_plain()),
        _ => {}
    }
    #[cfg(unix)]
    {
        use rustix::fs::OFlags;
        use std::os::unix::fs::OpenOptionsExt;
        // The path may have become another file since it was looked at.
        let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY;
        options.custom_flags(i32::try_from(flags.bits()).unwrap_or_default());
    }
    let file = options.open(path)?;
    if file.metadata()?.is_file() {
        Ok(file)
    } else {
        Err(not_plain())
    }
}

/// A file that this process has locked.
#[derive(Debug)]
pub struct Locked(File);

impl Locked {
    /// Locks the file.
    ///
    /// # Errors
    /// [`TryLockError::WouldBlock`] if it is locked already.
    pub fn new(file: File) -> Result<Self, TryLockError> {
        file.try_lock()?;
        Ok(Self(file))
    }
}

impl Deref for Locked {
    type Target = File;

    fn deref(&self) -> &File {
        &self.0
    }
}

impl Drop for Locked {
    fn drop(&mut self) {
        // Closing the file is not enough: a child process has a copy of it until it has started its program.
        let _ = self.0.unlock();
    }
}

/// Reads a plain file of at most `limit` bytes.
///
/// # Errors
/// As [`open`], and [`io::ErrorKind::FileTooLarge`].
pub fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let file = open_within(path, limit)?;
    limited::read_from(file, limit)
}

/// Like [`read`], for text.
///
/// # Errors
/// As [`read`], and [`io::ErrorKind::InvalidData`] if it is not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    limited::text(read(path, limit)?)
}

/// Opens a plain file of at most `limit` bytes. A reader should still not read on without end: the file may grow.
///
/// # Errors
/// As [`read`].
pub fn open_within(path: &Path, limit: u64) -> io::Result<io::Take<File>> {
    let file = open(path)?;
    if file.metadata()?.len() > limit {
        return Err(limited::too_large(limit));
    }
    Ok(file.take(limit))
}

/// Opens the rows of a table, such as telemetry, of at most [`TELEMETRY`] bytes in lines of at most [`LINE`].
///
/// # Errors
/// As [`open_within`]; reading ends with [`io::ErrorKind::FileTooLarge`] at a longer line.
pub fn rows(path: &Path) -> io::Result<impl Read + use<>> {
    let file = open_within(path, TELEMETRY)?;
    Ok(Rows { file, in_line: 0 })
}

/// Refuses a line without an end: a reader of rows keeps a whole line in memory.
struct Rows<R> {
    file: R,
    in_line: usize,
}

impl<R: Read> Read for Rows<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read(buffer)?;
        for byte in &buffer[..count] {
            self.in_line = if *byte == b'\n' { 0 } else { self.in_line + 1 };
            if self.in_line > LINE {
                return Err(limited::too_large(LINE as u64));
            }
        }
        Ok(count)
    }
}

/// Whether the path names a plain file, itself and not by a link.
#[must_use]
pub fn is_file(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_file())
}

/// Whether the path names a folder, itself and not by a link.
#[must_use]
pub fn is_folder(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_dir())
}

/// Whether the text names a file in its own folder, and none elsewhere.
#[must_use]
pub fn is_name(text: &str) -> bool {
    let odd = |c: char| matches!(c, '/' | '\\' | ':') || c.is_control();
    !matches!(text, "" | "." | "..") && !text.chars().any(odd)
}

/// The plain files of a folder, by name. Empty if the folder cannot be read or is a link.
#[must_use]
pub fn files(folder: &Path) -> Vec<PathBuf> {
    if !is_folder(folder) {
        return vec![];
    }
    let Ok(entries) = fs::read_dir(folder) else {
        return vec![];
    };
    let mut files: Vec<_> = entries
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()))
        .map(|entry| entry.path())
        .collect();
    files.sort();
    files
}

/// A name that no other file has: the target's with some random letters.
#[must_use]
pub fn part_of(name: &Path) -> OsString {
    let random = RandomState::new().hash_one(name);
    let mut part = name.as_os_str().to_owned();
    part.push(format!(".{random:016x}{PART}"));
    part
}

/// Name of the file that `part` was about to replace, if it has the form of [`part_of`].
#[must_use]
pub fn of_part(part: &str) -> Option<&str> {
    let (name, random) = part.strip_suffix(PART)?.rsplit_once('.')?;
    let is_random = random.len() == 16 && random.bytes().all(|byte| byte.is_ascii_hexdigit());
    (is_random && !name.is_empty()).then_some(name)
}

/// A folder that is written to. It was opened without following a link and stays the same one, whatever happens to
/// its path meanwhile.
#[derive(Debug)]
pub struct Folder {
    #[cfg(unix)]
    folder: File,
    path: PathBuf,
}

impl Folder {
    /// Opens the folder `name` in `parent`, and creates it if it is missing. `parent` is where the user points, and may
    /// be reached through links.
    ///
    /// # Errors
    /// `name` is a link or no folder, or it cannot be created.
    pub fn below(parent: &Path, name: &str) -> io::Result<Self> {
        let path = parent.join(name);
        match fs::create_dir(&path) {
            Err(io) if io.kind() != io::ErrorKind::AlreadyExists => return Err(io),
            _ => {}
        }
        if !is_folder(&path) {
            let why = "it is a link or no folder, and nothing is written through it";
            return Err(io::Error::new(io::ErrorKind::NotADirectory, why));
        }
        #[cfg(unix)]
        {
            use rustix::fs::{Mode, OFlags};
            let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
            let folder = File::from(rustix::fs::open(&path, flags, Mode::empty())?);
            Ok(Self { folder, path })
        }
        #[cfg(not(unix))]
        Ok(Self { path })
    }

    /// Path of a file in it, for messages.
    #[must_use]
    pub fn path(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    fn create_new(&self, name: &Path) -> io::Result<File> {
        #[cfg(unix)]
        {
            use rustix::fs::{Mode, OFlags};
            let flags =
                OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::NOFOLLOW | OFlags::CLOEXEC;
            let mode = Mode::from_raw_mode(0o666);
            Ok(rustix::fs::openat(&self.folder, name, flags, mode)?.into())
        }
        #[cfg(not(unix))]
        File::create_new(self.path.join(name))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        #[cfg(unix)]
        {
            rustix::fs::renameat(&self.folder, from, &self.folder, to)?;
            self.folder.sync_all()
        }
        #[cfg(not(unix))]
        fs::rename(self.path.join(from), self.path.join(to))
    }

    fn unlink(&self, name: &Path) -> io::Result<()> {
        #[cfg(unix)]
        return Ok(rustix::fs::unlinkat(
            &self.folder,
            name,
            rustix::fs::AtFlags::empty(),
        )?);
        #[cfg(not(unix))]
        fs::remove_file(self.path.join(name))
    }

    /// Replaces a file by renaming, as [`replace`].
    ///
    /// # Errors
    /// It cannot be written; the old one is still there.
    pub fn replace(&self, name: &str, bytes: &[u8]) -> io::Result<()> {
        let (name, part) = (Path::new(name), part_of(Path::new(name)));
        let part = Path::new(&part);
        let mut file = self.create_new(part)?;
        file.write_all(bytes)
            .and_then(|()| file.sync_all())
            .and_then(|()| self.rename(part, name))
            // Nothing will complete this file.
            .inspect_err(|_| drop(self.unlink(part)))
    }

    /// As [`Folder::replace`], for a file that must not exist yet.
    ///
    /// # Errors
    /// As [`Folder::replace`]; with [`io::ErrorKind::AlreadyExists`] the existing file is unchanged.
    pub fn create(&self, name: &str, bytes: &[u8]) -> io::Result<()> {
        drop(self.create_new(Path::new(name))?);
        self.replace(name, bytes)
            .inspect_err(|_| drop(self.unlink(Path::new(name))))
    }

    /// Removes a file; one that is missing is no error.
    ///
    /// # Errors
    /// It cannot be removed.
    pub fn remove(&self, name: &str) -> io::Result<()> {
        match self.unlink(Path::new(name)) {
            Err(io) if io.kind() != io::ErrorKind::NotFound => Err(io),
            _ => Ok(()),
        }
    }
}

/// Replaces a file by renaming: a reader finds the old one or the new one, never a part of it. The new one begins as
/// a new file of a random name beside it, so that no link can lead the bytes elsewhere; a link of the target's own name
/// is replaced, not followed. The new name is on the disk when this returns.
///
/// # Errors
/// It cannot be written; the old one is still there.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let name = path.file_name().unwrap_or_default();
    let part = path.with_file_name(part_of(Path::new(name)));
    let mut file = File::create_new(&part)?;
    file.write_all(bytes)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(&part, path))
        // Nothing will complete this file.
        .inspect_err(|_| drop(fs::remove_file(&part)))?;
    sync_folder_of(path)
}

/// As [`replace`], for a file that must not exist yet.
///
/// # Errors
/// As [`replace`]; with [`io::ErrorKind::AlreadyExists`] the existing file is unchanged.
pub fn create(path: &Path, bytes: &[u8]) -> io::Result<()> {
    // The first process to create the name keeps it. Until the rename the file is empty, and no reader takes it for
    // complete.
    drop(File::create_new(path)?);
    replace(path, bytes).inspect_err(|_| drop(fs::remove_file(path)))
}

/// Brings the names in the folder of this path to the disk: without this a power cut may undo a rename.
///
/// # Errors
/// The folder cannot be opened, or the disk reports an error.
pub fn sync_folder_of(path: &Path) -> io::Result<()> {
    // Other systems do not open folders.
    if cfg!(not(unix)) {
        return Ok(());
    }
    let parent = path.parent().filter(|parent| *parent != Path::new(""));
    match File::open(parent.unwrap_or(Path::new(".")))?.sync_all() {
        // Some network file systems cannot do it.
        Err(io)
            if matches!(
                io.kind(),
                io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported
            ) =>
        {
            Ok(())
        }
        other => other,
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_lock_ends_though_a_child_process_has_a_copy_of_its_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("lock");
        let open = || open_or_create(&path).expect("mine");
        let file = open();
        let copy = file.try_clone().expect("a copy");
        let locked = Locked::new(file).expect("free");
        assert!(matches!(Locked::new(open()), Err(TryLockError::WouldBlock)));
        drop(locked);
        Locked::new(open()).expect("free again");
        drop(copy);
    }

    fn fifo(path: &Path) {
        rustix::fs::mkfifoat(
            rustix::fs::CWD,
            path,
            rustix::fs::Mode::from_raw_mode(0o600),
        )
        .expect("a FIFO");
    }

    #[test]
    fn only_plain_files_are_opened_and_none_without_an_end() {
        let place = tempfile::tempdir().expect("a folder");
        let file = |name: &str| place.path().join(name);
        fs::write(file("plain"), "123").expect("written");
        symlink(file("plain"), file("link")).expect("a link");
        symlink("/dev/zero", file("zero")).expect("a link");
        fifo(&file("fifo"));
        fs::create_dir(file("folder")).expect("a folder");
        assert_eq!(read_text(&file("plain"), 3).expect("plain"), "123");
        let error = read(&file("plain"), 2).expect_err("too long");
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
        for odd in ["link", "zero", "fifo", "folder"] {
            assert!(read(&file(odd), 1_000).is_err(), "{odd}");
            assert!(open_to_write(&file(odd)).is_err(), "{odd}");
            assert!(open_or_create(&file(odd)).is_err(), "{odd}");
            assert!(!is_file(&file(odd)), "{odd}");
        }
        assert!(read(Path::new("/dev/zero"), 1_000).is_err());
        assert_eq!(files(place.path()), [file("plain")]);
        // A sparse file takes no room on the disk, and all memory if it is read as one line.
        let sparse = File::create(file("sparse")).expect("new");
        sparse.set_len(1 << 40).expect("set");
        assert!(rows(&file("sparse")).is_err());
        sparse.set_len(LINE as u64 + 1).expect("set");
        let read = io::read_to_string(rows(&file("sparse")).expect("small"));
        assert_eq!(
            read.expect_err("one line").kind(),
            io::ErrorKind::FileTooLarge
        );
    }

    #[test]
    fn a_name_leads_nowhere_else() {
        for good in ["run-20260131T120000Z.csv", "a b.csv", "..csv"] {
            assert!(is_name(good), "{good}");
        }
        for bad in [
            "",
            ".",
            "..",
            "/dev/zero",
            "a/b.csv",
            "../a.csv",
            "C:\\a",
            "a\n",
        ] {
            assert!(!is_name(bad), "{bad}");
        }
    }

    #[test]
    fn a_link_is_replaced_and_never_written_through() {
        let place = tempfile::tempdir().expect("a folder");
        let (victim, link) = (place.path().join("victim"), place.path().join("a.html"));
        fs::write(&victim, "mine").expect("written");
        symlink(&victim, &link).expect("a link");
        symlink(&victim, place.path().join("a.html.part")).expect("a link");
        assert!(create(&link, b"new").is_err());
        replace(&link, b"new").expect("written");
        assert_eq!(fs::read(&victim).expect("there"), b"mine");
        assert_eq!(fs::read(&link).expect("there"), b"new");
        assert!(is_file(&link));
    }

    #[test]
    fn nothing_is_written_through_a_linked_folder() {
        let place = tempfile::tempdir().expect("a folder");
        let elsewhere = place.path().join("elsewhere");
        fs::create_dir(&elsewhere).expect("a folder");
        symlink(&elsewhere, place.path().join("report")).expect("a link");
        assert!(Folder::below(place.path(), "report").is_err());
        let folder = Folder::below(place.path(), "new").expect("created");
        folder.create("a", b"1").expect("new");
        let again = folder.create("a", b"2").expect_err("there");
        assert_eq!(again.kind(), io::ErrorKind::AlreadyExists);
        // The folder is the one that was opened, even if its path now leads elsewhere.
        fs::rename(place.path().join("new"), place.path().join("moved")).expect("moved");
        symlink(&elsewhere, place.path().join("new")).expect("a link");
        folder.replace("a", b"3").expect("written");
        folder.remove("missing").expect("no error");
        assert_eq!(fs::read(place.path().join("moved/a")).expect("there"), b"3");
        assert_eq!(fs::read_dir(&elsewhere).expect("there").count(), 0);
    }

    /// Events in a folder, in order: `new` for a name that a rename has put there, `open` for the folder itself,
    /// which only its synchronisation opens here.
    #[cfg(target_os = "linux")]
    fn seen(folder: &Path, act: impl FnOnce()) -> Vec<&'static str> {
        use rustix::fs::inotify::{CreateFlags, ReadFlags, Reader, WatchFlags, add_watch, init};
        let watch = init(CreateFlags::NONBLOCK).expect("a watch");
        let flags = WatchFlags::MOVED_TO | WatchFlags::OPEN;
        add_watch(&watch, folder, flags).expect("watched");
        act();
        let mut buffer = [std::mem::MaybeUninit::uninit(); 4_096];
        let mut reader = Reader::new(watch, &mut buffer);
        let mut seen = vec![];
        while let Ok(event) = reader.next() {
            if event.events().contains(ReadFlags::MOVED_TO) {
                seen.push("new");
            } else if event.events().contains(ReadFlags::ISDIR) {
                seen.push("open");
            }
        }
        seen
    }

    /// Without this, a power cut may undo the rename that made the file whole.
    #[cfg(target_os = "linux")]
    #[test]
    fn a_new_name_is_followed_by_a_synchronisation_of_its_folder() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("a");
        for write in [create, replace] {
            let seen = seen(place.path(), || write(&path, b"1").expect("written"));
            assert_eq!(seen, ["new", "open"]);
        }
        let missing = sync_folder_of(&place.path().join("missing/a"));
        assert_eq!(
            missing.expect_err("no folder").kind(),
            io::ErrorKind::NotFound
        );
    }

    /// A reader of rows keeps a line in memory: one at the limit is read, one beyond is not, wherever it stands.
    #[test]
    fn lines_of_a_table_are_read_up_to_their_limit() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("rows");
        let longest = "x".repeat(LINE) + "\n";
        for (text, fits) in [
            (longest.repeat(3) + "1,2\n", true),
            ("1,2\n".to_owned() + &longest, true),
            (format!("{longest}y{longest}"), false),
            (String::new(), true),
        ] {
            fs::write(&path, &text).expect("written");
            let read = io::read_to_string(rows(&path).expect("opened"));
            assert_eq!(read.ok(), fits.then_some(text));
        }
    }

    #[test]
    fn a_folder_that_cannot_be_made_says_why() {
        let place = tempfile::tempdir().expect("a folder");
        fs::write(place.path().join("file"), "mine").expect("written");
        assert!(is_folder(place.path()) && !is_folder(&place.path().join("file")));
        assert!(!is_folder(&place.path().join("none")));
        for (name, kind) in [
            ("file", io::ErrorKind::NotADirectory),
            ("none/new", io::ErrorKind::NotFound),
        ] {
            let error = Folder::below(place.path(), name).expect_err(name);
            assert_eq!(error.kind(), kind, "{name}");
        }
        assert_eq!(fs::read(place.path().join("file")).expect("there"), b"mine");
    }

    #[test]
    fn a_file_of_a_folder_is_removed_and_nothing_else_is_left() {
        let place = tempfile::tempdir().expect("a folder");
        let folder = Folder::below(place.path(), "new").expect("created");
        assert_eq!(folder.path("a"), place.path().join("new").join("a"));
        folder.create("a", b"1").expect("new");
        folder.remove("a").expect("removed");
        folder.remove("a").expect("no error");
        // A folder is no file, and one in the way leaves no part behind.
        fs::create_dir_all(folder.path("b/c")).expect("a folder");
        assert!(folder.remove("b").is_err());
        assert!(folder.replace("b", b"2").is_err());
        let left = fs::read_dir(place.path().join("new")).expect("there");
        assert_eq!(left.count(), 1);
    }

    #[test]
    fn a_part_names_the_file_that_it_was_about_to_replace() {
        let part = part_of(Path::new("run.csv"));
        assert_eq!(of_part(part.to_str().expect("UTF-8")), Some("run.csv"));
        let random = "0123456789abcdef";
        for (name, of) in [
            (format!("a.b.{random}{PART}"), Some("a.b")),
            (format!("a.{random}"), None),
            (format!(".{random}{PART}"), None),
            (format!("a.{random}0{PART}"), None),
            (format!("a.{}{PART}", &random[1..]), None),
            (format!("a.{}g{PART}", &random[1..]), None),
            (format!("{random}{PART}"), None),
            (PART.to_owned(), None),
        ] {
            assert_eq!(of_part(&name), of, "{name}");
        }
    }
}
