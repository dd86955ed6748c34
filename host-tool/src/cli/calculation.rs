//! Single output files that the user names, for results of a calculation.

use std::io::{self, ErrorKind, Write};
use std::path::Path;

use client::named::{self, is_device};
use lab::operations::failure::Failure;
use lab::operations::output::Stream;

/// A single output file that the user names. It may be a record by mistake, so an existing one is replaced only with
/// `force`; a terminal or a device is written to.
#[derive(Clone, Copy)]
pub(crate) struct Named<'a> {
    path: &'a Path,
    force: bool,
}

impl<'a> Named<'a> {
    /// Checks the files of a command before its work.
    pub(crate) fn all<const N: usize>(
        paths: [Option<&'a Path>; N],
        force: bool,
    ) -> Result<[Option<Self>; N], Failure> {
        let mut seen: Vec<&Path> = vec![];
        for path in paths.into_iter().flatten() {
            if seen.contains(&path) && !is_device(path) {
                return Err(Failure::input(
                    format!("{} is named for two files", path.display()),
                    "name a separate file for each",
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

    /// Writes the file: a plain one completely or not at all.
    pub(crate) fn write(
        self,
        write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<(), Failure> {
        // The file may be standard output, where earlier text has to come first. Its errors are reported at the end.
        let _ = Stream::Out.flush();
        let written = named::write(self.path, self.force, write);
        written.map_err(|io| match io.kind() {
            ErrorKind::AlreadyExists => exists(self.path),
            _ => Failure::file(self.path)(io),
        })
    }
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
