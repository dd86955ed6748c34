//! Flashing through the `probe-rs` program.

use std::path::PathBuf;
use std::process::Command;

use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::args::FlashArgs;
use crate::cli::failure::Failure;
use crate::cli::screen::Screen;
use crate::identity;

const CHIP: &str = "STM32F411RETx";

/// Where `cargo xtask images` leaves a machine's image.
pub(crate) fn built(machine: DeviceKind) -> PathBuf {
    let name = identity::kind_name(machine);
    PathBuf::from(format!(
        "target/thumbv7em-none-eabihf/firmware/firmware-{name}"
    ))
}

pub(crate) fn flash(args: &FlashArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let name = identity::kind_name(args.machine.into());
    let image = args
        .image
        .clone()
        .unwrap_or_else(|| built(args.machine.into()));
    if !image.is_file() {
        return Err(Failure::Flash {
            why: format!("there is no image at {}", image.display()),
            help: "build the images with `cargo xtask images` in the workspace, or give one with `--image ELF`".to_owned(),
        });
    }
    screen.say(&format!(
        "Flashing {} to the {name}'s board through probe-rs, then resetting it. Nothing moves.",
        image.display()
    ));
    let probe = args
        .probe
        .iter()
        .flat_map(|probe| ["--probe", probe.as_str()])
        .collect::<Vec<_>>();
    let image_text = image.display().to_string();
    probe_rs(&["download", "--chip", CHIP, &image_text], &probe, screen)?;
    probe_rs(&["reset", "--chip", CHIP], &probe, screen)?;
    screen.say("Flashed.");
    Ok(json!({ "image": image_text, "chip": CHIP }))
}

fn probe_rs(args: &[&str], probe: &[&str], screen: &mut Screen<'_>) -> Result<(), Failure> {
    // Its output is captured, so that standard output holds nothing but the JSON object.
    let output = Command::new("probe-rs")
        .args(args)
        .args(probe)
        .output()
        .map_err(|io| Failure::Flash {
            why: format!("probe-rs does not start: {io}"),
            help: "install it: `cargo install probe-rs-tools --locked`".to_owned(),
        })?;
    let text = String::from_utf8_lossy(&output.stderr);
    let _ = screen.err.write_all(&output.stderr);
    if output.status.success() {
        return Ok(());
    }
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    Err(Failure::Flash {
        why: format!(
            "probe-rs {} failed: {}",
            args.first().unwrap_or(&""),
            last.unwrap_or("it gave no reason").trim()
        ),
        help: "is exactly one board plugged in? `probe-rs list` shows the probes, `--probe VID:PID:SERIAL` chooses one".to_owned(),
    })
}
