//! The manual as a book: pages of HTML to browse and search, which MkDocs makes as `xtask/book` says.

use std::path::PathBuf;
use std::process::Command;

use crate::process::{Failure, Result, root, run, target};
use crate::python;

/// The packages that make the pages. Another version may warn of something else, and a warning is an error.
const PACKAGES: [(&str, &str); 2] = [("mkdocs", "1.6.1"), ("markdown-it-py", "4.3.0")];

/// Builds the book into `target/book`.
pub(crate) fn build() -> Result<()> {
    let python = interpreter().ok_or_else(|| {
        Failure::new(
            "MkDocs cannot be installed here",
            "install Python 3.10 or newer with venv (Debian: `python3-venv`); the first time needs a network",
        )
    })?;
    let book = target().join("book");
    let mut mkdocs = Command::new(python);
    mkdocs
        .current_dir(root())
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .args(["-m", "mkdocs", "build", "--strict", "--config-file"])
        .args(["xtask/book/mkdocs.yml", "--site-dir"])
        .arg(&book);
    run(
        &mut mkdocs,
        "correct the page that is named above; a page belongs into a table of docs/README.md",
    )?;
    let first = book.join("index.html");
    println!("{}", first.strip_prefix(root()).unwrap_or(&first).display());
    Ok(())
}

/// A Python with the packages.
fn interpreter() -> Option<PathBuf> {
    let wanted = PACKAGES.map(|(name, version)| format!("{name}=={version}"));
    let versions = PACKAGES.map(|(name, version)| format!("version('{name}') == '{version}'"));
    let statement = format!(
        "from importlib.metadata import version; assert {}",
        versions.join(" and ")
    );
    python::environment().filter(|python| python::provides(python, &statement, &wanted))
}
