//! Commands that need no machine: plan, report, completions, man.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use clap::CommandFactory;
use motion::axis::{Axis, MAX_STROKE};
use serde_json::{Value, json};

use crate::cli::args::{Cli, OnLinkLoss, PlanArgs, ReportArgs};
use crate::cli::failure::Failure;
use crate::cli::screen::Screen;
use crate::decimal;
use crate::plan::{self, REFERENCE_LIMITS, Summary};
use crate::report::{self, figures};

pub(crate) fn plan(args: &PlanArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
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
    if let Some(path) = &args.edges {
        write_file(path, |out| plan::write_edges(&plan, out))?;
        screen.say(&format!("edges:         {}", path.display()));
    }
    if let Some(path) = &args.plot {
        let planned = figures::planned(&summary.screw, &run, &summary.achieved);
        let svg = figures::plan_figure(planned)?;
        write_file(path, |out| out.write_all(svg.as_bytes()))?;
        screen.say(&format!("plot:          {}", path.display()));
    }
    Ok(json!({ "plan": summary, "edges": args.edges, "plot": args.plot }))
}

fn write_file(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), Failure> {
    let written = || {
        let mut out = BufWriter::new(File::create(path)?);
        write(&mut out)?;
        out.flush()
    };
    written().map_err(|io| Failure::File {
        path: path.to_owned(),
        io,
    })
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

pub(crate) fn report(args: &ReportArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let sidecars = report::sidecars(&args.trials)?;
    report::write(&sidecars, &[], &args.out)?;
    screen.say(&format!(
        "{} trials in {}",
        sidecars.len(),
        args.out.display()
    ));
    Ok(json!({ "trials": sidecars, "report": args.out }))
}

pub(crate) fn completions(
    shell: clap_complete::Shell,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut script = vec![];
    clap_complete::generate(shell, &mut Cli::command(), "retrograde", &mut script);
    print(&script, "completions", screen)
}

pub(crate) fn man(names: &[String], screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut command = Cli::command();
    command.build();
    let mut page_of = &command;
    for name in names {
        page_of = page_of
            .find_subcommand(name)
            .ok_or_else(|| Failure::Input {
                why: format!("there is no subcommand `{name}`"),
                help: "`retrograde --help` lists them".to_owned(),
            })?;
    }
    let mut page = vec![];
    let failed = |io| Failure::File {
        path: "man".into(),
        io,
    };
    clap_mangen::Man::new(page_of.clone())
        .render(&mut page)
        .map_err(failed)?;
    print(&page, "man", screen)
}

/// Prints text as the result; with `--json` it becomes a field of the object.
fn print(text: &[u8], name: &str, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    if !screen.json {
        screen.out.write_all(text).map_err(|io| Failure::File {
            path: "standard output".into(),
            io,
        })?;
    }
    Ok(json!({ name: String::from_utf8_lossy(text) }))
}
