//! The command line in this process, without a person at the terminal.

use std::fs;
use std::path::{Path, PathBuf};

use lab::operations::connector::Ports;

use crate::support::tool;

/// An empty folder for the test `name` of the group `group`.
pub fn folder(group: &str, name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR"))
        .join(group)
        .join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).expect("a folder");
    folder
}

/// The text of a path, for an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Exit code, standard output and standard error of `retrograde` with these arguments.
pub fn retrograde(args: &[&str]) -> (u8, String, String) {
    tool::run(&Ports, args)
}
