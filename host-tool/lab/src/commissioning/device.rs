//! Checks for both machines.

use protocol::system::{Identity, ResetCause};

use crate::commissioning::halt::Halt;
use crate::commissioning::work::Work;

/// Number of clock comparisons, each over a longer interval.
const CLOCK_TRIES: u32 = 4;

/// Requests the identity. A failed previous start is a defect.
pub(super) fn started_well(work: &mut Work<'_>) -> Result<Identity, Halt> {
    let Some(identity) = work.device.identity().copied() else {
        return Err(Halt::NotShown(
            "the board did not identify itself".to_owned(),
        ));
    };
    work.note("firmware", work.subject.firmware.clone());
    if matches!(
        identity.reset_cause,
        ResetCause::Panic | ResetCause::Watchdog
    ) {
        let words = work.device.last_words()?;
        return Err(Halt::Defect(format!(
            "its last start was a failure: {}. {words}",
            client::identity::reset_cause(identity.reset_cause)
        )));
    }
    Ok(identity)
}

/// Compares the device's clock with that of the link. A difference beyond `limit_ppm` is a defect.
pub(super) fn compare_clocks(
    work: &mut Work<'_>,
    limit_ppm: i64,
    mut device_us: impl FnMut(&mut Work<'_>) -> Result<u64, Halt>,
) -> Result<(), Halt> {
    // Take the fastest of some answers: its round trip is the uncertainty of the time.
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
    // A wrong clock stays wrong over longer intervals, while a late answer matters less.
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
            "a clock says {us} us, which is not a time since a start: 0 to {} is",
            i64::MAX
        ))
    })
}
