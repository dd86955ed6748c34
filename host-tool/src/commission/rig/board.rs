//! What the board says of itself, and EN while it says nothing.

use std::path::Path;

use protocol::rig::RigFault;
use protocol::system::{BrownOut, Clock, GetChip, ResetCause};

use crate::commission::hands::Reading;
use crate::commission::image;
use crate::commission::work::{Halt, Work, fault_text};
use crate::decimal;

/// How often the clocks are compared, each time over a longer interval.
const CLOCK_TRIES: u32 = 4;
/// A pull-up of 10 kohm against the driver's own resistor gives more than this, mV.
const LEAST_ENABLE_MV: i64 = 2_500;
/// More than the 3.3 V of the board, mV.
const MOST_ENABLE_MV: i64 = 3_600;
/// Two quartz clocks differ by less than 100; the rest is for a host whose answers come late, parts per million.
const CLOCK_PPM: i64 = 2_000;

pub(super) fn image_is_the_one(work: &mut Work<'_>) -> Result<(), Halt> {
    let Some(identity) = work.device.identity().copied() else {
        return Err(Halt::NotShown(
            "the board did not identify itself".to_owned(),
        ));
    };
    let on_board = work.subject.image.clone();
    work.note("image", on_board.clone());
    work.note("firmware", work.subject.firmware.clone());
    if matches!(
        identity.reset_cause,
        ResetCause::Panic | ResetCause::Watchdog
    ) {
        let words = work.device.last_words()?;
        return Err(Halt::Defect(format!(
            "its last start was a failure: {}. {words}",
            crate::identity::reset_cause(identity.reset_cause)
        )));
    }
    let Some(file) = work.options.image.clone() else {
        return Err(Halt::NotShown(
            "there is no image file to compare with: `--image ELF`".to_owned(),
        ));
    };
    let built = fingerprint(&file)?;
    work.note("image_file", built.clone());
    if built != on_board {
        return Err(Halt::Defect(format!(
            "stale image: the board has {on_board}, {file} is {built}. `cargo rig` in the workspace, or `retrograde flash rig --image {file}`",
            file = file.display()
        )));
    }
    Ok(())
}

fn fingerprint(file: &Path) -> Result<String, Halt> {
    match image::fingerprint(file) {
        Ok(hash) => Ok(format!("{hash:08x}")),
        Err(why) => Err(Halt::NotShown(format!("{}: {why}", file.display()))),
    }
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
    compare_clocks(work, CLOCK_PPM, |work| Ok(work.status()?.time_us))
}

/// Compares the device's clock with that of the link; beyond `limit_ppm` it is wrong.
pub(in crate::commission) fn compare_clocks(
    work: &mut Work<'_>,
    limit_ppm: i64,
    mut device_us: impl FnMut(&mut Work<'_>) -> Result<u64, Halt>,
) -> Result<(), Halt> {
    // The quickest of some answers says best what time it is there: its round trip is the uncertainty.
    let mut pair = |work: &mut Work<'_>| {
        let mut best = (i64::MAX, 0, 0);
        for _ in 0..8 {
            let before = work.device.now_us();
            let there = device_us(work)?;
            let after = work.device.now_us();
            let trip = signed(after - before)?;
            if trip < best.0 {
                best = (trip, signed(before)? + trip / 2, signed(there)?);
            }
        }
        Ok::<_, Halt>(best)
    };
    let first = pair(work)?;
    // A wrong clock goes on being wrong; an answer that was late once matters less and less.
    let mut duration_us = work.options.clock_us;
    for tries_left in (0..CLOCK_TRIES).rev() {
        work.pause(duration_us)?;
        duration_us *= 2;
        let last = pair(work)?;
        let (here, there) = (last.1 - first.1, last.2 - first.2);
        let ppm = |us: i64| us.saturating_mul(1_000_000) / here.max(1);
        let (off, unsure) = (ppm(there - here), ppm((first.0 + last.0) / 2) + 1);
        work.note("compared_us", here);
        work.note("clock_off_ppm", off);
        work.note("uncertain_ppm", unsure);
        if off.abs() <= limit_ppm + unsure {
            return Ok(());
        }
        if tries_left == 0 {
            return Err(Halt::Defect(format!(
                "the board's clock is off by {off} ppm (+-{unsure}) against this computer's"
            )));
        }
    }
    Ok(())
}

fn signed(us: u64) -> Result<i64, Halt> {
    i64::try_from(us).map_err(|_| {
        Halt::Defect(format!(
            "a clock says {us} us, which is no time since a start: 0 to {} is",
            i64::MAX
        ))
    })
}

pub(super) fn enable(work: &mut Work<'_>) -> Result<(), Halt> {
    work.supply(false)?;
    let boot = work.boot_id();
    let mv = work.read(Reading::EnableInReset)?;
    work.find_again()?;
    work.note("enable_in_reset_mv", mv);
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
    if mv > MOST_ENABLE_MV {
        return Err(Halt::Defect(format!(
            "EN is pulled up to {volts} V, more than the board's 3.3 V: 10 kohm from D8 to 3.3 V"
        )));
    }
    Ok(())
}
