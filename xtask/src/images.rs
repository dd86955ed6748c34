//! Builds both ARM images and checks them.

use std::path::PathBuf;
use std::process::Command;

use crate::layout::{Budget, Layout};
use crate::process::{Failure, Result, root, run};
use crate::toolchain::{self, TARGET};

/// An image and the memory it may take.
struct Image {
    name: &'static str,
    budget: Budget,
}

/// Budgets are far below the chip's 512 KiB of flash and 128 KiB of RAM, to leave room for features. The
/// rest of the RAM is stack.
const IMAGES: [Image; 2] = [
    Image {
        name: "firmware-rig",
        budget: Budget {
            flash_bytes: 80 * 1024,
            ram_bytes: 48 * 1024,
        },
    },
    Image {
        name: "firmware-capsule",
        budget: Budget {
            flash_bytes: 64 * 1024,
            ram_bytes: 24 * 1024,
        },
    },
];

/// Builds both images, then [`check`]s them.
///
/// # Errors
/// No compiler, a compile error, or an image that may not be flashed.
pub(crate) fn build() -> Result<()> {
    let toolchain = toolchain::find()?;
    println!("Images: {toolchain}.");
    let mut cargo = toolchain.cargo("build");
    for_both(&mut cargo);
    run(&mut cargo, "fix what the compiler reports above")?;
    check()
}

/// Builds both images and flashes one of them: the same file that the bench tests.
///
/// # Errors
/// As [`build`]; no such machine, no `probe-rs`, or no board.
pub(crate) fn flash(machine: &str) -> Result<()> {
    let path = find(machine)?;
    build()?;
    run(
        Command::new("probe-rs")
            .args(["run", "--chip", "STM32F411RETx"])
            .arg(path),
        "install probe-rs (https://probe.rs), connect the board by USB; `probe-rs list` shows it",
    )
}

/// Path of a machine's image, which may not be built yet.
///
/// # Errors
/// No such machine.
pub(crate) fn find(machine: &str) -> Result<PathBuf> {
    let name = format!("firmware-{machine}");
    match IMAGES.iter().find(|image| image.name == name) {
        Some(image) => Ok(path_of(image)),
        None => Err(Failure::new(
            format!("there is no machine `{machine}`"),
            "it is `rig` or `capsule`",
        )),
    }
}

/// Lints both images as they are compiled for the chip.
///
/// # Errors
/// No compiler, or a warning.
pub(crate) fn lint() -> Result<()> {
    let toolchain = toolchain::find()?;
    let mut cargo = toolchain.cargo("clippy");
    for_both(&mut cargo);
    cargo.args(["--", "-D", "warnings"]);
    run(&mut cargo, "fix what the linter reports above")
}

/// Selects both packages and the workspace's own target folder, where the bench and `probe-rs` look,
/// whatever the caller's environment says.
fn for_both(cargo: &mut Command) {
    for image in &IMAGES {
        cargo.args(["--package", image.name]);
    }
    cargo.arg("--target-dir").arg(root().join("target"));
}

/// Reads both images, prints their sizes and checks layout and budgets.
///
/// # Errors
/// An image is missing, misplaced or over budget; every objection is listed.
pub(crate) fn check() -> Result<()> {
    println!(
        "image                  flash  of budget       RAM  of budget   (bytes; RAM without stack)"
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
            "{:<18} {:>9} {:>10} {:>9} {:>10}",
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
        "addresses come from memory.x and the package's build.rs; for size see `cargo bloat`, or argue \
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
