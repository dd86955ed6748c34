//! Plain files of a folder that may come from somebody else: links are not followed, FIFOs not waited for, devices not
//! opened, and no file is read beyond its limit.

use std::ffi::OsString;
use std::fs::{self, File, TryLockError};
use std::io::{self, Read, Write};
use std::ops::Deref;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;
use tempfile::{Builder, NamedTempFile, TempDir};

use crate::limited;

/// Maximum rows in the telemetry of one trial: 27 h at 10 ms. Longer runs are refused, and no further row is recorded.
pub const ROWS: u64 = 10_000_000;

/// Longest row of telemetry, bytes.
pub const ROW: u64 = 160;

/// Limit for the telemetry of one trial, and for any file that is hashed, bytes.
pub const TELEMETRY: u64 = (ROWS + 1) * ROW;

/// Longest line of a table, bytes.
pub const LINE: usize = 64 << 10;

/// Suffix of a file that is about to replace another one.
pub const PART: &str = ".part";

/// The error for a path that is not a plain file.
fn not_plain() -> io::Error {
    let why = "it is not a regular file; links, pipes and devices are not opened here";
    io::Error::new(io::ErrorKind::InvalidInput, why)
}

/// Opens a plain file for reading.
///
/// # Errors
/// Those of the file, or the path is a link or not a plain file.
pub fn open(path: &Path) -> io::Result<File> {
    opened(path, fs::OpenOptions::new().read(true))
}

/// Opens an existing plain file for reading and writing.
pub fn open_to_write(path: &Path) -> io::Result<File> {
    opened(path, fs::OpenOptions::new().read(true).write(true))
}

/// Opens a plain file for writing, which is created empty if it is missing.
pub fn open_or_create(path: &Path) -> io::Result<File> {
    let mut options = fs::OpenOptions::new();
    opened(path, options.write(true).create(true).truncate(false))
}

fn opened(path: &Path, options: &mut fs::OpenOptions) -> io::Result<File> {
    // Do not even open a special file: opening may wait, or have an effect.
    match fs::symlink_metadata(path) {
        Ok(found) if !found.is_file() => return Err(not_plain()),
        _ => {}
    }
    // The path may have been replaced since the check above.
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY;
    options.custom_flags(i32::try_from(flags.bits()).unwrap_or_default());
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
        // Closing the file is not enough: a child process keeps a copy of it until it has started its program.
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

/// Opens a plain file of at most `limit` bytes. The reader still needs a limit, because the file may grow.
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
/// As [`open_within`], or a spreadsheet has changed the format; reading ends with [`io::ErrorKind::FileTooLarge`] at a
/// longer line.
pub fn rows(path: &Path) -> io::Result<impl Read + use<>> {
    let mut file = open_within(path, TELEMETRY)?;
    let mut head = vec![];
    file.by_ref().take(1_024).read_to_end(&mut head)?;
    let table = limited::utf8(&head).map_err(io::Error::other)?;
    if let Some(why) = limited::foreign_table(&String::from_utf8_lossy(table)) {
        return Err(io::Error::other(why));
    }
    let file = io::Cursor::new(table.to_vec()).chain(file);
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

/// Whether the path itself is a plain file, not a link to one.
pub fn is_file(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_file())
}

/// Whether the path itself is a folder, not a link to one.
pub fn is_folder(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|found| found.is_dir())
}

/// Whether the text is a bare file name, without a path.
pub fn is_name(text: &str) -> bool {
    let odd = |c: char| matches!(c, '/' | '\\' | ':') || c.is_control();
    !matches!(text, "" | "." | "..") && !text.chars().any(odd)
}

/// The plain files of a folder, by name. Empty if the folder cannot be read or is a link.
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

/// Number of random letters in the name of a part.
const RANDOM: usize = 16;

/// Creates something beside `path`, named after it with random letters appended. `mode` is subject to the system's
/// umask.
fn beside<T>(
    path: &Path,
    mode: u32,
    make: impl Fn(&Builder<'_, '_>, &Path) -> io::Result<T>,
) -> io::Result<T> {
    let mut prefix = OsString::from(path.file_name().unwrap_or_default());
    prefix.push(".");
    let mut builder = Builder::new();
    builder.prefix(&prefix).suffix(PART).rand_bytes(RANDOM);
    builder.permissions(fs::Permissions::from_mode(mode));
    let parent = path.parent().filter(|parent| *parent != Path::new(""));
    make(&builder, parent.unwrap_or(Path::new("."))).map_err(|io| {
        // Omit the random name, which means nothing to the user.
        let text = io.to_string();
        let why = text.split(" at path ").next().unwrap_or_default();
        io::Error::new(io.kind(), why)
    })
}

/// A new file to replace `path`; it is removed unless it does. No link can redirect its bytes.
pub fn part_of(path: &Path) -> io::Result<NamedTempFile> {
    beside(path, 0o666, |builder, parent| builder.tempfile_in(parent))
}

/// As [`part_of`], for a folder.
pub fn part_of_folder(path: &Path) -> io::Result<TempDir> {
    beside(path, 0o777, |builder, parent| builder.tempdir_in(parent))
}

/// Name of the file that `part` was to replace, if it has the form of [`part_of`].
pub fn of_part(part: &str) -> Option<&str> {
    let (name, random) = part.strip_suffix(PART)?.rsplit_once('.')?;
    let is_random =
        random.len() == RANDOM && random.bytes().all(|byte| byte.is_ascii_alphanumeric());
    (is_random && !name.is_empty()).then_some(name)
}

/// The folder `name` in `parent`, created if it is missing. The user chooses `parent`, which may be reached through
/// links.
///
/// # Errors
/// `name` is a link or not a folder, or it cannot be created.
pub fn folder_below(parent: &Path, name: &str) -> io::Result<PathBuf> {
    let path = parent.join(name);
    match fs::create_dir(&path) {
        Err(io) if io.kind() != io::ErrorKind::AlreadyExists => return Err(io),
        _ => {}
    }
    if !is_folder(&path) {
        let why = "it is a link or no folder, and nothing is written through it";
        return Err(io::Error::new(io::ErrorKind::NotADirectory, why));
    }
    Ok(path)
}

/// Removes a file if it exists.
pub fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(io) if io.kind() != io::ErrorKind::NotFound => Err(io),
        _ => Ok(()),
    }
}

/// Writes a file completely or not at all, replacing an old one or only if there is none.
pub(crate) fn put(
    path: &Path,
    replaces: bool,
    fill: impl FnOnce(&File) -> io::Result<()>,
) -> io::Result<()> {
    let part = part_of(path)?;
    fill(part.as_file())?;
    part.as_file().sync_all()?;
    match replaces {
        true => part.persist(path)?,
        false => part.persist_noclobber(path)?,
    };
    sync_folder_of(path)
}

/// Replaces a file by renaming: a reader finds the old one or the new one, never a part. A link with the target's name
/// is replaced, not followed. The new name is on the disk when this returns.
///
/// # Errors
/// The file cannot be written; the old one is unchanged.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    put(path, true, |mut file| file.write_all(bytes))
}

/// As [`replace`], for a file that must not exist yet.
///
/// # Errors
/// As [`replace`]; with [`io::ErrorKind::AlreadyExists`] the existing file is unchanged.
pub fn create(path: &Path, bytes: &[u8]) -> io::Result<()> {
    put(path, false, |mut file| file.write_all(bytes))
}

/// Writes the names in the folder of this path to the disk: without this a power cut may undo a rename.
pub fn sync_folder_of(path: &Path) -> io::Result<()> {
    let parent = path.parent().filter(|parent| *parent != Path::new(""));
    match File::open(parent.unwrap_or(Path::new(".")))?.sync_all() {
        // Some network file systems do not support this.
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

#[cfg(test)]
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
        fs::write(place.path().join("file"), "mine").expect("written");
        for (name, kind) in [
            ("report", io::ErrorKind::NotADirectory),
            ("file", io::ErrorKind::NotADirectory),
            ("none/new", io::ErrorKind::NotFound),
        ] {
            let error = folder_below(place.path(), name).expect_err(name);
            assert_eq!(error.kind(), kind, "{name}");
        }
        for _ in 0..2 {
            let folder = folder_below(place.path(), "new").expect("made, or there");
            assert!(is_folder(&folder));
        }
    }

    #[test]
    fn what_does_not_replace_a_file_leaves_nothing() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("a");
        create(&path, b"1").expect("new");
        let again = create(&path, b"2").expect_err("there");
        assert_eq!(again.kind(), io::ErrorKind::AlreadyExists);
        // A folder is no file.
        fs::create_dir_all(place.path().join("b/c")).expect("a folder");
        assert!(replace(&place.path().join("b"), b"2").is_err());
        assert!(remove(&place.path().join("b")).is_err());
        let lost = replace(&place.path().join("none/a"), b"2").expect_err("no folder");
        assert!(!lost.to_string().contains(PART), "{lost}");
        assert_eq!(fs::read_dir(place.path()).expect("there").count(), 2);
        assert_eq!(fs::read(&path).expect("there"), b"1");
        remove(&path).expect("removed");
        remove(&path).expect("no error");
        let plain = File::create(place.path().join("plain")).expect("new");
        replace(&path, b"3").expect("written");
        let mode = |found: fs::Metadata| found.permissions().mode();
        let ours = mode(fs::metadata(&path).expect("there"));
        assert_eq!(ours, mode(plain.metadata().expect("there")));
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
    fn a_part_names_the_file_that_it_was_about_to_replace() {
        let place = tempfile::tempdir().expect("a folder");
        let part = part_of(&place.path().join("run.csv")).expect("made");
        let name = part.path().file_name().expect("a name");
        assert_eq!(of_part(name.to_str().expect("UTF-8")), Some("run.csv"));
        let random = "0123456789abcdef";
        for (name, of) in [
            (format!("a.b.{random}{PART}"), Some("a.b")),
            (format!("a.{random}"), None),
            (format!(".{random}{PART}"), None),
            (format!("a.{random}0{PART}"), None),
            (format!("a.{}{PART}", &random[1..]), None),
            (format!("a.{}-{PART}", &random[1..]), None),
            (format!("{random}{PART}"), None),
            (PART.to_owned(), None),
        ] {
            assert_eq!(of_part(&name), of, "{name}");
        }
    }

    #[test]
    fn rows_that_another_program_saved_are_named_and_a_mark_is_skipped() {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("run.csv");
        let read = |bytes: &[u8]| {
            fs::write(&path, bytes).expect("written");
            rows(&path).and_then(io::read_to_string)
        };
        assert_eq!(read(b"\xEF\xBB\xBFa,b\n1,2\n").expect("rows"), "a,b\n1,2\n");
        for (bytes, says) in [
            (&b"a;b\n1,5;2\n"[..], "`;`, with a decimal comma"),
            (b"a\tb\n1.5\t2\n", "tabs: a spreadsheet"),
            (b"\xFF\xFEa\0,\0", "UTF-16"),
        ] {
            let error = read(bytes).expect_err(says).to_string();
            assert!(error.contains(says), "{error}");
        }
    }
}
