//! Finds a compiler for the STM32. In this order: the Rust in use, if it has the target; Debian's Rust, if
//! it is already there; rustup, which may add the target; Debian's packages, if they can be downloaded.

use std::fmt;
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

use crate::debian::Debian;
use crate::process::{Failure, Result, first_line, image_cargo, root, run_within};
use crate::version::host_rustc;

/// The Cortex-M4F with hardware floats.
pub(crate) const TARGET: &str = "thumbv7em-none-eabihf";

/// Time limit for rustup: enough for 40 MB on a slow line, not too long behind a firewall that drops packets.
const RUSTUP_LIMIT: Duration = Duration::from_secs(120);

/// A compiler that can build the images.
pub(crate) enum Toolchain {
    /// The Rust in use, which has the target.
    Native,
    /// Debian's Rust, which does not have the target but can build `core` from source.
    Debian(Debian),
}

impl Toolchain {
    /// A cargo command for the target, `build` or `clippy`, complete except for the packages.
    ///
    /// Keeps the names of this machine's folders out of the image. They would be in the message of every panic, take
    /// flash, and make the image differ from machine to machine.
    pub(crate) fn cargo(&self, subcommand: &str) -> Command {
        let mut folders = vec![(root(), "/retrograde")];
        folders.extend(crates().into_iter().map(|folder| (folder, "")));
        let mut command = match self {
            Self::Native => image_cargo(
                std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()),
                subcommand,
            ),
            Self::Debian(debian) => {
                folders.extend(debian.sources().map(|folder| (folder, "/rust")));
                debian.cargo(subcommand)
            }
        };
        let flags: Vec<String> = folders
            .iter()
            .map(|(folder, name)| format!("--remap-path-prefix={}={name}", folder.display()))
            .collect();
        command.env("CARGO_ENCODED_RUSTFLAGS", flags.join("\x1f"));
        command.args(["--target", TARGET, "--profile", "firmware"]);
        command
    }
}

impl fmt::Display for Toolchain {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Native => write!(out, "the Rust in use has the target {TARGET}"),
            Self::Debian(debian) => debian.fmt(out),
        }
    }
}

/// Folders in which cargo keeps the sources of crates.
fn crates() -> Vec<PathBuf> {
    let cargo_home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let sources = cargo_home
        .or_else(|| Some(std::env::home_dir()?.join(".cargo")))
        .unwrap_or_default()
        .join("registry/src");
    // This program was built from these folders. Without them (vendored sources) the texts in the image are longer.
    std::fs::read_dir(sources)
        .map(|folders| folders.flatten().map(|folder| folder.path()).collect())
        .unwrap_or_default()
}

/// Finds a compiler, or installs one if that is possible.
///
/// # Errors
/// There is none and none can be installed; the message lists the attempts.
pub(crate) fn find() -> Result<Toolchain> {
    if native() {
        return Ok(Toolchain::Native);
    }
    if let Some(debian) = Debian::present() {
        return Ok(Toolchain::Debian(debian));
    }
    let by_rustup = match add_target() {
        Ok(()) => return Ok(Toolchain::Native),
        Err(failure) => failure,
    };
    println!("{by_rustup}");
    println!("Falling back on Debian's packages.");
    Debian::fetch().map(Toolchain::Debian).map_err(|by_debian| {
        Failure::new(
            format!("no compiler for {TARGET}.\n  {by_rustup}\n  {by_debian}"),
            format!("install Rust with rustup and run `rustup target add {TARGET}`"),
        )
    })
}

/// Whether the Rust in use has the target's `core`.
fn native() -> bool {
    let mut ask = host_rustc();
    ask.args(["--print", "target-libdir", "--target", TARGET]);
    first_line(&mut ask)
        .and_then(|folder| std::fs::read_dir(folder).ok())
        .is_some_and(|files| {
            files
                .flatten()
                .any(|file| file.file_name().to_string_lossy().starts_with("libcore-"))
        })
}

fn add_target() -> Result<()> {
    let remedy = "check whether this machine can reach static.rust-lang.org";
    // rustup's proxies set this variable for every child. Without it the Rust in use does not come from
    // rustup, and a target added to another toolchain would not help.
    if std::env::var_os("RUSTUP_TOOLCHAIN").is_none() {
        let what = "the Rust in use has no ARM target and does not come from rustup";
        return Err(Failure::new(
            what,
            "nothing to do if Debian's packages can be used",
        ));
    }
    println!("The Rust in use has no ARM target yet; rustup adds it (about 40 MB, once).");
    let mut rustup = Command::new("rustup");
    run_within(RUSTUP_LIMIT, rustup.args(["target", "add", TARGET]), remedy)?;
    if native() {
        Ok(())
    } else {
        let what = "rustup added the target, but the Rust in use does not have it";
        Err(Failure::new(
            what,
            "start `cargo xtask` with rustup's cargo",
        ))
    }
}
