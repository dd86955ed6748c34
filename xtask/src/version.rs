//! Versions of Rust compilers.

use std::fmt;
use std::process::Command;

use crate::process::first_line;

/// Oldest compiler that builds the workspace: `rust-version` of the root `Cargo.toml`.
pub(crate) const OLDEST: Version = Version(1, 95);

/// A Rust version, major and minor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Version(pub(crate) u32, pub(crate) u32);

impl Version {
    /// The version of a compiler; `None` if it does not run.
    pub(crate) fn of(rustc: &mut Command) -> Option<Self> {
        Self::parse(&first_line(rustc.arg("--version"))?)
    }

    /// Parses `rustc 1.95.0 (...)`.
    fn parse(line: &str) -> Option<Self> {
        let mut numbers = line.split_whitespace().nth(1)?.split('.');
        let mut next = || numbers.next()?.parse().ok();
        Some(Self(next()?, next()?))
    }
}

impl fmt::Display for Version {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}.{}", self.0, self.1)
    }
}

/// The compiler of the Rust in use.
pub(crate) fn host_rustc() -> Command {
    Command::new("rustc")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process::root;

    #[test]
    fn versions_are_read_and_ordered() {
        let read = Version::parse("rustc 1.96.0 (ac68faa20 2026-05-25) (built from a tarball)");
        assert_eq!(read, Some(Version(1, 96)));
        assert!(Version(1, 96) > OLDEST && Version(1, 85) < OLDEST && Version(2, 0) > OLDEST);
        assert_eq!(Version::parse("rustc 1.97.0-nightly"), Some(Version(1, 97)));
        assert_eq!(Version::parse("error: no default toolchain"), None);
    }

    #[test]
    fn the_oldest_compiler_is_the_one_of_the_manifest() {
        let manifest = std::fs::read_to_string(root().join("Cargo.toml")).unwrap();
        assert!(manifest.contains(&format!("rust-version = \"{OLDEST}\"")));
    }
}
