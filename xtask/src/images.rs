//! The ARM images: builds, checks and flashes them.

use std::path::PathBuf;
use std::process::Command;

use object::read::elf::ElfFile32;
use object::{Object as _, ObjectSection as _, SectionFlags, elf};

use crate::process::{Failure, Result, root, run};
use crate::toolchain::{self, TARGET};

/// Name of the chip for `probe-rs`.
const CHIP: &str = "STM32F411RETx";

/// Name of each image's file without `firmware-`: both machines, and the measurements on a board.
const IMAGES: [&str; 3] = ["rig", "capsule", "board"];

/// Address from which the chip reads its vectors.
const VECTORS: u64 = 0x0800_0000;

/// Where RAM begins.
const RAM: u64 = 0x2000_0000;

/// Options that keep `probe-rs run` from halting the core at each reset and processor fault, its default: after the
/// reset button, a panic or the watchdog the machine would not restart.
const KEEP_RESETS: [&str; 2] = ["--no-catch-reset", "--no-catch-hardfault"];

/// Builds all images, checks that each has its vector table where the chip reads it, and prints the sizes. The linker
/// checks regions and budgets: memory.x.
///
/// # Errors
/// No compiler, a compile error, or an image that would not boot.
pub(crate) fn build() -> Result<()> {
    toolchain::ensure_target()?;
    let mut cargo = command("build");
    run(
        &mut cargo,
        "fix what the compiler or linker reports above; the budgets are in memory.x",
    )?;
    println!("image                   flash        RAM   (bytes; RAM without stack)");
    for name in IMAGES {
        let path = find(name)?;
        let wrong =
            |why: String| Failure::new(format!("{}: {why}", path.display()), "see memory.x");
        let file = std::fs::read(&path).map_err(|error| wrong(error.to_string()))?;
        let (flash_bytes, ram_bytes) = sizes(&file).map_err(wrong)?;
        println!("firmware-{name:<12} {flash_bytes:>8} {ram_bytes:>10}");
    }
    Ok(())
}

/// Bytes of flash and RAM that an image takes.
fn sizes(file: &[u8]) -> std::result::Result<(u64, u64), String> {
    let elf = ElfFile32::<object::LittleEndian>::parse(file).map_err(|error| error.to_string())?;
    let table = elf
        .section_by_name(".vector_table")
        .map(|table| table.address());
    if table != Some(VECTORS) {
        return Err(format!(
            "no vector table at {VECTORS:#010x}: the chip would not boot"
        ));
    }
    let (mut flash_bytes, mut ram_bytes) = (0, 0);
    for section in elf.sections() {
        let SectionFlags::Elf { sh_flags, .. } = section.flags() else {
            continue;
        };
        if !sh_flags.contains(elf::SHF_ALLOC) {
            continue;
        }
        if section.file_range().is_some() {
            flash_bytes += section.size();
        }
        if section.address() >= RAM {
            ram_bytes += section.size();
        }
    }
    Ok((flash_bytes, ram_bytes))
}

/// Builds all images and flashes one of them, the same file that the bench tests.
///
/// # Errors
/// As [`build`]; no such machine, no `probe-rs`, or no board.
pub(crate) fn flash(machine: &str) -> Result<()> {
    find(machine)?;
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
    let mut command = Command::new("probe-rs");
    command.args(["run", "--chip", CHIP]).args(KEEP_RESETS);
    command.arg(find(machine)?);
    Ok(command)
}

/// Path of a machine's image, which may not be built yet.
///
/// # Errors
/// No such machine.
pub(crate) fn find(machine: &str) -> Result<PathBuf> {
    if !IMAGES.contains(&machine) {
        return Err(Failure::new(
            format!("there is no machine `{machine}`"),
            "it is `rig`, `capsule`, or `board` for the image of the measurements",
        ));
    }
    let folder = root().join("target").join(TARGET).join("firmware");
    Ok(folder.join(format!("firmware-{machine}")))
}

/// Lints all images as they are compiled for their chips.
///
/// # Errors
/// No compiler, or a warning.
pub(crate) fn lint() -> Result<()> {
    run(
        command("clippy").args(["--", "-D", "warnings"]),
        "fix what clippy reports above",
    )
}

/// Selects the packages, and the workspace's own target folder, which the bench and `probe-rs` use, whatever the
/// caller's environment contains.
fn command(subcommand: &str) -> Command {
    let mut cargo = toolchain::cargo(subcommand);
    cargo.args(["--package", "firmware-rig", "--package", "firmware-capsule"]);
    cargo.arg("--target-dir").arg(root().join("target"));
    cargo
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

    #[test]
    fn a_file_without_a_vector_table_is_refused() {
        let this_program = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        assert!(sizes(&this_program).is_err());
        assert!(sizes(b"MZ, or so").is_err());
    }
}
