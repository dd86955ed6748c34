//! Checks of the board itself, and of EN during a reset.

use client::decimal;
use protocol::rig::{GetRigHardware, RigFault};
use protocol::system::{BrownOut, Clock, DeviceKind, GetChip};

use crate::commissioning::halt::{Halt, fault_text};
use crate::commissioning::operator::Reading;
use crate::commissioning::work::Work;
use crate::commissioning::{device, image};

/// Least voltage at EN with a pull-up of 10 kohm against the driver's own resistor, mV.
const LEAST_ENABLE_MV: i64 = 2_500;
/// Greatest voltage at EN with a pull-up to the board's 3.3 V, mV.
const MOST_ENABLE_MV: i64 = 3_600;
/// Least voltage at EN with a pull-up of 10 kohm to 5 V, mV: 4.5 V against a driver's 100 kohm.
const LEAST_5_V_MV: i64 = 4_200;
/// Greatest voltage that PA9 withstands as an input, mV (DS10314 table 14: FT pins, with no pull of their own).
const MOST_PIN_MV: i64 = 5_500;
/// Allowed difference of the clocks, parts per million. Two quartz clocks differ by less than 100; the rest is for a
/// host whose answers arrive late.
const CLOCK_PPM: i64 = 2_000;

pub(super) fn image_is_the_one(work: &mut Work<'_>) -> Result<(), Halt> {
    let on_board = work.subject.image.clone();
    work.note("image", on_board.clone());
    device::started_well(work)?;
    let Some(file) = work.options.image.clone() else {
        return Err(Halt::NotShown(
            "there is no image file to compare with: `--image ELF`".to_owned(),
        ));
    };
    let unusable =
        |why: &dyn std::fmt::Display| Halt::NotShown(format!("{}: {why}", file.display()));
    let mark = image::mark(&file).map_err(|why| unusable(&why))?;
    if mark.machine != DeviceKind::Rig {
        let file = file.display();
        return Err(Halt::Defect(format!(
            "{file} is the capsule's image: give the rig's"
        )));
    }
    let built = image::fingerprint(&file)
        .map(|hash| format!("{hash:08x}"))
        .map_err(|why| unusable(&why))?;
    work.note("image_file", built.clone());
    if built != on_board {
        return Err(Halt::Defect(format!(
            "stale image: the board has {on_board}, {file} is {built}: `cargo rig` in the workspace flashes it",
            file = file.display()
        )));
    }
    Ok(())
}

pub(super) fn clock(work: &mut Work<'_>) -> Result<(), Halt> {
    let chip = work.device.call(GetChip)?;
    work.note("clock", format!("{:?}", chip.clock).to_lowercase());
    work.note("brown_out", format!("{:?}", chip.brown_out).to_lowercase());
    work.note("option_bytes", format!("{:08x}", chip.option_bytes));
    if chip.clock == Clock::Internal {
        return Err(Halt::Defect(fault_text(RigFault::ClockMissing)));
    }
    if chip.supply_low {
        return Err(Halt::Defect(
            "the board's supply is below 2.7 V: check how it is fed".to_owned(),
        ));
    }
    if chip.brown_out == BrownOut::Off {
        work.say("  note: the brown-out reset is off (option bytes); see docs/silicon.md, item 10");
    }
    device::compare_clocks(work, CLOCK_PPM, |work| Ok(work.status()?.time_us))
}

pub(super) fn enable(work: &mut Work<'_>) -> Result<(), Halt> {
    work.supply(false)?;
    let boot = work.boot_id();
    let mv = work.read(Reading::EnableInReset)?;
    work.find_again()?;
    work.note("enable_in_reset_mv", mv);
    let high = work.device.call(GetRigHardware)?.enable_high_at_start;
    work.note("enable_high_at_start", high);
    if work.boot_id() == boot {
        return Err(Halt::NotShown(
            "the board was not reset, so it drove EN itself".to_owned(),
        ));
    }
    let volts = decimal::write_signed(mv, 3);
    if mv < LEAST_ENABLE_MV {
        return Err(Halt::Defect(format!(
            "EN has no pull-up: {volts} V in reset, so the driver is on while no firmware runs. 10 kohm from D8 to 3.3 V"
        )));
    }
    if !high {
        return Err(Halt::NotShown(format!(
            "the meter shows {volts} V, and the board read EN as low when it started: measure D8, at the board's own socket"
        )));
    }
    let logic = match mv {
        _ if mv <= MOST_ENABLE_MV => "3.3 V",
        LEAST_5_V_MV..=MOST_PIN_MV => "5 V",
        _ if mv < LEAST_5_V_MV => {
            return Err(Halt::Defect(format!(
                "EN is pulled up to {volts} V, between 3.3 V and 5 V: two pull-ups to different supplies. Take one away"
            )));
        }
        _ => {
            return Err(Halt::Defect(format!(
                "EN is pulled up to {volts} V, more than the 5.5 V that the board's pin withstands: take the shield off"
            )));
        }
    };
    work.note("shield_logic", logic);
    if logic == "5 V" {
        work.say(
            "  note: the shield's logic is at 5 V. The board's pin withstands that. A DRV8825",
        );
        work.say(
            "        takes the 3.3 V of STEP and DIR; an A4988 or a TMC2209 may miss steps at",
        );
        work.say("        5 V: docs/build.md, \"A shield at 3.3 V\"");
    }
    Ok(())
}
