//! The ARM images: finds, builds, checks and flashes them.

use std::path::PathBuf;
use std::process::Command;

use crate::layout::{Budget, Layout};
use crate::process::{Failure, Result, root, run};
use crate::toolchain::{self, TARGET, Toolchain};

/// Name of the chip for `probe-rs`.
const CHIP: &str = "STM32F411RETx";

/// An image and the memory that it may take.
struct Image {
    name: &'static str,
    budget: Budget,
}

/// Budgets are far below the 512 KiB of flash and 128 KiB of RAM of the STM32F411, to leave room for features. The
/// rest of the RAM is stack.
const IMAGES: [Image; 3] = [
    Image {
        name: "firmware-rig",
        budget: Budget {
            flash_bytes: 80 * 1024,
            ram_bytes: 48 * 1024,
        },
    },
    Image {
        name: "firmware-capsule",
        // A larger flash budget: code is needed to tell a capsule's own changes from a fault, and flash takes no energy
        // from the cell.
        budget: Budget {
            flash_bytes: 96 * 1024,
            ram_bytes: 32 * 1024,
        },
    },
    // Measures what only a board can tell: the rig's motion without its tasks.
    Image {
        name: "firmware-board",
        budget: Budget {
            flash_bytes: 64 * 1024,
            ram_bytes: 48 * 1024,
        },
    },
];

/// Packages of the images.
const PACKAGES: [&str; 4] = ["--package", "firmware-rig", "--package", "firmware-capsule"];

/// Builds all images, then [`check`]s them.
///
/// # Errors
/// No compiler, a compile error, or an image that must not be flashed.
pub(crate) fn build() -> Result<()> {
    let toolchain = toolchain::find()?;
    println!("Images: {toolchain}.");
    let mut cargo = command(&toolchain, "build");
    run(&mut cargo, "fix what the compiler reports above")?;
    check()
}

/// The image of the peers that the bench compares with the firmware. It is never flashed, so nothing checks its layout.
const PEERS: [&str; 2] = ["--package", "step-peers"];

/// Builds the image of the peers, separately: the features that its crates request of shared crates must not get into
/// the firmware.
///
/// # Errors
/// No compiler, or a compile error.
pub(crate) fn build_peers() -> Result<()> {
    let mut cargo = toolchain::find()?.cargo("build");
    cargo
        .args(PEERS)
        .arg("--target-dir")
        .arg(root().join("target"));
    run(&mut cargo, "fix what the compiler reports above")
}

/// Options that let a reset be a reset while the log is open. By default `probe-rs run` halts the core at each reset
/// and processor fault: the reset button, a panic and the watchdog would then leave the machine standing.
const KEEP_RESETS: [&str; 2] = ["--no-catch-reset", "--no-catch-hardfault"];

/// Builds all images and flashes one of them, the same file that the bench tests.
///
/// # Errors
/// As [`build`]; no such machine, no `probe-rs`, or no board.
pub(crate) fn flash(machine: &str) -> Result<()> {
    of(machine)?;
    build()?;
    run(
        &mut log_of(machine)?,
        "install probe-rs 0.28 or later (https://probe.rs), connect the board by USB; `probe-rs list` shows it",
    )
}

/// The command that flashes a machine's image and shows its log.
///
/// # Errors
/// No such machine.
pub(crate) fn log_of(machine: &str) -> Result<Command> {
    let image = of(machine)?;
    let mut command = Command::new("probe-rs");
    command
        .args(["run", "--chip", CHIP])
        .args(KEEP_RESETS)
        .arg(path_of(image));
    Ok(command)
}

/// Path of a machine's image, which may not be built yet.
///
/// # Errors
/// No such machine.
pub(crate) fn find(machine: &str) -> Result<PathBuf> {
    of(machine).map(path_of)
}

fn of(machine: &str) -> Result<&'static Image> {
    let name = format!("firmware-{machine}");
    IMAGES
        .iter()
        .find(|image| image.name == name)
        .ok_or_else(|| {
            Failure::new(
                format!("there is no machine `{machine}`"),
                "it is `rig`, `capsule`, or `board` for the image of the measurements",
            )
        })
}

/// Lints all images as they are compiled for their chips.
///
/// # Errors
/// No compiler, or a warning.
pub(crate) fn lint() -> Result<()> {
    let toolchain = toolchain::find()?;
    let mut cargo = command(&toolchain, "clippy");
    cargo.args(PEERS).args(["--", "-D", "warnings"]);
    run(&mut cargo, "fix what the linter reports above")
}

/// Selects what is built, and the workspace's own target folder, where the bench and `probe-rs` look,
/// whatever the caller's environment says.
fn command(toolchain: &Toolchain, subcommand: &str) -> Command {
    let mut cargo = toolchain.cargo(subcommand);
    cargo.args(PACKAGES);
    cargo.arg("--target-dir").arg(root().join("target"));
    cargo
}

/// Reads all images, prints their sizes and checks layout and budgets.
///
/// # Errors
/// An image is missing, misplaced or over budget; every objection is listed.
pub(crate) fn check() -> Result<()> {
    println!(
        "image                             flash  of budget       RAM  of budget   (bytes; RAM without stack)"
    );
    let mut objections = Vec::new();
    for image in &IMAGES {
        let path = path_of(image);
        let file = std::fs::read(&path).map_err(|error| {
            let what = format!("{} cannot be read: {error}", path.display());
            Failure::new(what, "build it with `cargo xtask images`")
        })?;
        let layout = match Layout::read(&file) {
            Ok(layout) => layout,
            Err(reason) => {
                objections.push(format!("{}: {reason}", image.name));
                continue;
            }
        };
        let Budget {
            flash_bytes,
            ram_bytes,
        } = image.budget;
        println!(
            "{:<29} {:>9} {:>10} {:>9} {:>10}",
            image.name, layout.flash_bytes, flash_bytes, layout.ram_bytes, ram_bytes
        );
        let found = layout.objections(image.budget);
        objections.extend(found.iter().map(|text| format!("{}: {text}", image.name)));
    }
    if objections.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        objections.join("\n       "),
        "addresses come from memory.x and device/link_arguments.rs; for size see `cargo bloat`, or argue \
         for a new budget in xtask/src/images.rs",
    ))
}

fn path_of(image: &Image) -> PathBuf {
    root()
        .join("target")
        .join(TARGET)
        .join("firmware")
        .join(image.name)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `cargo run` on an image has to flash it with the same options.
    #[test]
    fn the_runner_keeps_resets_too() {
        let config = include_str!("../../.cargo/config.toml");
        let runner = config.lines().find(|line| line.starts_with("runner"));
        let runner = runner.expect("a runner for the images");
        for flag in KEEP_RESETS {
            assert!(runner.contains(flag), "{runner} lacks {flag}");
        }
    }
}
