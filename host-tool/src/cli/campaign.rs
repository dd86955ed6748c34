//! `campaign` and `verify`: a plan of trials, carried out with a person at the terminal or on the virtual bench.

mod prompter;

use std::path::{Path, PathBuf};

use clap::Args;
use client::identity::Origin;
use client::limited;
use client::named;
use client::wording::word;
use lab::campaign::conduct::{Broken, Conduct, Ending, Machines};
use lab::campaign::contents::Campaign;
use lab::campaign::folder::Folder;
use lab::campaign::ledger::{LedgerEvent, LedgerRow, Source, TrialState, TrialStatus};
use lab::campaign::plan::{CampaignPlan, Millimetres};
use lab::campaign::readings::Summary;
use lab::campaign::remaining::{remaining_s, text as time_text};
use lab::campaign::{make_room, resumption};
use lab::commissioning::warning;
use lab::operations::arguments::{CAMPAIGNS_FOLDER, DATA_FOLDER};
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::trials::experiment::ExperimentError;
use lab::trials::plan::REFERENCE_LIMITS;
use lab::trials::trial::ELSEWHERE;
use motion::axis::Axis;
use prompter::{Respondent, TerminalPrompter};
use protocol::system::DeviceKind;
use report::html::campaign::{Present, present, report_folder};
use report::html::{self, Existing};
use serde_json::{Value, json};

use crate::cli::failure;
use crate::cli::screen::Screen;

/// Command shown to other processes as the owner of the line.
const COMMAND: &str = "campaign run";

/// Subcommands of `campaign`.
#[derive(Debug, clap::Subcommand)]
pub enum CampaignSubcommand {
    /// Create the folder of a new campaign from a plan. Moves nothing.
    New(NewArgs),
    /// Begin a campaign from a plan, or continue the one in a folder, also after a crash: readings, checklists, runs,
    /// displacements.
    Run(CampaignRunArgs),
    /// Show the progress of a campaign. Moves nothing.
    Status(StatusArgs),
    /// Correct, exclude, skip, repeat, remark. Each adds a row to the ledger; no row is ever changed. Moves nothing.
    Edit(EditArgs),
}

/// Arguments of `campaign new`.
#[derive(Debug, Args)]
pub struct NewArgs {
    /// The plan (TOML). `examples/paper.toml` explains every key.
    #[arg(value_name = "PLAN")]
    pub plan: PathBuf,
    /// The campaign's folder, which must not exist; by default one below `retrograde-campaigns`, named after the plan.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// Options of a session.
#[derive(Debug, Args)]
pub struct SessionArgs {
    /// Ask nobody. Only with the virtual bench: displacements are those of a model, and are marked so.
    #[arg(long)]
    pub yes: bool,
    /// End the session after this many trials.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub trials: Option<u32>,
}

/// Arguments of `campaign run`.
#[derive(Debug, Args)]
pub struct CampaignRunArgs {
    /// A plan (TOML), or the folder of a campaign.
    #[arg(value_name = "PLAN|DIR")]
    pub what: PathBuf,
    /// The folder of a new campaign, which must not exist.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Options of the session.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Arguments of `campaign status`.
#[derive(Debug, Args)]
pub struct StatusArgs {
    /// The campaign's folder.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
}

/// Arguments of `campaign edit`.
#[derive(Debug, Args)]
pub struct EditArgs {
    /// The campaign's folder.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// The row to add to the ledger.
    #[command(subcommand)]
    pub edit: Edit,
}

/// Rows that a person adds to a ledger.
#[derive(Debug, clap::Subcommand)]
pub enum Edit {
    /// Correct the displacement of a trial; the previous one stays in the ledger.
    Displacement {
        /// The trial.
        trial: u32,
        /// The displacement of the tail, positive headward.
        #[arg(value_name = "MM")]
        displacement_mm: Millimetres,
        /// The reason.
        reason: Vec<String>,
    },
    /// Take back the displacement of a trial: it will be asked for again.
    Undo {
        /// The trial.
        trial: u32,
    },
    /// Exclude a trial that is done from the evaluation.
    Exclude {
        /// The trial.
        trial: u32,
        /// The reason.
        #[arg(required = true)]
        reason: Vec<String>,
    },
    /// Skip a trial.
    Skip {
        /// The trial.
        trial: u32,
        /// The reason.
        reason: Vec<String>,
    },
    /// Include a trial again that was excluded or skipped.
    Include {
        /// The trial.
        trial: u32,
    },
    /// Repeat a trial: its last attempt does not count.
    Repeat {
        /// The trial.
        trial: u32,
        /// The reason.
        reason: Vec<String>,
    },
    /// Add a remark.
    Note {
        /// On this trial; otherwise on the whole campaign.
        #[arg(long, value_name = "N")]
        trial: Option<u32>,
        /// Text of the note.
        #[arg(required = true)]
        text: Vec<String>,
    },
}

pub(crate) fn campaign(
    subcommand: &CampaignSubcommand,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    match subcommand {
        CampaignSubcommand::New(args) => {
            let plan = PlanFile::read(&args.plan)?;
            let folder = create(plan, args.out.as_deref(), finder, screen)?;
            let campaign = folder.campaign();
            screen.say(&format!("{} begins.", resumption(&campaign.folder)));
            Ok(summary(campaign))
        }
        CampaignSubcommand::Run(args) if args.what.is_dir() => {
            if args.out.is_some() {
                return Err(Failure::input(
                    format!(
                        "{} is the folder of a campaign already",
                        args.what.display()
                    ),
                    "leave `--out` out, or give a plan",
                ));
            }
            admit(&args.session, screen)?;
            let folder = open(&args.what, finder, screen)?;
            carry_out(folder, &args.session, finder, screen)
        }
        CampaignSubcommand::Run(args) => {
            let plan = PlanFile::read(&args.what)?;
            admit(&args.session, screen)?;
            if args.session.yes {
                prompter::can_answer(&plan.plan).map_err(|why| {
                    Failure::input(why, "complete the plan, as in `examples/paper.toml`")
                })?;
            }
            let folder = create(plan, args.out.as_deref(), finder, screen)?;
            carry_out(folder, &args.session, finder, screen)
        }
        CampaignSubcommand::Status(args) => {
            let campaign = Campaign::read(&args.folder).map_err(failure::campaign)?;
            for line in status(&campaign) {
                screen.say(&line);
            }
            Ok(summary(&campaign))
        }
        CampaignSubcommand::Edit(args) => edit(args, finder, screen),
    }
}

/// Refuses a session in which questions cannot be answered, before creating anything.
fn admit(session: &SessionArgs, screen: &Screen<'_>) -> Result<(), Failure> {
    if session.yes || screen.keyboard.is_some() {
        return Ok(());
    }
    Err(Failure::refused(
        "a campaign asks for readings and displacements, and nobody is at a terminal",
        "at a terminal, without `--json`; or `--yes` with virtual machines",
    ))
}

/// A plan as the user wrote it.
struct PlanFile<'a> {
    path: &'a Path,
    text: String,
    plan: CampaignPlan,
}

impl<'a> PlanFile<'a> {
    fn read(path: &'a Path) -> Result<Self, Failure> {
        if path.is_dir() {
            return Err(Failure::input(
                format!("{} is a folder, and a plan is a TOML file", path.display()),
                format!(
                    "give a plan, such as `examples/paper.toml`; if this is the folder of a campaign, {}",
                    again(path, false)
                ),
            ));
        }
        let text = limited::read_text(path, limited::BY_HAND).map_err(|io| {
            Failure::input(
                format!("{}: {io}", path.display()),
                "give a plan, such as `examples/paper.toml`, or the folder of a campaign",
            )
        })?;
        let plan = CampaignPlan::parse(&text, path).map_err(failure::campaign)?;
        Ok(Self { path, text, plan })
    }
}

fn create(
    PlanFile { path, text, plan }: PlanFile<'_>,
    out: Option<&Path>,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Folder, Failure> {
    let stamp = finder.connector.now().strftime("%Y%m%dT%H%M%SZ");
    let out = out.map_or_else(
        || PathBuf::from(CAMPAIGNS_FOLDER).join(format!("{}-{stamp}", plan.name)),
        Path::to_owned,
    );
    if let Some(parent) = out.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        std::fs::create_dir_all(parent).map_err(|io| {
            Failure::input(
                format!("{}: {io}", parent.display()),
                format!("{}{ELSEWHERE}", named::remedy(&io)),
            )
        })?;
    }
    let folder = Folder::create(&out, &text, path).map_err(failure::campaign)?;
    let campaign = folder.campaign();
    screen.say(&format!(
        "Campaign {}: {} trials in {}, seed {}; {}.",
        campaign.plan.name,
        campaign.order.len(),
        match campaign.order.last().map_or(0, |last| last.block) {
            1 => "1 block".to_owned(),
            blocks => format!("{blocks} blocks"),
        },
        campaign.plan.seed,
        time_text(remaining_s(campaign)),
    ));
    screen.say(&format!("Folder: {}", out.display()));
    // Warn now: only a rig knows its limits, but most have these, and its refusal would come after an hour of readings.
    if let Err(why) = planning::solve(&campaign.plan.run, &Axis::REFERENCE, &REFERENCE_LIMITS) {
        screen.say(&format!(
            "NOTE: a rig with default settings refuses this run: {why}"
        ));
    }
    Ok(folder)
}

/// Opens a folder for writing. Reports what a killed session has written.
fn open(path: &Path, finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Folder, Failure> {
    let (folder, notices) =
        Folder::resume(path, finder.connector.now()).map_err(failure::campaign)?;
    for line in notices {
        screen.say(&line);
    }
    Ok(folder)
}

fn carry_out(
    mut folder: Folder,
    session: &SessionArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let path = folder.campaign().folder.clone();
    if folder.campaign().state.next().is_some() {
        let ending = sit_down(&mut folder, session, finder, screen)?;
        if ending == Ending::Aborted {
            return Err(failure::aborted(&path));
        }
    }
    let campaign = folder.campaign();
    for line in status(campaign) {
        screen.say(&line);
    }
    let mut value = summary(campaign);
    if campaign.state.next().is_none() {
        value["report"] = json!(reported(&path, screen)?.map(|page| page.display().to_string()));
    }
    Ok(value)
}

/// Writes the report of a finished campaign, and replaces one of an earlier state. A page that is not a report of this
/// program is kept; then no report is written.
fn reported(folder: &Path, screen: &mut Screen<'_>) -> Result<Option<PathBuf>, Failure> {
    let present = present(folder);
    let page = report_folder(folder).join("report.html");
    let (page_text, folder_text) = (page.display(), word(folder));
    let existing = match present {
        Present::Current => {
            screen.say(&format!("Report: {page_text}, of this state already."));
            return Ok(Some(page));
        }
        Present::Foreign => {
            screen.say(&format!(
                "Report: not written, because {page_text} is not a report of this program: move it elsewhere, then `retrograde report {folder_text}`."
            ));
            return Ok(None);
        }
        Present::Nothing => Existing::Keep,
        Present::Outdated => Existing::Replace,
    };
    let written = html::campaign::write(folder, existing).map_err(failure::report)?;
    screen.say(&match present {
        Present::Outdated => {
            format!("Report: {page_text}, written again, because it showed an earlier state.")
        }
        _ => format!("Report: {page_text}"),
    });
    Ok(Some(written.page))
}

fn sit_down(
    folder: &mut Folder,
    session: &SessionArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Ending, Failure> {
    let plan = folder.campaign().plan.clone();
    let path = folder.campaign().folder.clone();
    if session.yes {
        prompter::can_answer(&plan).map_err(|why| {
            Failure::input(
                why,
                "the plan of a campaign that has begun is fixed: at a terminal leave `--yes` out, or begin another one with a complete plan, `retrograde campaign run PLAN.toml --yes`",
            )
        })?;
    }
    let mut rig = finder.connect(DeviceKind::Rig, LinkPurpose::Own(COMMAND))?;
    let capsule = plan
        .needs_capsule()
        .then(|| finder.connect(DeviceKind::Capsule, LinkPurpose::Own(COMMAND)))
        .transpose()?;
    let origin = rig.origin().max(
        capsule
            .as_ref()
            .map_or(Origin::Board, |capsule| capsule.origin()),
    );
    if session.yes && origin != Origin::Virtual {
        return Err(Failure::refused(
            "`--yes` asks nobody, and the displacement on a board has to be measured",
            "leave `--yes` out; with `--rig virtual` a model answers",
        ));
    }
    let folders = [path.clone(), DATA_FOLDER.into()];
    let commissioning = warning::of_record(&mut rig, &folders)?;
    if let Some(warning) = &commissioning {
        screen.hint(&format!("warning: {warning}"));
    }
    if origin == Origin::Virtual {
        screen.say("VIRTUAL: nothing here is a measurement; displacements are those of a model.");
    }
    let mut machines = Machines::new(rig, capsule, commissioning)?;
    for machine in machines.come_to_rest()? {
        screen.say(&format!(
            "The {machine} was still moving without a host: it was stopped."
        ));
    }
    let respondent = match screen.keyboard.take() {
        _ if session.yes => Respondent::Nobody(Box::new(plan)),
        Some(keyboard) => Respondent::person(keyboard, screen.single_keys),
        None => {
            let refused = admit(session, screen).err();
            return Err(refused.unwrap_or_else(|| failure::aborted(&path)));
        }
    };
    let mut prompter = TerminalPrompter::new(screen, finder, respondent);
    let mut connect = |kind| {
        let device = finder.connect(kind, LinkPurpose::Own(COMMAND));
        device.map_err(|why| why.in_one_line())
    };
    let ended =
        Conduct::new(folder, &mut machines, &mut prompter, &mut connect).carry_out(session.trials);
    drop(prompter);
    if let Err(Broken::Experiment(_)) = &ended {
        screen.hint(&again(&path, session.yes));
    }
    ended.map_err(|broken| broken_off(broken, &again(&path, session.yes)))
}

/// The command that continues a campaign, with the options of its start.
fn again(folder: &Path, yes: bool) -> String {
    let yes = if yes { " --yes" } else { "" };
    format!("`retrograde campaign run {}{yes}` continues", word(folder))
}

fn broken_off(broken: Broken, again: &str) -> Failure {
    match broken {
        Broken::Campaign(error) => failure::campaign(error),
        Broken::Experiment(error) => within_campaign(error).into(),
        Broken::Ended {
            action,
            status,
            reason,
        } => Failure::Ended {
            action,
            status,
            reason,
            help: format!(
                "`retrograde info` shows the machine; the attempt does not count; {again}"
            ),
        },
        Broken::NotReady { why, help } => Failure::refused(why, help),
    }
}

/// Removes the choice of another folder from an error's remedy: a campaign has only one.
fn within_campaign(error: ExperimentError) -> ExperimentError {
    let (mut record, ended) = match error {
        ExperimentError::Record(record) => (record, String::new()),
        ExperimentError::Unrecorded { ended, record } => (record, format!("; {ended}")),
        error => return error,
    };
    record.why += &ended;
    record.remedy = make_room(record.remedy.trim_end_matches(ELSEWHERE));
    ExperimentError::Record(record)
}

/// Mean and standard deviation in mm, if there are enough values.
fn mean_text(values: &[Millimetres]) -> String {
    match Summary::of(values) {
        None => String::new(),
        Some(some) => match some.sd_mm {
            None => format!("{:.3} mm", some.mean_mm),
            Some(sd_mm) => format!("{:.3} mm, SD {sd_mm:.3} mm", some.mean_mm),
        },
    }
}

fn rank(campaign: &Campaign) -> impl Fn(&str) -> usize + '_ {
    |name| campaign.plan.rank(name).unwrap_or(usize::MAX)
}

fn status(campaign: &Campaign) -> Vec<String> {
    let state = &campaign.state;
    let done = state
        .trials
        .iter()
        .filter(|trial| trial.status() == TrialStatus::Done)
        .count();
    let origin = campaign.origin().map_or_else(
        || "nothing yet".to_owned(),
        |origin| origin.meaning().to_owned(),
    );
    let mut lines = vec![
        format!(
            "Campaign {}: {done} of {} trials are done.",
            campaign.plan.name,
            state.trials.len()
        ),
        format!("Data: {origin}."),
    ];
    for tally in state.tallies(rank(campaign)) {
        let values: Vec<_> = tally.counted.iter().map(|mm| mm.value).collect();
        let condition = &tally.condition;
        let mut line = format!(
            "  {:<9} {:<10} {:<8} {:<8} n = {} of {}",
            condition.purpose.name(),
            condition.lubrication.name(),
            condition.indentation,
            condition.shape.name(),
            values.len(),
            tally.planned,
        );
        for (count, what) in [(tally.excluded, "excluded"), (tally.skipped, "skipped")] {
            if count > 0 {
                line.push_str(&format!(", {count} {what}"));
            }
        }
        let mean = mean_text(&values);
        if !mean.is_empty() {
            line.push_str(&format!(": {mean}"));
        }
        lines.push(line);
    }
    lines.extend(state.trials.iter().flat_map(not_counted));
    match state.next() {
        None => lines.push("Nothing is left to do.".to_owned()),
        Some(next) => {
            let seconds = remaining_s(campaign);
            lines.push(format!(
                "Next: trial {}, {} {} {}; {}.",
                next.planned.trial,
                next.planned.indentation,
                next.planned.lubrication.name(),
                next.planned.shape.name(),
                time_text(seconds)
            ));
        }
    }
    lines
}

/// Attempts that do not count, and excluded trials.
fn not_counted(trial: &TrialState) -> Vec<String> {
    let number = trial.planned.trial;
    let because = |reason: &str| match reason {
        "" => String::new(),
        reason => format!(": {reason}"),
    };
    let mut lines = vec![];
    for attempt in &trial.attempts {
        let why = match (&attempt.given_up, attempt.outcome) {
            (Some(reason), _) => format!("given up{}", because(reason)),
            (None, Some(outcome)) if !attempt.stands() => {
                let reason = attempt.reason.as_deref().unwrap_or_default();
                format!("{}{}", outcome.name(), because(reason))
            }
            _ => continue,
        };
        lines.push(format!(
            "  trial {number}, attempt {} does not count: {why}",
            attempt.number
        ));
    }
    if let Some(reason) = &trial.skipped {
        lines.push(format!("  trial {number} is skipped{}", because(reason)));
    }
    if let Some(reason) = &trial.excluded {
        lines.push(format!("  trial {number} is excluded{}", because(reason)));
    }
    lines
}

fn summary(campaign: &Campaign) -> Value {
    let conditions: Vec<_> = campaign
        .state
        .tallies(rank(campaign))
        .into_iter()
        .map(|tally| {
            let values: Vec<_> = tally.counted.iter().map(|mm| mm.value).collect();
            let some = Summary::of(&values);
            json!({
                "condition": tally.condition,
                "planned": tally.planned,
                "n": values.len(),
                "excluded": tally.excluded,
                "skipped": tally.skipped,
                "displacements_mm": values.iter().map(|value| value.mm()).collect::<Vec<_>>(),
                "mean_mm": some.map(|some| some.mean_mm),
                "sd_mm": some.and_then(|some| some.sd_mm),
            })
        })
        .collect();
    let next = campaign.state.next().map(|next| next.planned.clone());
    json!({
        "folder": campaign.folder.display().to_string(),
        "campaign": campaign.plan.name,
        "origin": campaign.origin(),
        "conditions": conditions,
        "next": next,
        "remaining_s": remaining_s(campaign),
    })
}

fn edit(args: &EditArgs, finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut folder = open(&args.folder, finder, screen)?;
    let Some(origin) = folder.campaign().origin() else {
        return Err(Failure::input(
            "the campaign has not begun, so there is nothing to edit",
            format!("{} begins it", resumption(&args.folder)),
        ));
    };
    let row = edited(&args.edit, folder.campaign(), origin)?;
    folder
        .append(row, finder.connector.now(), origin)
        .and_then(|()| folder.seal())
        .map_err(failure::campaign)?;
    for line in status(folder.campaign()) {
        screen.say(&line);
    }
    Ok(summary(folder.campaign()))
}

fn edited(edit: &Edit, campaign: &Campaign, origin: Origin) -> Result<LedgerRow, Failure> {
    let attempt = |trial: u32| {
        campaign
            .state
            .trial(trial)
            .and_then(|trial| trial.attempts.last())
            .map(|attempt| attempt.number)
    };
    let text = |words: &[String]| Some(words.join(" "));
    Ok(match edit {
        Edit::Displacement { trial, .. } if origin == Origin::Virtual => {
            let folder = word(&campaign.folder);
            return Err(Failure::refused(
                "nothing can be measured on the virtual bench: its displacements are those of a model",
                format!(
                    "`retrograde campaign edit {folder} undo {trial}`, then `retrograde campaign run {folder} --yes` takes the model's value again"
                ),
            ));
        }
        Edit::Displacement {
            trial,
            displacement_mm,
            reason,
        } => {
            if let Some(why) = campaign.plan.displacement.refusal(*displacement_mm) {
                return Err(Failure::input(why, "in millimetres, + headward"));
            }
            let mut row = LedgerRow::of(LedgerEvent::Displacement, *trial, attempt(*trial));
            row.displacement_mm = Some(*displacement_mm);
            row.source = Some(Source::Measured);
            row.saying(text(reason))
        }
        Edit::Undo { trial } => LedgerRow::of(LedgerEvent::Undone, *trial, attempt(*trial)),
        Edit::Exclude { trial, reason } => {
            LedgerRow::of(LedgerEvent::Excluded, *trial, attempt(*trial)).saying(text(reason))
        }
        Edit::Skip { trial, reason } => {
            LedgerRow::of(LedgerEvent::Skipped, *trial, None).saying(text(reason))
        }
        Edit::Include { trial } => LedgerRow::of(LedgerEvent::Included, *trial, None),
        Edit::Repeat { trial, reason } => {
            LedgerRow::of(LedgerEvent::Repeated, *trial, attempt(*trial)).saying(text(reason))
        }
        Edit::Note {
            trial,
            text: remark,
        } => {
            let mut row = LedgerRow::of(LedgerEvent::Note, 0, None).saying(text(remark));
            row.trial = *trial;
            row
        }
    })
}

#[cfg(test)]
mod tests {
    use lab::trials::trial::RecordError;

    use super::*;

    /// Regression: on a full disk a campaign advised `--out DIR`, which it refuses.
    #[test]
    fn a_full_disk_within_a_campaign_has_a_remedy_for_a_campaign() {
        let record = || RecordError::write(Path::new("run-1.csv"), std::io::ErrorKind::StorageFull);
        for error in [
            ExperimentError::Record(record()),
            ExperimentError::Unrecorded {
                ended: "the run ended as Complete".to_owned(),
                record: record(),
            },
        ] {
            let is_ended = matches!(error, ExperimentError::Unrecorded { .. });
            let failure = broken_off(Broken::Experiment(error), "");
            let text = failure.text();
            assert!(
                !text.contains("--out") && text.contains("free space"),
                "{text}"
            );
            assert!(text.contains("run-1.csv: no storage space"), "{text}");
            assert_eq!(
                text.contains("the run ended as Complete"),
                is_ended,
                "{text}"
            );
            assert_eq!(failure.exit_code(), 1);
        }
    }
}
