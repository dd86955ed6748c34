//! The command line.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, ValueEnum};
use client::decimal::{DecimalError, Milli, Seconds, ShortSeconds};
use client::link::address::Address;
use client::link::serial::DEFAULT_BAUD;
use jiff::civil::Date;
use protocol::rig::{Direction, LinkLossPolicy, Run, RunTiming};
use protocol::settings::SettingKey;
use protocol::system::DeviceKind;

use crate::cli::configured::Names;
use crate::cli::design::DesignArgs;
use crate::cli::fit::FitArgs;
use crate::cli::plan_experiment::PlanExperimentArgs;
use crate::cli::science::SimulateArgs;
use campaign::plan::Millimetres;

const EXAMPLES: &str = "\
Examples:
  retrograde devices                            which machines are there
  retrograde doctor                             what is wrong, and what to do about it
  retrograde --rig /dev/ttyACM0 info            how the rig is, also while it runs
  retrograde home                               find the position, before a run
  retrograde run --cycles 5 --duration-s 40     the paper's run, recorded in retrograde-data
  retrograde watch                              see it run, from another terminal
  retrograde serve                              the same on a page, with buttons, and for programs
  retrograde run --stroke-mm 60 --speed-mm-s 10 --note 'second body'
  retrograde campaign run examples/paper.toml   the paper's trials, step by step
  retrograde plan --duration-s 40 --plot run.svg   the same without a rig
  retrograde stop                               stop all machines, from any terminal
  retrograde report retrograde-data --out report.html

`retrograde man run | man -l -` shows the manual page of a subcommand.";

/// Peristaltic waves on the rig, a folding capsule, and the data of both.
///
/// Ctrl-C stops in a controlled way and keeps the position; twice is the emergency stop. This is not a certified
/// safety function: a hard-wired switch in the motor supply is required.
#[derive(Debug, Parser)]
#[command(name = "retrograde", version, arg_required_else_help = true, after_help = EXAMPLES)]
pub struct Cli {
    /// The rig: `auto`, a serial port, `tcp:HOST:PORT`, a name from the file of machines, or `virtual`.
    #[arg(long, global = true, env = "RETROGRADE_RIG", value_name = "WHERE")]
    pub rig: Option<Address>,
    /// The capsule: `auto`, a serial port, `tcp:HOST:PORT`, a name from the file of machines, or `virtual`.
    #[arg(long, global = true, env = "RETROGRADE_CAPSULE", value_name = "WHERE")]
    pub capsule: Option<Address>,
    /// Speed of serial ports.
    #[arg(long, global = true, default_value_t = DEFAULT_BAUD, value_parser = clap::value_parser!(u32).range(300..=4_000_000))]
    pub baud: u32,
    /// Print one JSON object on standard output; everything else goes to standard error.
    #[arg(long, global = true)]
    pub json: bool,
    /// The names by which `--rig` and `--capsule` were given.
    #[arg(skip)]
    pub names: Names,
    /// What to do.
    #[command(subcommand)]
    pub subcommand: Subcommand,
}

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum Subcommand {
    /// List ports and the machines at them. Moves nothing.
    Devices,
    /// Find out what is wrong with ports and machines, and what to do about it, within a second or so. Moves nothing.
    Doctor(Which),
    /// Show identity, state and last fault of the machines. Moves nothing.
    Info(Which),
    /// Find the rig's position: two passes over the home flag, then to 0.
    Home,
    /// Run the waves: cycles away from home and back, recorded. The rig must be homed. At a terminal, the key h holds
    /// the run, r resumes it, s stops it.
    Run(Box<RunArgs>),
    /// A campaign: a plan of trials with readings, displacements and records, which can be left and resumed at any time.
    Campaign {
        /// What to do with it.
        #[command(subcommand)]
        subcommand: CampaignSubcommand,
    },
    /// List campaigns and trials by date, specimen and outcome.
    List(ListArgs),
    /// What the machines themselves still know of their last action.
    Records {
        /// What to do with it.
        #[command(subcommand)]
        subcommand: RecordsSubcommand,
    },
    /// Find every change of a campaign's folder since it was written: bits, lines, files. Changes nothing.
    Verify(VerifyArgs),
    /// Take a new board into service: switches, pulses, travel and stops, measured step by step and recorded. It can be
    /// left at any time; the same command goes on where it was left.
    Commission(Box<CommissionArgs>),
    /// Stop: the rig decelerates and keeps its position, the capsule is held by its worm gear.
    Stop(Which),
    /// Emergency stop: cut pulses and motor current at once. It is latched, and the rig's position is lost.
    Estop(Which),
    /// Acknowledge a latched fault after its cause was removed. Moves nothing.
    Ack(Which),
    /// The capsule's own commands.
    Capsule {
        /// What the capsule does.
        #[command(subcommand)]
        subcommand: CapsuleSubcommand,
    },
    /// Fold the capsule's origami, or fold or unfold it partly, recorded.
    Fold(PartialArgs),
    /// Unfold the capsule's origami, recorded.
    Unfold(FoldArgs),
    /// Hold a run that goes on without its host: decelerate, keep the position, ready to resume.
    Hold,
    /// Resume a held run, exactly as planned.
    Resume,
    /// Move the rig while this command runs; it stops at the ends of the stroke.
    Jog(JogArgs),
    /// Move the rig to a position.
    Move(MoveArgs),
    /// Watch the machines on one screen, also while another `retrograde` works with them; keys hold, resume and stop.
    Watch(WatchArgs),
    /// Serve both machines to browsers and programs: a page, and HTTP with JSON, on this computer only unless told
    /// otherwise. Other commands keep working beside it.
    Serve(ServeArgs),
    /// Show the rig's counters: false pulses, serial errors, stack use, underruns.
    Health,
    /// Settings and name of a machine.
    Settings {
        /// Whose: those of the rig, unless the setting is one that only the capsule has.
        #[arg(long, value_enum, value_name = "MACHINE", global = true)]
        of: Option<MachineKind>,
        /// What to do with them.
        #[command(subcommand)]
        subcommand: SettingsSubcommand,
    },
    /// Calculate a run without a rig: durations, speeds, edges as CSV, plot as SVG.
    Plan(Box<PlanArgs>),
    /// Calculate an origami design: lengths, shortening, the paper's requirements; drawings as SVG.
    Design(Box<DesignArgs>),
    /// Simulate the paper's series and free sweeps: CSV and SVG.
    Simulate(Box<SimulateArgs>),
    /// Calibrate the model's body from recorded trials: a posterior with its uncertainty, for `simulate --model`.
    Fit(Box<FitArgs>),
    /// Plan which trials tell most about the model's body, beside the paper's procedure.
    PlanExperiment(Box<PlanExperimentArgs>),
    /// Write an HTML report of recorded trials, or of a campaign with its figures and tables.
    Report(ReportArgs),
    /// Flash a board through probe-rs.
    Flash(FlashArgs),
    /// Print a completion script for a shell.
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
    /// Print the manual page (roff) of the program, or of a subcommand.
    Man {
        /// The subcommand, such as `run` or `settings set`.
        subcommand: Vec<String>,
    },
}

/// What to do with a campaign.
#[derive(Debug, clap::Subcommand)]
pub enum CampaignSubcommand {
    /// Make the folder of a new campaign from a plan. Moves nothing.
    New(NewArgs),
    /// Begin a campaign from a plan, or go on with the one in a folder: readings, check-lists, runs, displacements.
    Run(CampaignRunArgs),
    /// Go on with a campaign, also after a crash.
    Resume(ResumeArgs),
    /// Show how far a campaign has come. Moves nothing.
    Status(StatusArgs),
    /// Correct, exclude, skip, repeat, remark. Each is a new row in the ledger; no row is ever changed. Moves nothing.
    Edit(EditArgs),
}

/// Arguments of `campaign new`.
#[derive(Debug, Args)]
pub struct NewArgs {
    /// The plan (TOML). `examples/paper.toml` and `examples/passes.toml` explain every key.
    #[arg(value_name = "PLAN")]
    pub plan: PathBuf,
    /// The campaign's folder, which must not exist; by default one below `retrograde-campaigns`, named after the plan.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// How a session goes.
#[derive(Debug, Args)]
pub struct SessionArgs {
    /// Ask nobody. Only with the virtual bench: displacements are those of a model, and are marked so.
    #[arg(long)]
    pub yes: bool,
    /// Leave after so many trials.
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
    /// How it goes.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Arguments of `campaign resume`.
#[derive(Debug, Args)]
pub struct ResumeArgs {
    /// The campaign's folder.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
    /// How it goes.
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
    /// What is added to the ledger.
    #[command(subcommand)]
    pub edit: Edit,
}

/// What is added to a ledger.
#[derive(Debug, clap::Subcommand)]
pub enum Edit {
    /// Correct the displacement of a trial; the former one stays in the ledger.
    Displacement {
        /// The trial.
        trial: u32,
        /// The displacement of the tail, + headward.
        #[arg(value_name = "MM", allow_negative_numbers = true)]
        displacement_mm: Millimetres,
        /// Why.
        reason: Vec<String>,
    },
    /// Take the displacement of a trial back: it is asked for again.
    Undo {
        /// The trial.
        trial: u32,
    },
    /// Leave a trial that is done out of the evaluation.
    Exclude {
        /// The trial.
        trial: u32,
        /// Why.
        #[arg(required = true)]
        reason: Vec<String>,
    },
    /// Skip a trial.
    Skip {
        /// The trial.
        trial: u32,
        /// Why.
        reason: Vec<String>,
    },
    /// Take a trial in again that was excluded or skipped.
    Include {
        /// The trial.
        trial: u32,
    },
    /// Do a trial once more: its last attempt does not count.
    Repeat {
        /// The trial.
        trial: u32,
        /// Why.
        reason: Vec<String>,
    },
    /// Add a remark.
    Note {
        /// On this trial; otherwise on the whole campaign.
        #[arg(long, value_name = "N")]
        trial: Option<u32>,
        /// The remark.
        #[arg(required = true)]
        text: Vec<String>,
    },
}

/// What to do with the machines' own records.
#[derive(Debug, clap::Subcommand)]
pub enum RecordsSubcommand {
    /// Write what a machine still knows of its last run or actuation into a file, for example after the computer died or
    /// somebody pressed the start button. There is no telemetry in it. Changes nothing.
    Fetch(FetchArgs),
}

/// Arguments of `records fetch`.
#[derive(Debug, Args)]
pub struct FetchArgs {
    /// The machines.
    #[command(flatten)]
    pub which: Which,
    /// Folder of the file.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
}

/// Arguments of `verify`.
#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// The folder of a campaign, or of records.
    #[arg(value_name = "DIR")]
    pub folder: PathBuf,
}

/// Arguments of `list`.
#[derive(Debug, Args)]
pub struct ListArgs {
    /// Where to look, also in folders within [default: retrograde-campaigns and retrograde-data].
    #[arg(value_name = "DIR")]
    pub folders: Vec<PathBuf>,
    /// Also list every attempt at the trials of campaigns.
    #[arg(long)]
    pub trials: bool,
    /// From this day on, UTC: 2026-01-31.
    #[arg(long, value_name = "DATE")]
    pub since: Option<Date>,
    /// Up to this day, UTC.
    #[arg(long, value_name = "DATE")]
    pub until: Option<Date>,
    /// A part of the specimen's description, or of the note of a trial outside campaigns.
    #[arg(long, value_name = "TEXT")]
    pub specimen: Option<String>,
    /// What became of it: `complete` or `open` campaigns; trials that are `complete`, `stopped`, `faulted`, `link_lost` ...
    #[arg(long, value_name = "OUTCOME")]
    pub outcome: Option<String>,
}

/// Folder of all campaigns, unless the user names another.
pub const CAMPAIGNS_FOLDER: &str = "retrograde-campaigns";

/// What to do with settings.
#[derive(Debug, clap::Subcommand)]
pub enum SettingsSubcommand {
    /// Show all settings with unit and range.
    List,
    /// Show one setting.
    Get {
        /// Its name.
        key: Key,
    },
    /// Change one setting and store it in flash. Not while something moves.
    Set {
        /// Its name.
        key: Key,
        /// Its value, a whole number in the unit of its name.
        #[arg(allow_negative_numbers = true)]
        value: String,
    },
    /// Write all settings to a JSON file.
    Export {
        /// The file.
        file: PathBuf,
        /// Replace an existing file.
        #[arg(long)]
        force: bool,
    },
    /// Set all settings from a JSON file written by `export`, or none if one is refused.
    Import {
        /// The file.
        file: PathBuf,
    },
    /// Show the machine's name, or change it.
    Name {
        /// At most 24 bytes.
        name: Option<String>,
    },
    /// Set all settings and the name to their defaults.
    Reset {
        /// Do not ask for confirmation.
        #[arg(long)]
        yes: bool,
    },
}

/// A setting by name.
#[derive(Clone, Copy, Debug)]
pub struct Key(pub SettingKey);

impl std::str::FromStr for Key {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        SettingKey::ALL
            .into_iter()
            .find(|key| key.name() == name)
            .map(Self)
            .ok_or_else(|| {
                format!("there is no setting `{name}`: `retrograde settings list` shows all")
            })
    }
}

/// Reads `away` or `home`.
fn direction() -> impl TypedValueParser<Value = Direction> {
    PossibleValuesParser::new([
        PossibleValue::new("away").help("Away from home"),
        PossibleValue::new("home").help("Towards home"),
    ])
    .map(|name| match name.as_str() {
        "away" => Direction::Away,
        _ => Direction::Home,
    })
}

/// Arguments of `jog`.
#[derive(Debug, Args)]
pub struct JogArgs {
    /// Direction of travel.
    #[arg(value_parser = direction())]
    pub direction: Direction,
    /// Speed in mm/s.
    #[arg(
        long,
        value_name = "MM/S",
        default_value = "5",
        allow_negative_numbers = true
    )]
    pub speed_mm_s: Milli,
    /// Duration in s.
    #[arg(
        long,
        value_name = "S",
        default_value = "1",
        allow_negative_numbers = true,
        value_parser = above_zero::<ShortSeconds>
    )]
    pub for_s: ShortSeconds,
}

/// Arguments of `move`.
#[derive(Debug, Args)]
pub struct MoveArgs {
    /// Target, in mm from home.
    #[arg(value_name = "MM", allow_negative_numbers = true)]
    pub position_mm: Milli,
    /// Speed in mm/s.
    #[arg(
        long,
        value_name = "MM/S",
        default_value = "20",
        allow_negative_numbers = true
    )]
    pub speed_mm_s: Milli,
}

/// The capsule's own commands.
#[derive(Debug, clap::Subcommand)]
pub enum CapsuleSubcommand {
    /// Find the thread's zero, recorded. Required before folding.
    Reference(RecordArgs),
    /// "This is unfolded": measure how far it is to the end force, and keep it in the capsule's flash. Once per capsule.
    Calibrate(RecordArgs),
    /// After a reset: wind gently to the end force, and stay folded. Nothing is paid out.
    Check(RecordArgs),
    /// Fetch the recording of the last actuation, one reading per millisecond, also after a fault: a CSV file.
    Trace(TraceArgs),
    /// Endurance: fold and unfold N times, each pair a row of a CSV file, with a summary of what drifts. The first fault
    /// ends it; Ctrl-C ends it with a controlled stop.
    Cycle(CycleArgs),
    /// Fold and unfold once, and find resistance, motor constant, friction, stiffness and slack from the two recordings.
    Identify(RecordArgs),
}

/// Arguments of `capsule cycle`.
#[derive(Debug, Args)]
pub struct CycleArgs {
    /// Pairs of a fold and an unfolding, 1 to 100000.
    #[arg(value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub pairs: u32,
    /// Folder of the two files.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
}

/// Arguments of `fold`.
#[derive(Debug, Args)]
pub struct PartialArgs {
    /// Record and recording.
    #[command(flatten)]
    pub fold: FoldArgs,
    /// Stop with so much thread on the spool, in mm from the unfolded end, winding or paying out.
    #[arg(
        long,
        value_name = "MM",
        allow_negative_numbers = true,
        conflicts_with = "indentation_mm"
    )]
    pub thread_mm: Option<Milli>,
    /// Stop where the paper's origami is folded as an indentation of so many mm would fold it (Eq. 7).
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    pub indentation_mm: Option<Milli>,
    /// With `--indentation-mm`: slack of the unfolded thread.
    #[arg(
        long,
        value_name = "MM",
        default_value = "1",
        allow_negative_numbers = true
    )]
    pub slack_mm: Milli,
}

/// Arguments of `fold` and `unfold`.
#[derive(Debug, Args)]
pub struct FoldArgs {
    /// The record.
    #[command(flatten)]
    pub record: RecordArgs,
    /// Fetch the capsule's own recording after the motion, one reading per millisecond, with the force: a new CSV file.
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
}

/// Arguments of `capsule trace`.
#[derive(Debug, Args)]
pub struct TraceArgs {
    /// Folder of the records.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
}

/// A machine by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum MachineKind {
    /// The roller rig.
    Rig,
    /// The capsule.
    Capsule,
}

impl From<MachineKind> for DeviceKind {
    fn from(kind: MachineKind) -> Self {
        match kind {
            MachineKind::Rig => Self::Rig,
            MachineKind::Capsule => Self::Capsule,
        }
    }
}

/// The machines a command is for.
#[derive(Debug, Args)]
pub struct Which {
    /// Only this machine. Otherwise those given by `--rig` and `--capsule`, or all that are found.
    pub machine: Option<MachineKind>,
}

/// Arguments of `watch`.
#[derive(Debug, Args)]
pub struct WatchArgs {
    /// The machines.
    #[command(flatten)]
    pub which: Which,
    /// Print a line per machine and second instead, as without a terminal.
    #[arg(long)]
    pub plain: bool,
    /// End after this time in s; otherwise with q, or with a signal.
    #[arg(long, value_name = "S", allow_negative_numbers = true, value_parser = above_zero::<ShortSeconds>)]
    pub for_s: Option<ShortSeconds>,
}

/// Arguments of `serve`.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Where to listen; port 0 takes a free one. With an address that others can reach, whoever reads along in that
    /// network reads the token and can move the machines: there is no encryption.
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:7080")]
    pub listen: SocketAddr,
    /// Read the token from this file, and make one there if there is none. Otherwise each start has a new one.
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// A name by which browsers call this computer, beside `localhost` and numbers; repeat it for several.
    #[arg(long = "host", value_name = "NAME")]
    pub hosts: Vec<String>,
    /// Folder of the records.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
    /// The campaign whose next step is shown; by default the newest one that is not complete.
    #[arg(long, value_name = "DIR")]
    pub campaign: Option<PathBuf>,
}

/// Folder of all records, unless the user names another.
pub const DATA_FOLDER: &str = "retrograde-data";

/// Where a trial is recorded.
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// Folder of the records (telemetry CSV and JSON).
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
    /// Interval of telemetry in ms, 5 to 1000.
    #[arg(long, value_name = "MS", default_value_t = 10, value_parser = clap::value_parser!(u16).range(5..=1000))]
    pub telemetry_ms: u16,
    /// A note that is kept with the trial.
    #[arg(long)]
    pub note: Option<String>,
}

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// The waves.
    #[command(flatten)]
    pub waves: Waves,
    /// What the rig does when it has not heard from the host for 1 s: stop, or finish the run.
    #[arg(long, value_name = "POLICY", default_value = "stop")]
    pub on_link_loss: OnLinkLoss,
    /// Fold the capsule when this cycle begins, from 1. It has to be unfolded before the run.
    #[arg(long, value_name = "K", group = "tied", value_parser = cycles, allow_negative_numbers = true)]
    pub fold_at_cycle: Option<u16>,
    /// Unfold the capsule when this cycle begins. It has to be folded before the run.
    #[arg(long, value_name = "K", group = "tied", value_parser = cycles, allow_negative_numbers = true)]
    pub unfold_at_cycle: Option<u16>,
    /// Not at the start of that cycle: where the carriage passes there on its way away from home.
    #[arg(long, value_name = "MM", value_parser = above_zero::<Milli>, allow_negative_numbers = true, requires = "tied")]
    pub at_mm: Option<Milli>,
    /// The record.
    #[command(flatten)]
    pub record: RecordArgs,
}

/// Arguments of `commission`.
#[derive(Debug, Args)]
pub struct CommissionArgs {
    /// The machine.
    pub machine: MachineKind,
    /// Ask nobody. What needs a hand at the machine is recorded as not shown, unless the virtual bench lends its own.
    #[arg(long)]
    pub yes: bool,
    /// Where the virtual bench's hands listen, as `virtual-bench serve` says.
    #[arg(long, value_name = "HOST:PORT", requires = "yes")]
    pub hands: Option<String>,
    /// Folder of the record.
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
    /// The record, instead of a file in the folder that is named after the board.
    #[arg(long, value_name = "FILE", conflicts_with = "out")]
    pub record: Option<PathBuf>,
    /// The image (ELF) that should be on the rig; by default the one built in this workspace.
    #[arg(long, value_name = "ELF")]
    pub image: Option<PathBuf>,
    /// Strokes of the read-back test without motor power: an even number, 2 to 20000. The test of edge timing makes as
    /// many, 200 at most.
    #[arg(long, value_name = "N", default_value = "10000", value_parser = strokes)]
    pub strokes: u16,
    /// Cycles of the run at the end.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..=100))]
    pub cycles: u16,
    /// How long the board's clock is compared with the host's, in s.
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..=3600))]
    pub clock_s: u16,
}

/// What the rig does when it no longer hears from the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OnLinkLoss {
    /// Decelerate, keep the position.
    Stop,
    /// Finish the run.
    Finish,
}

/// Cycles, stroke and timing.
#[derive(Debug, Args)]
pub struct Waves {
    /// Out-and-home cycles, 1 to 10000.
    #[arg(long, default_value = "5", value_parser = cycles, allow_negative_numbers = true)]
    pub cycles: u16,
    /// Stroke in mm.
    #[arg(
        long,
        value_name = "MM",
        default_value = "130",
        allow_negative_numbers = true
    )]
    pub stroke_mm: Milli,
    /// A named timing: `paper` is 40 s for 5 cycles, `wave` 10 mm/s both ways, like a slow wave of the intestine.
    #[arg(long, conflicts_with_all = ["duration_s", "speed_mm_s", "waves_per_minute"])]
    pub preset: Option<Preset>,
    /// Cycles per minute, dwells and start delay included, instead of a duration.
    #[arg(
        long,
        value_name = "N",
        allow_negative_numbers = true,
        value_parser = above_zero::<Milli>,
        conflicts_with_all = ["duration_s", "speed_mm_s"]
    )]
    pub waves_per_minute: Option<Milli>,
    /// Duration of all cycles in s, dwells and start delay included. 40 by default, unless speeds are given.
    #[arg(
        long,
        value_name = "S",
        allow_negative_numbers = true,
        conflicts_with = "speed_mm_s"
    )]
    pub duration_s: Option<Seconds>,
    /// Speed away from home in mm/s, instead of a duration.
    #[arg(long, value_name = "MM/S", allow_negative_numbers = true)]
    pub speed_mm_s: Option<Milli>,
    /// Speed towards home in mm/s; by default the same as away from home.
    #[arg(
        long,
        value_name = "MM/S",
        allow_negative_numbers = true,
        requires = "speed_mm_s"
    )]
    pub return_speed_mm_s: Option<Milli>,
    /// Acceleration of every ramp in mm/s2.
    #[arg(
        long,
        value_name = "MM/S2",
        default_value = "100",
        allow_negative_numbers = true
    )]
    pub accel_mm_s2: Milli,
    /// Pause at the far end in s.
    #[arg(
        long,
        value_name = "S",
        default_value = "0",
        allow_negative_numbers = true
    )]
    pub far_dwell_s: ShortSeconds,
    /// Pause at home between two cycles in s.
    #[arg(
        long,
        value_name = "S",
        default_value = "0",
        allow_negative_numbers = true
    )]
    pub home_dwell_s: ShortSeconds,
    /// Pause before the first stroke in s; part of the duration.
    #[arg(
        long,
        value_name = "S",
        default_value = "0",
        allow_negative_numbers = true
    )]
    pub start_delay_s: ShortSeconds,
}

/// The paper's duration.
const DEFAULT_DURATION_US: u64 = 40_000_000;
/// The paper's duration of a cycle.
const PAPER_CYCLE_US: u64 = 8_000_000;
/// Speed of the preset `wave`.
const WAVE_UM_S: u32 = 10_000;

/// A named timing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// The paper's: 8 s per cycle.
    Paper,
    /// 10 mm/s both ways.
    Wave,
}

impl Waves {
    /// The request these arguments stand for.
    #[must_use]
    pub fn request(&self, on_link_loss: OnLinkLoss) -> Run {
        let accel_um_s2 = self.accel_mm_s2.0;
        let cycles = u64::from(self.cycles);
        let total = |total_us| RunTiming::Total {
            total_us,
            accel_um_s2,
        };
        let timing = match self.speed_mm_s {
            _ if self.preset == Some(Preset::Paper) => total(cycles * PAPER_CYCLE_US),
            _ if self.preset == Some(Preset::Wave) => RunTiming::Speeds {
                forward_um_s: WAVE_UM_S,
                return_um_s: WAVE_UM_S,
                accel_um_s2,
            },
            // `waves` is in thousandths per minute. Rounded up, so that the run is never faster than requested.
            _ if let Some(waves) = self.waves_per_minute => {
                total((cycles * 60_000_000_000).div_ceil(u64::from(waves.0).max(1)))
            }
            Some(forward) => RunTiming::Speeds {
                forward_um_s: forward.0,
                return_um_s: self.return_speed_mm_s.unwrap_or(forward).0,
                accel_um_s2,
            },
            None => total(
                self.duration_s
                    .map_or(DEFAULT_DURATION_US, |seconds| seconds.0),
            ),
        };
        Run {
            cycles: self.cycles,
            stroke_um: self.stroke_mm.0,
            timing,
            far_dwell_us: self.far_dwell_s.0,
            home_dwell_us: self.home_dwell_s.0,
            start_delay_us: self.start_delay_s.0,
            link_loss: match on_link_loss {
                OnLinkLoss::Stop => LinkLossPolicy::Stop,
                OnLinkLoss::Finish => LinkLossPolicy::Finish,
            },
        }
    }
}

/// Parses a number that must be above 0.
fn above_zero<T>(text: &str) -> Result<T, String>
where
    T: std::str::FromStr<Err = DecimalError> + Default + PartialEq,
{
    let value: T = text
        .parse()
        .map_err(|error: DecimalError| error.to_string())?;
    if value == T::default() {
        return Err("use a number above 0".to_owned());
    }
    Ok(value)
}

/// Accepts 0, because the planner's refusal explains more.
fn cycles(text: &str) -> Result<u16, String> {
    let value = client::decimal::parse(text, 0, 10_000).map_err(|error| error.to_string())?;
    u16::try_from(value).map_err(|_| "too large: use at most 10000".to_owned())
}

/// Whole cycles only: an odd number would have to become another one.
fn strokes(text: &str) -> Result<u16, String> {
    let value = text.parse::<u16>().ok();
    value
        .filter(|strokes| (2..=20_000).contains(strokes) && strokes.is_multiple_of(2))
        .ok_or_else(|| "use an even number from 2 to 20000, for a cycle is two strokes".to_owned())
}

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
}

/// Arguments of `report`.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Records: JSON files of trials, or folders of them; or the folder of one campaign.
    #[arg(required = true, value_name = "TRIAL")]
    pub trials: Vec<PathBuf>,
    /// The HTML file [default: report.html]; a campaign's report goes to its folder `report`.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Replace a report that is there already.
    #[arg(long)]
    pub force: bool,
    /// Of a campaign: the model whose band stands behind its series, a file that `fit` or `simulate` wrote. Without it the
    /// band is that of the bodies that agree with the paper's words.
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
}

/// Arguments of `flash`.
#[derive(Debug, Args)]
pub struct FlashArgs {
    /// The machine.
    pub machine: MachineKind,
    /// The image (ELF); by default the one built in this workspace.
    #[arg(long, value_name = "ELF")]
    pub image: Option<PathBuf>,
    /// The debug probe, `VID:PID:SERIAL`, if several are connected.
    #[arg(long, value_name = "PROBE")]
    pub probe: Option<String>,
    /// Only look at the image; needs no probe and no board.
    #[arg(long)]
    pub dry_run: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jog_goes_where_its_direction_says() {
        let parse = |direction: &str| Cli::try_parse_from(["retrograde", "jog", direction]);
        for (name, expected) in [("away", Direction::Away), ("home", Direction::Home)] {
            let Ok(Subcommand::Jog(args)) = parse(name).map(|cli| cli.subcommand) else {
                panic!("`jog {name}` is a jog");
            };
            assert_eq!(args.direction, expected, "{name}");
        }
        let refused = parse("left").expect_err("no direction").to_string();
        assert!(refused.contains("away, home"), "{refused}");
    }
}
