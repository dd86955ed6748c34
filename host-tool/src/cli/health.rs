//! `health`: the rig's counters.

use client::decimal;
use operations::failure::Failure;
use operations::places::{Need, Places};
use protocol::rig::{self, RigHardware, RigHealth};
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

pub(crate) fn health(places: &Places<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = places.connect(DeviceKind::Rig, Need::Look)?;
    let health = rig.call(rig::GetRigHealth)?;
    let hardware = rig.call(rig::GetRigHardware)?;
    screen.say(&health_text(&health, &hardware));
    Ok(json!({ "health": health, "hardware": hardware }))
}

fn health_text(health: &RigHealth, hardware: &RigHardware) -> String {
    let glitches = |glitches: rig::Glitches| match glitches.count {
        0 => "none".to_owned(),
        count => format!(
            "{count}, the last one {} s after the start, masked {} times",
            decimal::write(glitches.last_us.into(), 6),
            glitches.masked,
        ),
    };
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
        glitches(health.home_flag),
        glitches(health.far_limit),
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
