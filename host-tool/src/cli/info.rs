//! `info`: identity, state and last fault of the machines.

use client::identity::{self, IdentityRecord};
use client::{decimal, matches, visible};
use lab::commissioning::image;
use lab::operations::arguments::Which;
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::operations::panel::{in_run, run_text};
use protocol::capsule::{CapsuleCalibration, CapsuleState, CapsuleStatus, GetCapsuleTotals};
use protocol::rig::RigStatus;
use protocol::system::{BrownOut, Chip, Clock, DeviceKind, GetChip};
use serde_json::{Map, Value, json};

use crate::cli::screen::Screen;

pub(crate) fn info(
    which: &Which,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut all = Map::new();
    for kind in finder.machines(which)? {
        let mut device = finder.greet(kind, LinkPurpose::Observe)?;
        let Some(identity) = device.identity().copied() else {
            continue;
        };
        screen.say(&format!(
            "{}: {}",
            device.place(),
            identity::line(&identity)
        ));
        if let Some(flash) = image::to_flash(&identity) {
            screen.say(&format!("  {flash}"));
        }
        let last_words = device.last_words()?;
        if !last_words.is_empty() {
            screen.say(&format!("  last words: {}", visible::line(&last_words)));
        }
        let finder = addresses(&last_words);
        if !finder.is_empty() {
            screen.say(&format!(
                "  places in the source: `cargo xtask where {} {}`, built from this firmware's commit",
                identity::kind_name(kind),
                finder.join(" ")
            ));
        }
        let mut calibration = Value::Null;
        let status = if !matches(&identity) {
            screen.say(&format!(
                "  {}",
                device
                    .require(kind)
                    .err()
                    .map(|error| error.to_string())
                    .unwrap_or_default()
            ));
            Value::Null
        } else if kind == DeviceKind::Rig {
            let status = device.rig_status()?;
            screen.say(&rig_text(&status));
            json!(status)
        } else {
            let status = device.capsule_status()?;
            screen.say(&capsule_text(&status));
            let found = device.call(GetCapsuleTotals)?.calibration;
            screen.say(&calibration_text(found.as_ref()));
            if let Some(next) = way_out(&status, found.is_some()) {
                screen.say(&format!("  next: {next}"));
            }
            calibration = json!(found);
            json!(status)
        };
        let chip = match matches(&identity) {
            true => {
                let chip = device.call(GetChip)?;
                screen.say(&chip_text(&chip));
                json!(chip)
            }
            false => Value::Null,
        };
        all.insert(
            identity::kind_name(kind).to_owned(),
            json!({
                "place": device.place(),
                "identity": IdentityRecord::new(&identity, &device.place()),
                "last_words": last_words,
                "status": status,
                "calibration": calibration,
                "chip": chip,
            }),
        );
    }
    Ok(Value::Object(all))
}

/// The addresses in a machine's last words. The proposed command contains nothing else of these: a user who pastes it
/// would otherwise execute the machine's text.
fn addresses(last_words: &str) -> Vec<String> {
    let words = last_words.split(|c: char| !c.is_ascii_alphanumeric());
    let digits = words.filter_map(|word| word.strip_prefix("0x"));
    let values = digits.filter_map(|digits| u32::from_str_radix(digits, 16).ok());
    values.map(|value| format!("0x{value:08x}")).collect()
}

/// Clock, supply and option bytes in one line.
fn chip_text(chip: &Chip) -> String {
    format!(
        "  clock: {}; supply {} 2.7 V; brown-out {}, option bytes {:08x}",
        match chip.clock {
            Clock::External => "8 MHz from the board",
            Clock::Internal => "the chip's own, 1 %",
        },
        if chip.supply_low { "below" } else { "above" },
        match chip.brown_out {
            BrownOut::Off => "off",
            BrownOut::Level1 => "level 1",
            BrownOut::Level2 => "level 2",
            BrownOut::Level3 => "level 3",
        },
        chip.option_bytes,
    )
}

fn rig_text(status: &RigStatus) -> String {
    let open = |open: bool| if open { "open" } else { "closed" };
    let mut text = format!(
        "  {:?}, {}, at {} mm ({} steps); stroke {} mm, lead {} mm, {} steps per turn{}\n  home flag {}, far limit {}, E-stop loop {}",
        status.state,
        if status.homed { "homed" } else { "not homed" },
        decimal::write_signed(status.position_um.into(), 3),
        status.position_steps,
        decimal::write(status.stroke_um.into(), 3),
        decimal::write(status.lead_um.into(), 3),
        status.steps_per_rev,
        match in_run(status) {
            true => format!("\n  {}", run_text(status)),
            false => String::new(),
        },
        open(status.inputs.home_flag),
        open(status.inputs.far_limit),
        open(status.inputs.estop_loop),
    );
    if let Some(fault) = status.fault {
        text.push_str(&format!("\n  fault: {fault}"));
    }
    text
}

fn capsule_text(status: &CapsuleStatus) -> String {
    let mut text = format!(
        "  {:?}, {}, {} mm of thread wound{}, {} mA, battery {} V",
        status.state,
        if status.referenced {
            "referenced"
        } else {
            "not referenced"
        },
        decimal::write_signed(status.thread_um.into(), 3),
        match status.uncertainty_um {
            Some(0) => String::new(),
            Some(um) => format!(" and up to {} mm more", decimal::write(um.into(), 3)),
            None => ", or any other length".to_owned(),
        },
        status.current_ma,
        decimal::write(status.battery_mv.into(), 3),
    );
    if status.remaining_um > 0 {
        let left_mm = decimal::write(status.remaining_um.into(), 3);
        text.push_str(&format!(
            "\n  {left_mm} mm of thread stay on the spool when it unfolds"
        ));
    }
    if let Some(fault) = status.fault {
        text.push_str(&format!("\n  fault: {fault}"));
    }
    text
}

/// Lost thread that only an operator can find, um, and thread on the spool that matters, um.
const LOST_UM: u32 = 3_000;
const LEFT_UM: u32 = 300;

/// The command to use next, as in the table "The way out" of docs/capsule.md.
fn way_out(status: &CapsuleStatus, is_calibrated: bool) -> Option<&'static str> {
    let is_lost = status.uncertainty_um.is_none_or(|um| um > LOST_UM);
    match status.state {
        CapsuleState::Faulted => Some("`retrograde ack capsule`, once the cause is removed"),
        CapsuleState::Unreferenced if !is_calibrated && !is_lost && status.thread_um > 1_000 => {
            Some("`retrograde unfold` instead of a hand: it knows what it has wound")
        }
        CapsuleState::Unreferenced if !is_calibrated => None,
        CapsuleState::Unreferenced if is_lost => {
            Some("unfold it by hand, then `retrograde capsule calibrate`")
        }
        CapsuleState::Unreferenced => Some("`retrograde capsule reference`"),
        CapsuleState::Unfolded if status.remaining_um > LEFT_UM => Some(
            "to fold and unfold whole again: unfold it by hand, then `retrograde capsule calibrate`",
        ),
        _ => None,
    }
}

/// Line about the calibration, which decides how an unknown position is resolved.
fn calibration_text(calibration: Option<&CapsuleCalibration>) -> String {
    calibration.map_or_else(
        || "  not calibrated: unfold it by hand, then `retrograde capsule calibrate`".to_owned(),
        |found| {
            let folded_mm = decimal::write_signed(found.folded_um.into(), 3);
            format!("  calibrated: {folded_mm} mm of thread to the folded end")
        },
    )
}

#[cfg(test)]
mod tests {
    use super::{addresses, rig_text, way_out};
    use protocol::capsule::CapsuleState;
    use protocol::rig::{RigInputs, RigState, RigStatus};

    #[test]
    fn a_rig_in_a_run_tells_which_and_how_far() {
        let status = |state| RigStatus {
            time_us: 60_000_000,
            state,
            fault: None,
            homed: true,
            position_steps: 8_000,
            position_um: 10_000,
            stroke_um: 130_000,
            steps_per_rev: 3_200,
            lead_um: 4_000,
            inputs: RigInputs {
                home_flag: false,
                far_limit: false,
                estop_loop: false,
            },
            run: 7,
            stroke: 3,
            strokes: 10,
            elapsed_us: 14_600_000,
            needs_acknowledge: false,
        };
        for (state, is_told) in [
            (RigState::Running, true),
            (RigState::Held, true),
            (RigState::Ready, false),
        ] {
            let text = rig_text(&status(state));
            assert_eq!(
                text.contains("run 7, stroke 4 of 10, 14.6 s\n"),
                is_told,
                "{text}"
            );
        }
    }

    #[test]
    fn a_capsule_that_cannot_fold_is_told_its_next_command() {
        use CapsuleState::{Faulted, Unfolded, Unreferenced};
        use protocol::capsule::CapsuleStatus;
        for (state, is_calibrated, uncertainty_um, remaining_um, next) in [
            (Faulted, true, Some(0), 0, "`retrograde ack capsule`"),
            (
                Unreferenced,
                true,
                Some(2_300),
                0,
                "`retrograde capsule reference`",
            ),
            (Unreferenced, true, Some(3_001), 0, "unfold it by hand"),
            (Unreferenced, true, None, 0, "unfold it by hand"),
            (Unreferenced, false, Some(0), 0, "`retrograde unfold`"),
            // The line before says what a hand has to do.
            (Unreferenced, false, None, 0, ""),
            (Unfolded, true, Some(0), 300, ""),
            (
                Unfolded,
                true,
                Some(0),
                301,
                "to fold and unfold whole again",
            ),
        ] {
            let status = CapsuleStatus {
                time_us: 0,
                state,
                fault: None,
                referenced: false,
                thread_um: 9_000,
                uncertainty_um,
                remaining_um,
                current_ma: 0,
                battery_mv: 3_700,
                actuation: 1,
                needs_acknowledge: false,
            };
            let next_step = way_out(&status, is_calibrated).unwrap_or_default();
            assert!(
                next_step.starts_with(next) && (next_step.is_empty() == next.is_empty()),
                "{state:?}: {next_step}"
            );
        }
    }

    #[test]
    fn only_addresses_of_the_last_words_are_part_of_a_command() {
        let words =
            "panic; called from 0x080012ab 0x8001f3c `rm -r x`; $(0xzz) 0x123456789 \u{1b}[2J";
        assert_eq!(addresses(words), ["0x080012ab", "0x08001f3c"]);
        assert!(addresses("watchdog").is_empty());
    }
}
