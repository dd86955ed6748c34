//! The compiler's target for the STM32.

use std::path::PathBuf;
use std::process::Command;

use crate::process::{Failure, Result, first_line, image_cargo, root, run};

/// The Cortex-M4F with hardware floats.
pub(crate) const TARGET: &str = "thumbv7em-none-eabihf";

/// Has rustup add the target if the Rust in use lacks it.
///
/// # Errors
/// It is missing and rustup cannot add it.
pub(crate) fn ensure_target() -> Result<()> {
    if has_target() {
        return Ok(());
    }
    let remedy = format!(
        "install Rust with rustup (https://rustup.rs), then `rustup target add {TARGET}`; a Rust from elsewhere needs \
         its package of the target {TARGET}"
    );
    // rustup's proxies set this variable for every child. Without it the Rust in use does not come from rustup, and a
    // target added to another toolchain would not help.
    if std::env::var_os("RUSTUP_TOOLCHAIN").is_some() {
        println!("The Rust in use has no ARM target yet; rustup adds it (about 40 MB, once).");
        run(
            Command::new("rustup").args(["target", "add", TARGET]),
            &remedy,
        )?;
        if has_target() {
            return Ok(());
        }
    }
    Err(Failure::new(
        format!("the Rust in use has no target {TARGET}"),
        remedy,
    ))
}

/// Whether the Rust in use has the target's `core`.
fn has_target() -> bool {
    let mut ask = Command::new("rustc");
    ask.args(["--print", "target-libdir", "--target", TARGET]);
    let folder = first_line(&mut ask).and_then(|folder| std::fs::read_dir(folder).ok());
    folder.is_some_and(|files| {
        files
            .flatten()
            .any(|file| file.file_name().to_string_lossy().starts_with("libcore-"))
    })
}

/// A cargo command for the target, `build` or `clippy`, complete except for the packages.
///
/// Keeps the names of this machine's folders out of the image. They would be in the message of every panic, and make the
/// image differ from machine to machine.
pub(crate) fn cargo(subcommand: &str) -> Command {
    let mut command = image_cargo(subcommand);
    let mut flags = vec![format!(
        "--remap-path-prefix={}=/retrograde",
        root().display()
    )];
    flags.extend(crates().map(|folder| format!("--remap-path-prefix={}=", folder.display())));
    command.env("CARGO_ENCODED_RUSTFLAGS", flags.join("\x1f"));
    command.args(["--target", TARGET, "--profile", "firmware"]);
    command
}

/// Folders in which cargo keeps the sources of crates.
fn crates() -> impl Iterator<Item = PathBuf> {
    let home = std::env::var_os("CARGO_HOME").map(PathBuf::from);
    let home = home.or_else(|| Some(std::env::home_dir()?.join(".cargo")));
    let folders = std::fs::read_dir(home.unwrap_or_default().join("registry/src"));
    folders
        .into_iter()
        .flatten()
        .flatten()
        .map(|folder| folder.path())
}
