//! Flashes through the `probe-rs` program. Examines the image before, and asks the board for its identity afterwards.

use std::path::PathBuf;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use client::door::lock::Doorway;
use client::identity::{self, IdentityRecord};
use commissioning::flashing::{self, Image};
use operations::arguments::MachineKind;
use operations::failure::Failure;
use operations::places::{Need, Places};
use protocol::rig::GetRigHealth;
use protocol::system::{BuildProfile, DeviceKind, Identity};
use serde_json::{Value, json};

use crate::cli::failure::Own;
use crate::cli::screen::Screen;

/// Arguments of `flash`.
#[derive(Debug, Args)]
pub struct FlashArgs {
    /// The machine.
    pub machine: MachineKind,
    /// The image (ELF); by default the one built in this workspace.
    #[arg(long, value_name = "ELF")]
    pub image: Option<PathBuf>,
    /// The debug probe, `VID:PID:SERIAL`, if several are connected.
    #[arg(long, value_name = "PROBE")]
    pub probe: Option<String>,
    /// Only look at the image; needs no probe and no board.
    #[arg(long)]
    pub dry_run: bool,
}

const CHIP: &str = "STM32F411RETx";

/// Time for a board to answer after its reset.
const START: Duration = Duration::from_secs(3);

/// Interval between two attempts to reach the board.
const AGAIN: Duration = Duration::from_millis(100);

/// Where `cargo xtask images` leaves a machine's image.
pub(crate) fn built(machine: DeviceKind) -> PathBuf {
    let name = identity::kind_name(machine);
    PathBuf::from(format!(
        "target/thumbv7em-none-eabihf/firmware/firmware-{name}"
    ))
}

pub(crate) fn flash(
    args: &FlashArgs,
    places: &Places<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let kind = args.machine.into();
    let name = identity::kind_name(kind);
    let path = args.image.clone().unwrap_or_else(|| built(kind));
    if !path.exists() {
        return Err(Own::Flash {
            why: format!("there is no image at {}", path.display()),
            help: "build the images with `cargo xtask images` in the workspace, or give one with `--image ELF`".to_owned(),
        }.into());
    }
    let image = flashing::inspect(&path, kind).map_err(|unfit| Failure::Input {
        why: format!("{} cannot be flashed: {unfit}", path.display()),
        help: format!(
            "nothing was flashed; `cargo xtask images` in the workspace makes `{}`",
            built(kind).display()
        ),
    })?;
    leave_alone(kind, places)?;
    screen.say(&format!(
        "{}: image of the {name}, {} bytes of flash, fingerprint {:08x}. It leaves settings, name and calibration as they are.",
        path.display(),
        image.bytes,
        image.fingerprint
    ));
    let text = path.display().to_string();
    let done = |dry_run: bool, identity: Option<&Identity>| {
        json!({
            "image": text,
            "chip": CHIP,
            "bytes": image.bytes,
            "fingerprint": format!("{:08x}", image.fingerprint),
            "dry_run": dry_run,
            "identity": identity.map(|identity| IdentityRecord::new(identity, "")),
        })
    };
    if args.dry_run {
        screen.say("Nothing was flashed: a dry run.");
        return Ok(done(true, None));
    }
    screen.say(&format!(
        "Flashing it to the {name}'s board through probe-rs, then resetting it. Nothing moves."
    ));
    let probe = args
        .probe
        .iter()
        .flat_map(|probe| ["--probe", probe.as_str()])
        .collect::<Vec<_>>();
    probe_rs(&["download", "--chip", CHIP, &text], &probe, screen)?;
    probe_rs(&["reset", "--chip", CHIP], &probe, screen)?;
    let identity = ask(kind, &image, places)?;
    screen.say(&format!("Flashed. {}", identity::line(&identity)));
    if identity.profile == BuildProfile::Debug {
        screen.say("warning: this image was built without optimisation; `cargo xtask images` builds the one for use");
    }
    Ok(done(false, Some(&identity)))
}

/// Refuses while another process works with the machine: a reset would end what it does.
fn leave_alone(kind: DeviceKind, places: &Places<'_>) -> Result<(), Failure> {
    let Some(address) = places.address(kind) else {
        return Ok(());
    };
    let Some(doorway) = Doorway::of(address)? else {
        return Ok(());
    };
    if doorway.claim()?.is_some() {
        return Ok(());
    }
    let owner = doorway.owner().map_or_else(
        || "another `retrograde`".to_owned(),
        |owner| owner.to_string(),
    );
    Err(Failure::Refused {
        why: format!("{} belongs to {owner}", doorway.place()),
        help: "nothing was flashed: wait until that process ends, or end it with Ctrl-C in its terminal".to_owned(),
    })
}

/// Asks the board for its identity.
fn ask(kind: DeviceKind, image: &Image, places: &Places<'_>) -> Result<Identity, Failure> {
    let begin = Instant::now();
    loop {
        let found = places.connect(kind, Need::Look).and_then(|mut device| {
            let running = match kind {
                DeviceKind::Rig => Some(device.call(GetRigHealth)?.image_hash),
                DeviceKind::Capsule => None,
            };
            Ok((device.identity().copied(), running))
        });
        match found {
            Ok((Some(identity), None)) => return Ok(identity),
            Ok((Some(identity), Some(running))) if running == image.fingerprint => {
                return Ok(identity);
            }
            Ok((_, running)) => {
                return Err(Own::Flash {
                    why: format!(
                        "probe-rs has flashed a board, but the machine here runs image {:08x}, not {:08x}",
                        running.unwrap_or_default(),
                        image.fingerprint
                    ),
                    help: "was it another board? `probe-rs list` shows the probes, `retrograde devices` the machines".to_owned(),
                }.into());
            }
            Err(_) if begin.elapsed() < START => thread::sleep(AGAIN),
            Err(failure) => {
                return Err(Own::Flash {
                    why: format!("flashed and reset, but the board was not found again: {failure}"),
                    help: "look at its LED, then at `retrograde devices`; say where it is with `--rig` or `--capsule`".to_owned(),
                }.into());
            }
        }
    }
}

fn probe_rs(args: &[&str], probe: &[&str], screen: &mut Screen<'_>) -> Result<(), Failure> {
    // Capture the output, so that standard output holds only the JSON object.
    let output = Command::new("probe-rs")
        .args(args)
        .args(probe)
        .output()
        .map_err(|io| Own::Flash {
            why: format!("probe-rs does not start: {io}"),
            help: "install it: `cargo install probe-rs-tools --locked`".to_owned(),
        })?;
    let text = String::from_utf8_lossy(&output.stderr);
    if !text.trim().is_empty() {
        screen.hint(text.trim_end());
    }
    if output.status.success() {
        return Ok(());
    }
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    Err(Own::Flash {
        why: format!(
            "probe-rs {} failed: {}",
            args.first().unwrap_or(&""),
            last.unwrap_or("it gave no reason").trim()
        ),
        help: "is exactly one board plugged in? `probe-rs list` shows the probes, `--probe VID:PID:SERIAL` chooses one".to_owned(),
    }.into())
}
