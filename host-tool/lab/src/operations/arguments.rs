//! Arguments that several commands share. The server reads them from the body of a request.

use std::path::{Path, PathBuf};

use crate::operations::failure::Failure;
use crate::trials::plan;
use crate::trials::trial::Recording;
use clap::builder::{PossibleValue, PossibleValuesParser, RangedU64ValueParser, TypedValueParser};
use clap::{Args, ValueEnum};
use client::decimal::{DecimalError, Milli, Seconds, ShortSeconds};
use jiff::Timestamp;
use motion::run::MAX_CYCLES;
use protocol::rig::{Direction, LinkLossPolicy, Run, RunTiming};
use protocol::system::{DeviceKind, SetTelemetry};

/// Folder of all records, unless the user names another.
pub const DATA_FOLDER: &str = "retrograde-data";

/// Folder of all campaigns, unless the user names another.
pub const CAMPAIGNS_FOLDER: &str = "retrograde-campaigns";

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

/// Where a trial is recorded.
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// Folder of the records (telemetry CSV and JSON).
    #[arg(long, value_name = "DIR", default_value = DATA_FOLDER)]
    pub out: PathBuf,
    /// Interval of telemetry in ms, 5 to 1000.
    #[arg(long, value_name = "MS", default_value_t = 10, value_parser = telemetry_interval())]
    pub telemetry_ms: u16,
    /// A note that is kept with the trial.
    #[arg(long)]
    pub note: Option<String>,
}

impl RecordArgs {
    /// The recording of a motion that begins now. The server uses another folder.
    pub fn recording(&self, folder: &Path, stem: &str, now: Timestamp) -> Recording {
        Recording {
            folder: folder.to_owned(),
            stem: stem.to_owned(),
            now,
            note: self.note.clone(),
            telemetry_ms: self.telemetry_ms,
        }
    }
}

fn telemetry_interval() -> RangedU64ValueParser<u16> {
    let (least, most) = SetTelemetry::PERIOD_MS;
    RangedU64ValueParser::new().range(u64::from(least)..=u64::from(most))
}

/// Arguments of `run`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// The waves.
    #[command(flatten)]
    pub waves: Waves,
    /// Reaction of the rig if it has not heard from the host for 1 s: stop, or finish the run.
    #[arg(long, value_name = "POLICY", default_value = "stop")]
    pub on_link_loss: OnLinkLoss,
    /// Fold the capsule when this cycle begins, from 1. It has to be unfolded before the run.
    #[arg(long, value_name = "K", group = "tied", value_parser = cycles)]
    pub fold_at_cycle: Option<u16>,
    /// Unfold the capsule when this cycle begins. It has to be folded before the run.
    #[arg(long, value_name = "K", group = "tied", value_parser = cycles)]
    pub unfold_at_cycle: Option<u16>,
    /// With `--fold-at-cycle` or `--unfold-at-cycle`: where the carriage passes this position on its way away from
    /// home, instead of at the start of the cycle.
    #[arg(long, value_name = "MM", value_parser = above_zero::<Milli>, requires = "tied")]
    pub at_mm: Option<Milli>,
    /// The record.
    #[command(flatten)]
    pub record: RecordArgs,
}

impl RunArgs {
    /// The run that these arguments describe.
    ///
    /// # Errors
    /// No rig could execute it, or its record would exceed the limits.
    pub fn run(&self) -> Result<Run, Failure> {
        let run = self.waves.request(self.on_link_loss);
        plan::check(&run)?;
        plan::fits(&run, self.record.telemetry_ms)
            .map_err(|why| Failure::input(format!("telemetry_ms: {why}"), "nothing moved"))?;
        Ok(run)
    }
}

/// Reaction of the rig to a silent host.
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
    #[arg(long, default_value = "5", value_parser = cycles)]
    pub cycles: u16,
    /// Stroke in mm.
    #[arg(long, value_name = "MM", default_value = "130")]
    pub stroke_mm: Milli,
    /// A named timing: `paper` is 40 s for 5 cycles, `wave` 10 mm/s both ways, like a slow wave of the intestine.
    #[arg(long, conflicts_with_all = ["duration_s", "speed_mm_s", "waves_per_minute"])]
    pub preset: Option<Preset>,
    /// Cycles per minute, dwells and start delay included, instead of a duration.
    #[arg(
        long,
        value_name = "N",
        value_parser = above_zero::<Milli>,
        conflicts_with_all = ["duration_s", "speed_mm_s"]
    )]
    pub waves_per_minute: Option<Milli>,
    /// Duration of all cycles in s, dwells and start delay included. 40 by default, unless speeds are given.
    #[arg(long, value_name = "S", conflicts_with = "speed_mm_s")]
    pub duration_s: Option<Seconds>,
    /// Speed away from home in mm/s, instead of a duration.
    #[arg(long, value_name = "MM/S")]
    pub speed_mm_s: Option<Milli>,
    /// Speed towards home in mm/s; by default the same as away from home.
    #[arg(long, value_name = "MM/S", requires = "speed_mm_s")]
    pub return_speed_mm_s: Option<Milli>,
    /// Acceleration of every ramp in mm/s2.
    #[arg(long, value_name = "MM/S2", default_value = "100")]
    pub accel_mm_s2: Milli,
    /// Pause at the far end in s.
    #[arg(long, value_name = "S", default_value = "0")]
    pub far_dwell_s: ShortSeconds,
    /// Pause at home between two cycles in s.
    #[arg(long, value_name = "S", default_value = "0")]
    pub home_dwell_s: ShortSeconds,
    /// Pause before the first stroke in s; part of the duration.
    #[arg(long, value_name = "S", default_value = "0")]
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
    /// The request that these arguments describe.
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
            // `waves` is in thousandths per minute. Round up, so that the run is never faster than requested.
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
pub fn above_zero<T>(text: &str) -> Result<T, String>
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

fn cycles(text: &str) -> Result<u16, String> {
    let outside = || format!("use 1 to {MAX_CYCLES}");
    let value = match client::decimal::parse(text, 0, u64::from(MAX_CYCLES)) {
        Ok(0) | Err(DecimalError::TooLarge(_)) => return Err(outside()),
        value => value.map_err(|error| error.to_string())?,
    };
    u16::try_from(value).map_err(|_| outside())
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
    #[arg(long, value_name = "MM/S", default_value = "5")]
    pub speed_mm_s: Milli,
    /// Duration in s.
    #[arg(
        long,
        value_name = "S",
        default_value = "1",
        value_parser = above_zero::<ShortSeconds>
    )]
    pub for_s: ShortSeconds,
}

/// Arguments of `move`.
#[derive(Debug, Args)]
pub struct MoveArgs {
    /// Target, in mm from home.
    #[arg(value_name = "MM")]
    pub position_mm: Milli,
    /// Speed in mm/s.
    #[arg(long, value_name = "MM/S", default_value = "20")]
    pub speed_mm_s: Milli,
}

/// Arguments of `fold`.
#[derive(Debug, Args)]
pub struct PartialArgs {
    /// Record and recording.
    #[command(flatten)]
    pub fold: FoldArgs,
    /// Stop with this much thread on the spool, in mm from the unfolded end, winding or paying out.
    #[arg(long, value_name = "MM", conflicts_with = "indentation_mm")]
    pub thread_mm: Option<Milli>,
    /// Stop where the paper's origami is folded as an indentation of this many mm would fold it (Eq. 7).
    #[arg(long, value_name = "MM")]
    pub indentation_mm: Option<Milli>,
    /// With `--indentation-mm`: slack of the unfolded thread.
    #[arg(
        long,
        value_name = "MM",
        default_value = "1",
        requires = "indentation_mm",
        // If another argument excludes the required one, clap does not require that.
        conflicts_with = "thread_mm"
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

#[cfg(test)]
mod tests {
    use clap::{Command, FromArgMatches as _};

    use super::*;

    /// Regression: its telemetry was recorded, and then refused by its own reader.
    #[test]
    fn a_run_that_no_record_takes_up_is_refused_with_the_interval_that_does() {
        let run = |args: &str| {
            let command = RunArgs::augment_args(Command::new("run").no_binary_name(true));
            let matches = command
                .try_get_matches_from(args.split(' '))
                .expect("words");
            let run = RunArgs::from_arg_matches(&matches).expect("a run").run();
            run.map_err(|failure| failure.to_string()).err()
        };
        let long = "--cycles 10000 --duration-s 200000";
        let why = run(long).expect("20 million rows");
        assert!(why.contains("use 21 to 1000"), "{why}");
        assert_eq!(run(&format!("{long} --telemetry-ms 21")), None);
        assert_eq!(run("--cycles 1000 --duration-s 36000"), None);
    }

    /// Regression: a slack without an indentation was dropped, and the capsule folded to its end.
    #[test]
    fn a_slack_is_refused_without_its_indentation() {
        let parse = |args: &[&str]| {
            let command = PartialArgs::augment_args(Command::new("fold").no_binary_name(true));
            let matches = command.try_get_matches_from(args)?;
            PartialArgs::from_arg_matches(&matches)
        };
        for (args, says) in [
            (&["--slack-mm", "2"][..], "--indentation-mm <MM>"),
            (
                &["--thread-mm", "5", "--slack-mm", "2"],
                "cannot be used with",
            ),
        ] {
            let refused = parse(args).expect_err("no indentation").to_string();
            assert!(refused.contains(says), "{refused}");
        }
        let args = ["--slack-mm", "2", "--indentation-mm", "3"];
        let slack = parse(&args).map(|args| args.slack_mm.0);
        assert_eq!(slack.expect("both"), 2_000);
        assert!(parse(&["--thread-mm", "5"]).is_ok() && parse(&[]).is_ok());
    }
}
