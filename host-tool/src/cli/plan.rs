//! `plan`: calculates a run without a rig.

use std::path::PathBuf;

use clap::Args;
use client::decimal::{self, Milli};
use lab::operations::arguments::{OnLinkLoss, Waves};
use lab::operations::failure::Failure;
use lab::trials::experiment::DEFAULT_TELEMETRY_MS;
use lab::trials::plan::{self, REFERENCE_LIMITS, Summary};
use motion::axis::{Axis, MAX_STROKE};
use report::figures;
use serde_json::{Value, json};

use crate::cli::calculation::Named;
use crate::cli::failure;
use crate::cli::screen::Screen;

/// Arguments of `plan`.
#[derive(Debug, Args)]
pub struct PlanArgs {
    /// The waves.
    #[command(flatten)]
    pub waves: Waves,
    /// Travel per turn of the screw in mm.
    #[arg(long, value_name = "MM", default_value = "4")]
    pub lead_mm: Milli,
    /// Full steps per turn, 200 or 400.
    #[arg(long, default_value_t = 200)]
    pub full_steps: u16,
    /// Microsteps per full step.
    #[arg(long, default_value_t = 16)]
    pub microsteps: u16,
    /// Write every step edge to this CSV file.
    #[arg(long, value_name = "FILE")]
    pub edges: Option<PathBuf>,
    /// Draw position against time to this SVG file.
    #[arg(long, value_name = "FILE")]
    pub plot: Option<PathBuf>,
    /// Replace existing files.
    #[arg(long)]
    pub force: bool,
}

pub(crate) fn plan(args: &PlanArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let [edges, plot] = Named::all([args.edges.as_deref(), args.plot.as_deref()], args.force)?;
    let run = args.waves.request(OnLinkLoss::Stop);
    let axis = Axis::new(
        args.lead_mm.0,
        args.full_steps,
        args.microsteps,
        MAX_STROKE.0,
    )?;
    let plan = planning::solve(&run, &axis, &REFERENCE_LIMITS)?;
    let summary = plan::summary(&run, &axis, &plan);
    screen.say(&text(&summary));
    if let Err(why) = plan::fits(&run, DEFAULT_TELEMETRY_MS) {
        screen.hint(&format!("telemetry_ms: {why}"));
    }
    if let Some(file) = edges {
        file.write(|out| plan::write_edges(&plan, out))?;
        screen.say(&format!("edges:         {}", file.path().display()));
    }
    if let Some(file) = plot {
        let planned = figures::planned(&summary.screw, &run, &summary.achieved);
        let svg = figures::plan_figure(planned).map_err(failure::figure)?;
        file.write(|out| out.write_all(svg.as_bytes()))?;
        screen.say(&format!("plot:          {}", file.path().display()));
    }
    let shown = |path: &Option<PathBuf>| path.as_ref().map(|path| path.display().to_string());
    Ok(json!({ "plan": summary, "edges": shown(&args.edges), "plot": shown(&args.plot) }))
}

fn text(summary: &Summary) -> String {
    let Summary {
        requested,
        screw,
        achieved,
        ..
    } = summary;
    let (forward, back) = (&achieved.forward, &achieved.back);
    let milli = |value: u32| decimal::write(value.into(), 3);
    let seconds = |ticks: u64| decimal::write(ticks, 8);
    format!(
        "\
cycles:        {} of {} mm ({} mm achieved)
duration:      {} s, a start delay of {} s included
strokes:       {}, {} s out, {} s home
ramps:         {} s out, {} s home
peak speed:    {} mm/s out, {} mm/s home
acceleration:  {} mm/s2 out, {} mm/s2 home
dwell:         {} s at the far end, {} s at home
step rate:     {} Hz at most
edges:         {}, {} per stroke
fingerprint:   {}",
        requested.cycles,
        milli(requested.stroke_um),
        decimal::write_signed(screw.nm(forward.steps.into()), 6),
        seconds(achieved.total_ticks),
        decimal::write(requested.start_delay_us.into(), 6),
        summary.strokes,
        seconds(forward.duration_ticks),
        seconds(back.duration_ticks),
        seconds(forward.ramp_ticks),
        seconds(back.ramp_ticks),
        milli(forward.peak_um_s),
        milli(back.peak_um_s),
        milli(forward.accel_um_s2),
        milli(back.accel_um_s2),
        decimal::write(requested.far_dwell_us.into(), 6),
        decimal::write(requested.home_dwell_us.into(), 6),
        summary.peak_step_hz,
        achieved.edges,
        forward.steps,
        achieved.plan_hash,
    )
}
