//! Estimates the remaining time of a campaign from the plan and the pace of the last trials.

use crate::campaign::contents::Campaign;
use crate::campaign::ledger::{LedgerEvent, TrialStatus};

/// Assumed time from the end of a run to the start of the next one, before it is measured, s.
const HANDLING_S: f64 = 60.0;

/// A longer pause counts as a break and is ignored, s.
const PAUSE_S: f64 = 900.0;

/// Number of latest pauses used.
const LATEST: usize = 15;

/// Assumed time to clamp the rollers and read the caliper, s.
const CLAMPING_S: f64 = 300.0;

/// The remaining time, s, by the pace of the last trials once there is one.
pub fn remaining_s(campaign: &Campaign) -> f64 {
    let (mut trials, mut moving_s) = (0.0, 0.0);
    let mut blocks = vec![];
    for trial in &campaign.state.trials {
        if matches!(trial.status(), TrialStatus::Open | TrialStatus::UnderWay) {
            trials += 1.0;
            moving_s += campaign.plan.run_s();
            blocks.push(trial.planned.block);
        }
    }
    blocks.dedup();
    // The rollers are already clamped for a block in progress.
    let under_way = campaign.readings.clamped().is_some_and(|set| {
        campaign.state.trials.iter().any(|trial| {
            blocks.first() == Some(&trial.planned.block)
                && trial
                    .attempts
                    .iter()
                    .any(|attempt| attempt.readings_set == Some(set.number))
        })
    });
    let clampings = blocks.len() - usize::from(under_way && !blocks.is_empty());
    let handling = median(pauses_s(campaign)).unwrap_or(HANDLING_S);
    let clamping = CLAMPING_S.min(handling * 5.0);
    moving_s + trials * handling + clampings as f64 * clamping
}

/// The latest pauses between two runs of the same block.
fn pauses_s(campaign: &Campaign) -> Vec<f64> {
    let mut pauses = vec![];
    let mut ended = None;
    for row in &campaign.rows {
        let block = row
            .trial
            .and_then(|trial| campaign.state.trial(trial))
            .map(|trial| trial.planned.block);
        match row.event {
            LedgerEvent::Ended => ended = Some((row.time_utc, block)),
            LedgerEvent::Began => {
                if let Some((before, of)) = ended.take()
                    && of == block
                {
                    pauses.push(row.time_utc.duration_since(before).as_secs_f64());
                }
            }
            _ => {}
        }
    }
    pauses.retain(|pause| (0.0..PAUSE_S).contains(pause));
    pauses.split_off(pauses.len().saturating_sub(LATEST))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

pub fn text(seconds: f64) -> String {
    let minutes = (seconds / 60.0).ceil() as u64;
    match (minutes / 60, minutes % 60) {
        (0, 0..=1) => "about a minute left".to_owned(),
        (0, minutes) => format!("about {minutes} min left"),
        (hours, minutes) => format!("about {hours} h {minutes} min left"),
    }
}
