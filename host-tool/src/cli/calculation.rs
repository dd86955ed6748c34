//! Shared by the commands that calculate: threads with a progress bar, and the files in one folder.

use std::fs;
use std::path::{Path, PathBuf};

use analysis::science::series::Workers;
use analysis::science::table;
use indicatif::{ProgressBar, ProgressStyle};
use locomotion::range::OutOfRange;
use operations::failure::Failure;
use serde::Serialize;

use crate::cli::screen::Screen;

/// The calculation of one command.
pub(crate) struct Calculation<'a, 'b> {
    out: &'a Path,
    workers: Workers,
    pub(crate) screen: &'a mut Screen<'b>,
    files: Vec<PathBuf>,
}

impl<'a, 'b> Calculation<'a, 'b> {
    /// Uses this number of threads, by default one per core, and writes its files to `out`.
    pub(crate) fn new(
        out: &'a Path,
        threads: Option<u16>,
        screen: &'a mut Screen<'b>,
    ) -> Result<Self, Failure> {
        let workers = Workers::new(threads).map_err(|error| Failure::Input {
            why: format!("no threads: {error}"),
            help: "use fewer: `--threads 1`".to_owned(),
        })?;
        Ok(Self {
            out,
            workers,
            screen,
            files: vec![],
        })
    }

    /// Calculates all cases in parallel, with a progress bar on a terminal.
    pub(crate) fn map<T: Sync, R: Send>(
        &self,
        cases: &[T],
        work: impl Fn(&T) -> Result<R, OutOfRange> + Sync,
    ) -> Result<Vec<R>, Failure> {
        let bar = if self.screen.terminal {
            ProgressBar::new(cases.len() as u64)
        } else {
            ProgressBar::hidden()
        };
        if let Ok(style) =
            ProgressStyle::with_template("  {bar:30} {pos} of {len} runs, {eta} left")
        {
            bar.set_style(style);
        }
        let results = self.workers.map(cases, &|| bar.inc(1), work);
        bar.finish_and_clear();
        Ok(results?)
    }

    /// Runs the work on the calculation's threads.
    pub(crate) fn install<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        self.workers.install(work)
    }

    /// Writes rows; the last column is the origin of their values.
    pub(crate) fn csv(
        &mut self,
        name: &str,
        rows: &[impl Serialize],
        origin: &str,
    ) -> Result<(), Failure> {
        let bytes = table::csv_of(rows, origin).map_err(|error| Failure::File {
            path: self.out.join(name),
            io: error.into(),
        })?;
        self.file(name, &bytes)
    }

    /// Writes one file and creates the folder if necessary.
    pub(crate) fn file(&mut self, name: &str, bytes: &[u8]) -> Result<(), Failure> {
        let path = self.out.join(name);
        fs::create_dir_all(self.out).map_err(|io| Failure::File {
            path: self.out.to_owned(),
            io,
        })?;
        write(&path, bytes)?;
        self.files.push(path);
        Ok(())
    }

    /// Prints which files were written. Returns their paths.
    pub(crate) fn say_files(&mut self) -> Vec<String> {
        let files: Vec<_> = self
            .files
            .iter()
            .map(|path| path.display().to_string())
            .collect();
        self.screen.say(&format!("files: {}", files.join(", ")));
        files
    }
}

/// Writes a file, replacing an existing one.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    fs::write(path, bytes).map_err(|io| Failure::File {
        path: path.to_owned(),
        io,
    })
}
