//! Commands that need no machine: plan, report, completions, man.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use analysis::report::campaign as campaign_report;
use analysis::report::campaign_band::BandSource;
use analysis::report::{self, Existing, figures};
use campaign::catalogue::{self, Wanted};
use campaign::folder::{ORDER, PLAN};
use clap::CommandFactory;
use client::decimal;
use motion::axis::{Axis, MAX_STROKE};
use serde_json::{Value, json};
use trials::plan::{self, REFERENCE_LIMITS, Summary};

use crate::cli::args::{
    CAMPAIGNS_FOLDER, Cli, DATA_FOLDER, ListArgs, OnLinkLoss, PlanArgs, ReportArgs,
};
use crate::cli::failure::Failure;
use crate::cli::model::ModelArgs;
use crate::cli::screen::Screen;

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
    let existing = if args.force {
        Existing::Replace
    } else {
        Existing::Keep
    };
    if let Some(folder) = args.trials.iter().find(|path| is_campaign(path)) {
        return report_campaign(folder, args, existing, screen);
    }
    if args.model.is_some() {
        return Err(Failure::Input {
            why: "--model draws the band of a campaign, and no campaign is named".to_owned(),
            help: "`retrograde report FOLDER --model FILE` with the folder of a campaign"
                .to_owned(),
        });
    }
    let out = args.out.clone().unwrap_or_else(|| "report.html".into());
    let found = report::find(&args.trials)?;
    let report = report::write(&found, &[], &out, existing)?;
    screen.say(&format!(
        "{} trials in {}",
        found.sidecars.len(),
        out.display()
    ));
    for damaged in &report.damaged {
        screen.hint(&format!("damaged: {}", damaged.sidecar.display()));
        for defect in &damaged.defects {
            screen.hint(&format!("  {defect}"));
        }
    }
    for left in &found.left_out {
        screen.hint(&left.to_string());
    }
    let value = json!({
        "trials": found.sidecars,
        "report": out,
        "damaged": report.damaged,
        "left_out": found.left_out,
    });
    let lost = found.left_out.iter().filter(|left| left.is_record).count();
    match (report.damaged.len(), lost) {
        (0, 0) => Ok(value),
        (damaged, lost) => Err(Failure::ReportDefects {
            page: out,
            defects: format!(
                "{damaged} of its trials contradict themselves, and {lost} records are left out"
            ),
            written: value,
        }),
    }
}

pub(crate) fn list(args: &ListArgs, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut folders = args.folders.clone();
    if folders.is_empty() {
        let usual = [CAMPAIGNS_FOLDER, DATA_FOLDER].map(PathBuf::from);
        folders = usual.into_iter().filter(|folder| folder.is_dir()).collect();
    } else if let Some(missing) = folders.iter().find(|folder| !folder.is_dir()) {
        return Err(Failure::Input {
            why: format!("{} is no folder", missing.display()),
            help: "name folders of records or campaigns: `retrograde list DIR`".to_owned(),
        });
    }
    let wanted = Wanted {
        since: args.since,
        until: args.until,
        specimen: args.specimen.clone(),
        outcome: args.outcome.clone(),
    };
    let catalogue = catalogue::list(&folders, args.trials, &wanted);
    if catalogue.entries.is_empty() {
        let places: Vec<_> = folders
            .iter()
            .map(|folder| folder.display().to_string())
            .collect();
        screen.say(&match places.as_slice() {
            [] => format!("There is neither {CAMPAIGNS_FOLDER} nor {DATA_FOLDER} here: `retrograde list DIR` looks elsewhere."),
            places => format!("Nothing of this kind in {}.", places.join(", ")),
        });
    }
    for entry in &catalogue.entries {
        let started = entry.started_utc.map_or_else(
            || "not begun       ".to_owned(),
            |time| time.strftime("%Y-%m-%d %H:%M").to_string(),
        );
        let specimen = entry.specimen.as_deref().map(|text| format!("; {text}"));
        screen.say(&format!(
            "{started}  {:<9}  {:<7}  {}{}\n    {}",
            entry.outcome,
            entry.origin.name(),
            entry.what,
            specimen.unwrap_or_default(),
            entry.path.display()
        ));
    }
    for why in &catalogue.unreadable {
        screen.hint(&format!("unreadable: {why}"));
    }
    Ok(json!(catalogue))
}

/// The plan alone makes no campaign: people keep plans in any folder.
fn is_campaign(path: &Path) -> bool {
    path.join(PLAN).is_file() && path.join(ORDER).is_file()
}

fn report_campaign(
    folder: &Path,
    args: &ReportArgs,
    existing: Existing,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    if args.trials.len() > 1 || args.out.is_some() {
        return Err(Failure::Input {
            why: format!(
                "{} is a campaign: its report is of it alone, and goes to its folder `report`",
                folder.display()
            ),
            help: format!("`retrograde report {}`", folder.display()),
        });
    }
    let file = ModelArgs::of_file(args.model.clone());
    let source = BandSource {
        model: file.model()?,
        posterior: file.posterior()?,
    };
    let written = campaign_report::write(folder, existing, &source)?;
    screen.say(&format!(
        "{} of {} trials count; origin {}",
        written.counted, written.planned, written.origin
    ));
    for file in &written.files {
        screen.say(&format!("  {}", file.display()));
    }
    for finding in &written.findings {
        screen.hint(&format!("not as it was written: {finding}"));
    }
    for (trial, why) in &written.left_out {
        screen.hint(&format!("trial {trial} does not count: {why}"));
    }
    match (written.findings.len(), written.defects) {
        (0, 0) => Ok(json!(written)),
        (findings, defects) => Err(Failure::ReportDefects {
            page: written.page.clone(),
            defects: format!(
                "`verify` has {findings} findings, and the records of {defects} trials cannot be relied on"
            ),
            written: json!(written),
        }),
    }
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
