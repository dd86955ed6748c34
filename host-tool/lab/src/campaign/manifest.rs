//! `SHA256SUMS`: the hash of every file of a folder, in the format of `sha256sum`, sorted by path, and the differences
//! from it. `sha256sum -c SHA256SUMS` reads it too.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::io::{self, Read};
use std::path::Path;

use client::{limited, plain};

use crate::campaign::CampaignError;
use crate::campaign::files::{LOCK, READINGS, TRIALS};

pub const NAME: &str = "SHA256SUMS";

/// Folder that is not in the manifest: `report` can create it again.
pub const NOT_COVERED: &str = "report";

pub type Hash = [u8; 32];

/// Hashes by path relative to the folder, with `/` as separator.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Manifest(pub BTreeMap<String, Hash>);

pub fn hex(hash: &Hash) -> String {
    hash.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn from_hex(text: &str) -> Option<Hash> {
    let digit = |byte: u8| match byte {
        b'0'..=b'9' => Some(byte - b'0'),
        // Accept lower case only, as written: a file with a changed bit must not read the same.
        b'a'..=b'f' => Some(byte - b'a' + 10),
        _ => None,
    };
    let mut hash = [0; 32];
    let (pairs, rest) = text.as_bytes().as_chunks::<2>();
    if pairs.len() != hash.len() || !rest.is_empty() {
        return None;
    }
    for (byte, [high, low]) in hash.iter_mut().zip(pairs) {
        *byte = digit(*high)? << 4 | digit(*low)?;
    }
    Some(hash)
}

/// Whether a path is valid in a manifest: it names a file and stays within the folder.
fn is_path(path: &str) -> bool {
    let fits = |part: &str| !part.is_empty() && part != "." && part != "..";
    !path.chars().any(|char| char.is_control() || char == '\\') && path.split('/').all(fits)
}

impl Manifest {
    pub fn text(&self) -> String {
        self.0.iter().fold(String::new(), |mut text, (path, hash)| {
            let _ = writeln!(text, "{}  {path}", hex(hash));
            text
        })
    }

    /// Parses a manifest, which must be exactly as [`Manifest::text`] writes it.
    ///
    /// # Errors
    /// The first defect, with the number of the line.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut entries = BTreeMap::new();
        let mut before = None;
        for (number, line) in (1..).zip(text.split_inclusive('\n')) {
            let entry = line
                .strip_suffix('\n')
                .and_then(|line| line.split_once("  "))
                .and_then(|(hash, path)| Some((from_hex(hash)?, path)))
                .filter(|(_, path)| is_path(path));
            let Some((hash, path)) = entry else {
                return Err(format!(
                    "line {number} is not a hash, two spaces and a path"
                ));
            };
            if before.is_some_and(|before| before >= path) {
                return Err(format!("line {number} is not in the order of the paths"));
            }
            before = Some(path);
            entries.insert(path.to_owned(), hash);
        }
        Ok(Self(entries))
    }
}

/// Remedy for a file that was changed.
pub(crate) const COPY: &str = "restore it from a copy";

/// Reads the manifest of a folder; none if the folder has none.
pub fn read(folder: &Path) -> Result<Option<Manifest>, CampaignError> {
    let path = folder.join(NAME);
    let text = match plain::read_text(&path, limited::RECORD) {
        Ok(text) => text,
        Err(io) if io.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(io) => return Err(CampaignError::new(&path, io, COPY)),
    };
    Manifest::parse(&text)
        .map(Some)
        .map_err(|why| CampaignError::new(&path, why, COPY))
}

/// The hash of everything that a reader returns, read piece by piece.
pub(crate) fn hash_of(mut file: impl Read) -> io::Result<hmac_sha256::Hash> {
    let mut hash = hmac_sha256::Hash::new();
    let mut piece = vec![0; 65_536];
    loop {
        let count = file.read(&mut piece)?;
        if count == 0 {
            return Ok(hash);
        }
        hash.update(&piece[..count]);
    }
}

/// The hash of a plain file.
pub fn hash_file(path: &Path) -> io::Result<Hash> {
    let file = plain::open_within(path, plain::TELEMETRY)?;
    Ok(hash_of(file)?.finalize())
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Differences {
    /// Listed files that are missing, changed or unreadable, with the reason.
    pub damaged: BTreeMap<String, String>,
    /// Tables with more lines than when they were listed.
    pub grown: Vec<String>,
    pub added: Vec<String>,
    /// Entries that are neither a file nor a folder.
    pub strange: Vec<String>,
    pub compared: usize,
}

impl Differences {
    pub fn between(folder: &Path, manifest: &Manifest) -> io::Result<Self> {
        let there = contents(folder)?;
        let missing = |path: &String| (path.clone(), "is missing".to_owned());
        let mut differences = Self {
            damaged: manifest.0.keys().map(missing).collect(),
            strange: there.strange,
            ..Self::default()
        };
        for path in there.files {
            differences.damaged.remove(&path);
            let Some(listed) = manifest.0.get(&path) else {
                differences.added.push(path);
                continue;
            };
            differences.compared += 1;
            let full = folder.join(&path);
            let wrong = match hash_file(&full) {
                Ok(hash) if hash == *listed => continue,
                Ok(_) if has_grown(&full, &path, listed) => {
                    differences.grown.push(path);
                    continue;
                }
                Ok(_) => "was changed".to_owned(),
                Err(io) => format!("cannot be read: {io}"),
            };
            differences.damaged.insert(path, wrong);
        }
        Ok(differences)
    }
}

/// Whether a file is a table that has gained lines, or a part of one, since it had this hash.
fn has_grown(full: &Path, path: &str, listed: &Hash) -> bool {
    if ![TRIALS, READINGS].contains(&path) {
        return false;
    }
    let bytes = plain::read(full, limited::RECORD).unwrap_or_default();
    let mut hash = hmac_sha256::Hash::new();
    bytes.split_inclusive(|byte| *byte == b'\n').any(|line| {
        hash.update(line);
        line.ends_with(b"\n") && hash.finalize() == *listed
    })
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Contents {
    /// Paths of all files, except for the manifest and the folder [`NOT_COVERED`].
    pub files: Vec<String>,
    /// Paths of everything that is neither a file nor a folder, such as links, and of names that are not UTF-8.
    pub strange: Vec<String>,
}

/// Lists a folder, with everything below it.
pub fn contents(folder: &Path) -> io::Result<Contents> {
    let mut contents = Contents::default();
    walk(folder, "", &mut contents)?;
    contents.files.sort();
    contents.strange.sort();
    Ok(contents)
}

fn walk(folder: &Path, under: &str, contents: &mut Contents) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let path = format!("{under}{}", name.to_string_lossy());
        let kind = entry.file_type()?;
        if under.is_empty() && path == LOCK && kind.is_file() && entry.metadata()?.len() == 0 {
            continue;
        }
        if under.is_empty()
            && (path == NAME && kind.is_file() || path == NOT_COVERED && kind.is_dir())
        {
            continue;
        }
        if name.to_str().is_none() || !is_path(&path) {
            contents.strange.push(path);
        } else if kind.is_dir() {
            walk(&entry.path(), &format!("{path}/"), contents)?;
        } else if kind.is_file() {
            contents.files.push(path);
        } else {
            contents.strange.push(path);
        }
    }
    Ok(())
}

/// The manifest of a folder as it is now.
pub fn of_folder(folder: &Path) -> io::Result<Manifest> {
    let mut manifest = Manifest::default();
    for path in contents(folder)?.files {
        let hash = hash_file(&folder.join(&path))?;
        manifest.0.insert(path, hash);
    }
    Ok(manifest)
}

/// The hash of a folder's manifest, and thereby of every file in it.
pub fn hash_of_all(folder: &Path) -> io::Result<String> {
    hash_file(&folder.join(NAME)).map(|hash| hex(&hash))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_hash_is_that_of_the_standard() {
        // FIPS 180-2, appendix B.1.
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(hex(&hmac_sha256::Hash::hash(b"abc")), expected);
        assert_eq!(from_hex(expected), Some(hmac_sha256::Hash::hash(b"abc")));
        assert_eq!(from_hex(&expected.to_uppercase()), None);
    }

    proptest! {
        /// Only the exact text is a manifest, so that a changed bit in it cannot mean the same.
        #[test]
        fn a_changed_bit_is_another_manifest_or_none(
            paths in prop::collection::btree_set("[a-z]{1,3}(/[a-z0-9 .-]{0,2}[a-z])?", 1..5),
            place: prop::sample::Index,
            bit in 0_u8..8,
        ) {
            let entries = paths.into_iter().map(|path| {
                let hash = hmac_sha256::Hash::hash(path.as_bytes());
                (path, hash)
            });
            let manifest = Manifest(entries.collect());
            let mut bytes = manifest.text().into_bytes();
            prop_assert_eq!(Manifest::parse(&manifest.text()), Ok(manifest.clone()));
            *place.get_mut(&mut bytes) ^= 1 << bit;
            let changed = String::from_utf8(bytes).ok().and_then(|text| Manifest::parse(&text).ok());
            prop_assert_ne!(changed, Some(manifest));
        }
    }
}
