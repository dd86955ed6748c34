//! Reads whole files that the user names, up to a size limit: an endless one would take all memory. [`crate::plain`]
//! reads files found in a folder.

use std::io::{self, Read};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use crate::named;

/// Limit for settings and other files that people write by hand, bytes.
pub const BY_HAND: u64 = 64 << 10;

/// Limit for files that this program writes (sidecars, records of commissioning), bytes.
pub const RECORD: u64 = 64 << 20;

/// Limit for an image, bytes: enough for a board of 512 KiB with debug information.
pub const IMAGE: u64 = 256 << 20;

/// Reads a file of at most `limit` bytes.
///
/// # Errors
/// Those of the file, and [`io::ErrorKind::FileTooLarge`].
pub fn read(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let file = named::open_to_read(path)?;
    let bytes = read_from(&file, limit)?;
    if bytes.is_empty() && file.metadata()?.file_type().is_fifo() {
        return Err(named::unattended());
    }
    Ok(bytes)
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

pub(crate) fn text(mut bytes: Vec<u8>) -> io::Result<String> {
    let mark = bytes.len() - utf8(&bytes).map_err(not_text)?.len();
    bytes.drain(..mark);
    String::from_utf8(bytes).map_err(|_| not_text("it is not text"))
}

fn not_text(why: impl Into<String>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, why.into())
}

/// Strips the byte order mark that some editors write.
///
/// # Errors
/// The text is UTF-16.
pub fn utf8(bytes: &[u8]) -> Result<&[u8], &'static str> {
    let text = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    match text {
        [0xFF, 0xFE, ..] | [0xFE, 0xFF, ..] | [1..=255, 0, ..] | [0, 1..=255, ..] => {
            Err("it is UTF-16; save it as UTF-8")
        }
        _ => Ok(text),
    }
}

/// What a spreadsheet has done to a table, judged from its beginning; none if commas separate its columns.
pub fn foreign_table(text: &str) -> Option<String> {
    let header = text.lines().next()?;
    let mut signs = [(';', "`;`"), ('\t', "tabs")].into_iter();
    let (_, by) = signs.find(|(sign, _)| header.contains(*sign))?;
    let in_number = |at: &[u8]| at[0].is_ascii_digit() && at[1] == b',' && at[2].is_ascii_digit();
    let number = match text.as_bytes().windows(3).any(in_number) {
        true => ", with a decimal comma in its numbers",
        false => "",
    };
    Some(format!(
        "its columns are separated by {by}{number}: a spreadsheet has saved it"
    ))
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

    #[test]
    fn a_file_without_an_end_is_refused() {
        assert!(read(Path::new("/dev/zero"), 1_000).is_err());
    }

    #[test]
    fn a_limit_is_named_in_kibibytes() {
        let text = too_large(BY_HAND).to_string();
        assert_eq!(text, "more than 64 KiB, which no such file has");
    }

    #[test]
    fn a_byte_order_mark_is_skipped_and_utf_16_is_named() {
        assert_eq!(text(b"\xEF\xBB\xBF{}".to_vec()).expect("UTF-8"), "{}");
        for bytes in [&b"\xFF\xFE{\0}\0"[..], b"\xFE\xFF\0{\0}", b"{\0}\0"] {
            let error = text(bytes.to_vec()).expect_err("no UTF-8").to_string();
            assert!(error.contains("it is UTF-16; save it as UTF-8"), "{error}");
        }
    }
}
