//! `health`: the rig's counters.

use client::decimal;
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use protocol::rig::{self, RigHardware, RigHealth};
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

pub(crate) fn health(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig, LinkPurpose::Observe)?;
    let health = rig.call(rig::GetRigHealth)?;
    let hardware = rig.call(rig::GetRigHardware)?;
    let now_us = rig.rig_status()?.time_us;
    screen.say(&health_text(&health, &hardware, now_us));
    Ok(json!({ "health": health, "hardware": hardware }))
}

/// False pulses of a switch. The rig gives the low 32 bits of the time of the last one, which repeat every 71.6
/// minutes.
fn pulses(glitches: rig::Glitches, now_us: u64) -> String {
    if glitches.count == 0 {
        return "none".to_owned();
    }
    let age_us = (now_us as u32).wrapping_sub(glitches.last_us);
    let again = match now_us > u32::MAX.into() {
        true => ", or a multiple of 71.6 min longer",
        false => "",
    };
    format!(
        "{}, the last one {} s ago{again}, masked {} times",
        glitches.count,
        decimal::write(age_us.into(), 6),
        glitches.masked,
    )
}

fn health_text(health: &RigHealth, hardware: &RigHardware, now_us: u64) -> String {
    format!(
        "\
since the start of the device
false pulses:      home flag {}; far limit {}
serial line:       {} receptions failed, {} bad frames, {} unsent events or samples
step generator:    {} underruns, {} resets of its timer
steps, timed:      {} right, {} off by 10 ns, {} by 20 ns, {} by more; {} captures lost
DMA:               {} errors
stack:             {} of {} bytes
control round:     {} us late at most
image:             {:08x}",
        pulses(health.home_flag, now_us),
        pulses(health.far_limit, now_us),
        health.uart_errors,
        health.bad_frames,
        health.unsent_frames,
        health.underruns,
        hardware.timer_resets,
        hardware.intervals_exact,
        hardware.intervals_1_tick,
        hardware.intervals_2_ticks,
        hardware.intervals_more,
        hardware.lost_captures,
        hardware.dma_errors,
        health.stack_used,
        health.stack_size,
        health.control_late_us,
        health.image_hash,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_age_of_a_false_pulse_survives_the_turn_of_its_counter() {
        let glitches = |last_us| rig::Glitches {
            count: 3,
            last_us,
            masked: 1,
        };
        assert_eq!(
            pulses(glitches(20_000_000), 30_500_000),
            "3, the last one 10.5 s ago, masked 1 times"
        );
        // At 4,420 s, of which the low 32 bits are left.
        assert_eq!(
            pulses(glitches(125_032_704), 4_430_000_000),
            "3, the last one 10 s ago, or a multiple of 71.6 min longer, masked 1 times"
        );
    }
}
