//! Reads whole files that the user names, up to a size limit: an endless one would take all memory. Files that are
//! found in a folder are read by [`crate::plain`].

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// Limit for settings and other files that people write by hand, bytes.
pub const BY_HAND: u64 = 64 << 10;

/// Limit for files that this program writes for itself (sidecars, records of commissioning), bytes.
pub const RECORD: u64 = 64 << 20;

/// Limit for an image, bytes: enough for a board of 512 KiB with debug information.
pub const IMAGE: u64 = 256 << 20;

/// Reads a file of at most `limit` bytes.
///
/// # Errors
/// Those of the file, and [`io::ErrorKind::FileTooLarge`].
pub fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    read_from(File::open(path)?, limit)
}

pub(crate) fn read_from(file: impl Read, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = vec![];
    // Read one byte more than allowed, to detect a larger file.
    file.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        return Err(too_large(limit));
    }
    Ok(bytes)
}

pub(crate) fn too_large(limit: u64) -> io::Error {
    let kib = limit >> 10;
    let why = format!("more than {kib} KiB, which no such file has");
    io::Error::new(io::ErrorKind::FileTooLarge, why)
}

pub(crate) fn text(bytes: Vec<u8>) -> io::Result<String> {
    String::from_utf8(bytes)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not text"))
}

/// Like [`read`], for text.
///
/// # Errors
/// As [`read`], and [`io::ErrorKind::InvalidData`] if it is not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    text(read(path, limit)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_at_its_limit_is_read_and_one_beyond_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("file");
        std::fs::write(&path, "123").expect("written");
        assert_eq!(read_text(&path, 3).expect("short enough"), "123");
        let error = read_text(&path, 2).expect_err("too long");
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
    }

    #[cfg(unix)]
    #[test]
    fn a_file_without_an_end_is_refused() {
        assert!(read(Path::new("/dev/zero"), 1_000).is_err());
    }

    #[test]
    fn a_limit_is_named_in_kibibytes() {
        let text = too_large(BY_HAND).to_string();
        assert_eq!(text, "more than 64 KiB, which no such file has");
    }
}
