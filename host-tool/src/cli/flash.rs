//! Flashes through the `probe-rs` program. Examines the image before, and asks the board for its identity afterwards.

use std::path::PathBuf;
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use clap::Args;
use client::address::Address;
use client::door::lock::{Doorway, Lock};
use client::identity::{self, IdentityRecord};
use lab::commissioning::flashing::{self, Image};
use lab::operations::arguments::MachineKind;
use lab::operations::connector::{Candidate, Purpose};
use lab::operations::failure::Failure;
use lab::operations::places::{Need, Places};
use protocol::rig::{GetRigHealth, RigState};
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
    let image = flashing::inspect(&path, kind).map_err(|unfit| {
        Failure::input(
            format!("{} cannot be flashed: {unfit}", path.display()),
            format!(
                "nothing was flashed; `cargo xtask images` in the workspace makes `{}`",
                built(kind).display()
            ),
        )
    })?;
    if !args.dry_run {
        require_rest(kind, places)?;
    }
    let locks = taken(kind, places)?;
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
    drop(locks);
    let identity = ask(kind, &image, places)?;
    screen.say(&format!("Flashed. {}", identity::line(&identity)));
    if identity.profile == BuildProfile::Debug {
        screen.say("warning: this image was built without optimisation; `cargo xtask images` builds the one for use");
    }
    Ok(done(false, Some(&identity)))
}

/// The machine's address, if one was given.
fn named<'a>(kind: DeviceKind, places: &'a Places<'_>) -> Option<&'a Address> {
    places.address(kind).filter(|at| **at != Address::Auto)
}

/// The machine's address, or each of these places where it may be.
fn addresses(
    kind: DeviceKind,
    places: &Places<'_>,
    of_these: impl Fn(&Candidate) -> bool,
) -> Vec<Address> {
    if let Some(address) = named(kind, places) {
        return vec![address.clone()];
    }
    let candidates = places.connector.candidates().into_iter();
    candidates
        .filter(|candidate| candidate.kind.is_none_or(|of| of == kind) && of_these(candidate))
        .map(|candidate| candidate.address)
        .collect()
}

/// Refuses unless the machine is at rest. A machine that cannot be asked is accepted: flashing repairs it. A run may go
/// on although no process owns the line: one that finishes without its host, or the start button's.
fn require_rest(kind: DeviceKind, places: &Places<'_>) -> Result<(), Failure> {
    for address in addresses(kind, places, |candidate| candidate.may_ask) {
        let Some(state) = motion(kind, &address, places) else {
            continue;
        };
        let name = identity::kind_name(kind);
        return Err(Failure::refused(
            format!("the {name} at {address} is not at rest: {state}"),
            format!(
                "nothing was flashed, for that resets the board: wait for the end, or `retrograde stop {name}`"
            ),
        ));
    }
    Ok(())
}

/// The state of the machine there if it is not at rest; `None` also if it cannot be asked, or has an owner.
fn motion(kind: DeviceKind, address: &Address, places: &Places<'_>) -> Option<String> {
    let mut device = places.open(kind, address, Purpose::Look).ok()?;
    // An owner is refused later, by its name.
    if device.owner().is_some() {
        return None;
    }
    device.hello(places.connector.nonce()).ok()?;
    device.require(kind).ok()?;
    match kind {
        DeviceKind::Rig => {
            use RigState::{Faulted, Ready, Unhomed};
            let state = device.rig_status().ok()?.state;
            (!matches!(state, Faulted | Ready | Unhomed)).then(|| format!("{state:?}"))
        }
        DeviceKind::Capsule => {
            let state = device.capsule_status().ok()?.state;
            client::moves(state).then(|| format!("{state:?}"))
        }
    }
}

/// Takes the machine's line, or without an address every line where it may be, so that nobody begins anything
/// meanwhile. Refuses while another process works on one of them: the reset would end its work.
fn taken(kind: DeviceKind, places: &Places<'_>) -> Result<Vec<Lock>, Failure> {
    let named = named(kind, places);
    let addresses = addresses(kind, places, |_| true);
    // Fails if no lock can be made: elsewhere opening the line would report that, and flashing opens none.
    if let Some(address) = named {
        Doorway::of(address)?;
    }
    let mut locks = vec![];
    for doorway in addresses
        .iter()
        .filter_map(|at| places.connector.doorway(at))
    {
        match doorway.claim()? {
            Some(lock) => locks.push(lock),
            None => return Err(at_work(&doorway, named.is_some(), kind)),
        }
    }
    Ok(locks)
}

fn at_work(doorway: &Doorway, is_named: bool, kind: DeviceKind) -> Failure {
    let owner = doorway.owner().map_or_else(
        || "another `retrograde`".to_owned(),
        |owner| owner.to_string(),
    );
    let elsewhere = match is_named {
        true => String::new(),
        false => format!(
            "; if the {0} is another board, say where it is with `--{0}`",
            identity::kind_name(kind)
        ),
    };
    Failure::refused(
        format!("{} belongs to {owner}", doorway.place()),
        format!(
            "nothing was flashed: wait until that process ends, or end it with Ctrl-C in its terminal{elsewhere}"
        ),
    )
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
