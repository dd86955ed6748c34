//! Single files that the user names for what a command calculates.

use std::fs::{self, File};
use std::io::{self, BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use client::plain;
use lab::operations::failure::Failure;

/// A single file that the user names. It may be a record by mistake, so an existing one is replaced with `force` only;
/// a terminal or a device is written to.
#[derive(Clone, Copy)]
pub(crate) struct Named<'a> {
    path: &'a Path,
    force: bool,
}

impl<'a> Named<'a> {
    /// Checks the files of a command before its work.
    pub(crate) fn all<const N: usize>(
        paths: [Option<&'a PathBuf>; N],
        force: bool,
    ) -> Result<[Option<Self>; N], Failure> {
        let mut seen: Vec<&Path> = vec![];
        for path in paths.into_iter().flatten() {
            if seen.contains(&path.as_path()) && !is_device(path) {
                return Err(Failure::input(
                    format!("{} is named for two files", path.display()),
                    "name a file of its own for each",
                ));
            }
            if !force && path.exists() && !is_device(path) {
                return Err(exists(path));
            }
            seen.push(path);
        }
        Ok(paths.map(|path| path.map(|path| Self { path, force })))
    }

    pub(crate) fn path(self) -> &'a Path {
        self.path
    }

    /// Writes it: a plain file completely or not at all.
    pub(crate) fn write(
        self,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<(), Failure> {
        let filled = |file: File| {
            let mut out = BufWriter::new(file);
            write(&mut out)?;
            out.flush()
        };
        // Follow a link only if the user allows its target to be replaced.
        let is_link = fs::symlink_metadata(self.path).is_ok() && !plain::is_file(self.path);
        let written = if is_device(self.path) || (self.force && is_link) {
            File::options()
                .write(true)
                .truncate(true)
                .open(self.path)
                .and_then(filled)
        } else {
            plain::part_of(self.path).and_then(|part| {
                filled(part.reopen()?)?;
                match self.force {
                    true => part.persist(self.path)?,
                    false => part.persist_noclobber(self.path)?,
                };
                Ok(())
            })
        };
        written.map_err(|io| match io.kind() {
            ErrorKind::AlreadyExists => exists(self.path),
            _ => Failure::file(self.path)(io),
        })
    }
}

/// Whether the path leads to a terminal, a pipe or a device, such as /dev/stdout: there is nothing to replace.
fn is_device(path: &Path) -> bool {
    fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir())
}

fn exists(path: &Path) -> Failure {
    if path.is_dir() {
        return Failure::file(path)(ErrorKind::IsADirectory);
    }
    Failure::refused(
        format!("{} exists already", path.display()),
        "choose another name, or replace it with `--force`",
    )
}
