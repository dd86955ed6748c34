//! The record of a trial: telemetry as CSV in device time, and a JSON sidecar with everything else.
//!
//! Both files exist before anything moves. The CSV is flushed about four times a second, and the sidecar says `running`
//! until the trial has ended: after a crash of the host the data is readable and not mistaken for complete. All numbers
//! in the CSV come from the device, so the same run gives the same bytes.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead};
use std::path::{Path, PathBuf};

use client::identity::{IdentityRecord, Origin, tool};
use client::plain::{self, replace};
use client::{Begun, Observer, Progress, decimal, limited, named, wording};
use jiff::Timestamp;
use miette::Diagnostic;
use protocol::capsule::{ActuationAccepted, ActuationKind, ActuationOutcome, ActuationRecord};
use protocol::rig::{RigStatus, Run, RunAccepted, RunOutcome, RunRecord, Stroke};
use protocol::system::Event;
use protocol::table::{SCHEMA_KEY, Telemetry};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::trials::check;
use crate::trials::cue::Coordination;
pub use crate::trials::status::Status;
use crate::trials::writer::{Appender, Writer};

/// Version of the sidecar's format; incremented when a field changes its meaning or its name.
pub const FORMAT: u32 = 2;

/// Beginning of the error of a record whose telemetry is incomplete.
const CUT: &str = "the telemetry was not recorded whole";

/// Why a file of a trial could not be written or read.
#[derive(Clone, Debug, thiserror::Error, Diagnostic)]
#[error("{path}: {why}", path = path.display())]
#[diagnostic(code(retrograde::record), help("{remedy}"))]
pub struct RecordError {
    pub path: PathBuf,
    pub why: String,
    pub remedy: String,
}

/// End of a remedy for records outside of a campaign.
pub const ELSEWHERE: &str = ", or choose another folder: `--out DIR`";

impl RecordError {
    pub fn new(path: &Path, why: impl ToString, remedy: impl ToString) -> Self {
        Self {
            path: path.to_owned(),
            why: why.to_string(),
            remedy: remedy.to_string(),
        }
    }

    /// Error for a record that cannot be written.
    pub fn write(path: &Path, why: impl Into<io::Error>) -> Self {
        let why = why.into();
        Self::new(path, &why, format!("{}{ELSEWHERE}", named::remedy(&why)))
    }

    /// Error for rows that cannot be written.
    pub fn rows(path: &Path, why: csv::Error) -> Self {
        match why.into_kind() {
            csv::ErrorKind::Io(io) => Self::write(path, io),
            kind => Self::write(path, io::Error::other(format!("{kind:?}"))),
        }
    }

    /// Error for a record that cannot be read.
    pub fn read(path: &Path, why: impl ToString) -> Self {
        let remedy = "give the JSON file of a trial that `retrograde run` or `retrograde fold` wrote, beside its CSV file";
        Self::new(path, why, remedy)
    }
}

/// Screw and stroke of the rig.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Screw {
    /// Travel per turn, um.
    pub lead_um: u32,
    /// Microsteps per turn.
    pub steps_per_rev: u32,
    /// Configured stroke, um.
    pub stroke_um: u32,
}

impl From<&RigStatus> for Screw {
    fn from(status: &RigStatus) -> Self {
        Self {
            lead_um: status.lead_um,
            steps_per_rev: status.steps_per_rev,
            stroke_um: status.stroke_um,
        }
    }
}

impl Screw {
    /// A position in nanometres, rounded to the nearest.
    #[must_use]
    pub fn nm(&self, steps: i64) -> i64 {
        let numerator = i128::from(steps) * i128::from(self.lead_um) * 1_000;
        let denominator = i128::from(self.steps_per_rev.max(1));
        i64::try_from((numerator + denominator / 2).div_euclid(denominator)).unwrap_or(i64::MAX)
    }

    /// Whole steps up to a position, rounded down as the rig does.
    #[must_use]
    pub fn steps(&self, um: u32) -> i32 {
        let steps = u64::from(um) * u64::from(self.steps_per_rev) / u64::from(self.lead_um.max(1));
        i32::try_from(steps).unwrap_or(i32::MAX)
    }

    /// A position in millimetres, for plots.
    #[must_use]
    pub fn mm(&self, steps: f64) -> f64 {
        steps * f64::from(self.lead_um) / f64::from(self.steps_per_rev.max(1)) / 1_000.0
    }
}

/// A run as planned by the rig.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Achieved {
    /// Number of the run since the device's start.
    pub run: u32,
    /// Strokes away from home.
    pub forward: Stroke,
    /// Strokes towards home.
    pub back: Stroke,
    /// Duration in ticks of 10 ns, with the start delay.
    pub total_ticks: u64,
    /// Steps of the whole run.
    pub edges: u64,
    /// Fingerprint of the plan, 16 hex digits.
    pub plan_hash: String,
}

impl From<&RunAccepted> for Achieved {
    fn from(accepted: &RunAccepted) -> Self {
        Self {
            run: accepted.run,
            forward: accepted.forward,
            back: accepted.back,
            total_ticks: accepted.total_ticks,
            edges: accepted.edges,
            plan_hash: format!("{:016x}", accepted.plan_hash),
        }
    }
}

/// A run as recorded by the rig.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Executed {
    pub outcome: RunOutcome,
    /// Completed strokes.
    pub strokes: u32,
    /// Steps that the generator emitted.
    pub commanded_edges: u64,
    /// Steps that the read-back counter saw at the pin.
    pub counted_edges: u64,
    /// Duration by the step timer, ticks of 10 ns.
    pub ticks: u64,
    /// Fingerprint of the plan, 16 hex digits.
    pub plan_hash: String,
    /// Smallest commanded position.
    pub min_steps: i32,
    /// Largest commanded position.
    pub max_steps: i32,
    /// Largest residual of the step-loss check.
    pub worst_residual_steps: i32,
    /// Shortest queue of prepared timer periods; none if every path was queued as a whole.
    pub min_queue: Option<u16>,
    /// False pulses on the limit inputs.
    pub glitches: u32,
    /// Number of holds.
    pub holds: u32,
    /// Fingerprint of the firmware's image, 8 hex digits, as `retrograde health` shows it.
    pub image_hash: String,
    /// Steps prepared: those emitted plus those that a cut held back.
    pub prepared_edges: u64,
    /// Steps whose time was captured at the pin and compared with the plan; 0 if none was timed.
    pub edges_timed: u64,
    /// Largest difference between a captured interval and the planned one, ticks of 10 ns.
    pub worst_interval_error_ticks: u32,
}

impl From<&RunRecord> for Executed {
    fn from(record: &RunRecord) -> Self {
        Self {
            outcome: record.outcome,
            strokes: record.strokes,
            commanded_edges: record.commanded_edges,
            counted_edges: record.counted_edges,
            ticks: record.ticks,
            plan_hash: format!("{:016x}", record.plan_hash),
            min_steps: record.min_steps,
            max_steps: record.max_steps,
            worst_residual_steps: record.worst_residual_steps,
            min_queue: record.min_queue,
            glitches: record.glitches,
            holds: record.holds,
            image_hash: format!("{:08x}", record.image_hash),
            prepared_edges: record.prepared_edges,
            edges_timed: record.edges_timed,
            worst_interval_error_ticks: record.worst_interval_error_ticks,
        }
    }
}

/// The action of a trial.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
// Only a few exist at a time, so their size does not matter.
#[allow(clippy::large_enum_variant)]
pub enum Action {
    /// A run of the rig.
    Run {
        screw: Screw,
        /// As requested by the operator.
        requested: Run,
        /// As planned by the rig; none if it refused.
        achieved: Option<Achieved>,
        /// As executed; none if the host lost the rig.
        executed: Option<Executed>,
    },
    /// An actuation of the capsule.
    Actuation {
        actuation: ActuationKind,
        /// As accepted; none if it was refused.
        accepted: Option<ActuationAccepted>,
        /// As executed; none if the host lost the capsule.
        record: Option<ActuationRecord>,
    },
}

/// The sidecar.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct TrialRecord {
    /// Version of this format.
    pub format: u32,
    pub status: Status,
    /// The fault or the host's error, if there was one.
    pub error: Option<String>,
    /// Start of the trial, RFC 3339.
    #[schemars(with = "String")]
    pub started_utc: Timestamp,
    /// Note of the operator, such as the state of the capsule.
    pub note: Option<String>,
    /// Name and version of the host tool.
    pub tool: String,
    /// Protocol of the host tool.
    pub protocol: String,
    /// Schema of the host tool, 16 hex digits.
    pub schema_key: String,
    pub device: IdentityRecord,
    /// All its settings when the trial began, by name, each in the unit of its name; none in records of older tools.
    #[serde(default)]
    pub settings: BTreeMap<String, u32>,
    pub action: Action,
    /// Name of the CSV file beside this one.
    pub telemetry: String,
    /// Rows in the CSV.
    pub samples: u64,
    /// Samples that were lost on the link, or skipped by the device while it wrote its flash.
    pub missed_samples: u64,
    /// Events of the device during the trial, in order.
    pub events: Vec<Event>,
    /// Events that the device dropped before they were fetched.
    pub lost_events: u32,
    /// How the start was coordinated with a run, if it was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub coordination: Option<Coordination>,
}

impl TrialRecord {
    /// The record of a trial before its start.
    #[must_use]
    pub fn new(
        action: Action,
        device: IdentityRecord,
        settings: BTreeMap<String, u32>,
        recording: &Recording,
    ) -> Self {
        Self {
            format: FORMAT,
            status: Status::Running,
            error: None,
            started_utc: recording.now,
            note: recording.note.clone(),
            tool: tool(),
            protocol: format!("{}.{}", protocol::VERSION.major, protocol::VERSION.minor),
            schema_key: format!("{SCHEMA_KEY:016x}"),
            device,
            settings,
            action,
            telemetry: String::new(),
            samples: 0,
            missed_samples: 0,
            events: vec![],
            lost_events: 0,
            coordination: None,
        }
    }

    /// Whether the machine has accepted the action. A refused one never began and does not count as a trial.
    #[must_use]
    pub const fn has_begun(&self) -> bool {
        match &self.action {
            Action::Run { achieved, .. } => achieved.is_some(),
            Action::Actuation { accepted, .. } => accepted.is_some(),
        }
    }

    /// Why the record is incomplete; none if it is complete. The motion may have ended as planned nevertheless. Every
    /// reader of records calls this.
    #[must_use]
    pub fn not_whole(&self) -> Option<&str> {
        if self.status == Status::Running {
            return Some("no end is recorded: it is under way, or was cut off");
        }
        self.error.as_deref().filter(|error| error.contains(CUT))
    }

    /// Notes how the trial ended.
    fn end(&mut self, ending: Ending) {
        match (&mut self.action, ending) {
            (Action::Run { executed, .. }, Ending::Run(record)) => {
                self.status = record.outcome.into();
                if let RunOutcome::Faulted(fault) = record.outcome {
                    self.error = Some(fault.to_string());
                }
                *executed = Some(Executed::from(&record));
            }
            (Action::Actuation { record: slot, .. }, Ending::Actuation(record)) => {
                self.status = record.outcome.into();
                if let ActuationOutcome::Faulted(fault) = record.outcome {
                    self.error = Some(fault.to_string());
                }
                *slot = Some(record);
            }
            (_, Ending::Refused(why)) => {
                self.status = Status::Refused;
                self.error = Some(why);
            }
            (_, Ending::Lost(error)) => {
                self.status = Status::Unknown;
                self.error = Some(error);
            }
            (_, Ending::Run(_) | Ending::Actuation(_)) => {
                self.status = Status::Unknown;
                self.error = Some("the record of another kind of action".to_owned());
            }
        }
    }

    /// Reads a sidecar.
    ///
    /// # Errors
    /// It cannot be read or is not a sidecar of this format.
    pub fn read(path: &Path) -> Result<Self, RecordError> {
        let text =
            plain::read_text(path, limited::RECORD).map_err(|io| RecordError::read(path, io))?;
        let mut trial: Self = serde_json::from_str(&text)
            .map_err(|json| RecordError::read(path, wording::unreadable(&json)))?;
        if trial.format != FORMAT {
            let why = format!("format {}, this tool reads {FORMAT}", trial.format);
            return Err(RecordError::read(path, why));
        }
        if !plain::is_name(&trial.telemetry) {
            let why = format!(
                "its telemetry is `{}`, and telemetry lies beside its sidecar",
                trial.telemetry
            );
            return Err(RecordError::read(path, why));
        }
        let IdentityRecord { origin, uid, .. } = &trial.device;
        trial.device.origin = Origin::of_record(*origin, uid);
        Ok(trial)
    }

    /// Reads the telemetry beside a sidecar.
    ///
    /// # Errors
    /// The file or one of its rows cannot be read.
    pub fn samples<T: DeserializeOwned>(&self, sidecar: &Path) -> Result<Vec<T>, RecordError> {
        let mut samples = vec![];
        let wrong = check::read(sidecar, self, |sample| samples.push(sample));
        wrong.map_or(Ok(samples), |why| Err(RecordError::read(sidecar, why)))
    }
}

/// A row of the rig's telemetry.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct RigSample {
    /// Device time, us.
    pub time_us: u64,
    /// State of the machine, in lower case with underscores.
    pub state: String,
    /// Position by the read-back counter, mm, exact to the nanometre.
    #[schemars(with = "f64")]
    pub position_mm: String,
    /// Mean speed since the previous sample, mm/s.
    #[schemars(with = "f64")]
    pub speed_mm_s: String,
    /// Stroke in progress, from 0.
    pub stroke: u32,
    /// Position by the read-back counter, steps.
    pub position_steps: i32,
    /// Position by the step generator, steps.
    pub commanded_steps: i32,
    /// Residual of the step-loss check, steps.
    pub residual_steps: i32,
    pub home_flag_open: bool,
    pub far_limit_open: bool,
    pub estop_loop_open: bool,
    /// Samples lost just before this one.
    pub missed: u16,
    #[serde(default)]
    pub origin: Origin,
}

/// A row of the capsule's telemetry.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[schemars(deny_unknown_fields)]
pub struct CapsuleSample {
    /// Device time, us.
    pub time_us: u64,
    /// State of the machine, in lower case with underscores.
    pub state: String,
    pub thread_um: i32,
    pub current_ma: u16,
    pub battery_mv: u16,
    pub drive_mv: i16,
    /// Samples lost just before this one.
    pub missed: u16,
    #[serde(default)]
    pub origin: Origin,
}

/// Where and when a trial is recorded.
#[derive(Clone, Debug)]
pub struct Recording {
    /// Folder; created if missing.
    pub folder: PathBuf,
    /// Prefix of the file names.
    pub stem: String,
    /// Start of the trial, in the file names and the sidecar.
    pub now: Timestamp,
    pub note: Option<String>,
    /// Interval of telemetry, 5..=1000 ms.
    pub telemetry_ms: u16,
}

/// Writes the two files of a trial while it runs.
pub struct Recorder {
    csv_path: PathBuf,
    csv: csv::Writer<Appender>,
    writer: Writer,
    sidecar: PathBuf,
    trial: TrialRecord,
    /// The first error in building rows or text.
    failed: Option<RecordError>,
    /// Whether the observer knows of an error.
    reported: bool,
    /// The fault latched after the action had ended.
    latched: Option<String>,
}

impl Recorder {
    /// Creates both files; never overwrites one.
    pub fn create(mut trial: TrialRecord, recording: &Recording) -> Result<Self, RecordError> {
        let folder = &recording.folder;
        let stamp = recording.now.strftime("%Y%m%dT%H%M%SZ");
        let name = format!("{}-{stamp}", recording.stem);
        let (csv_path, file) = create_new(folder, &name)?;
        trial.telemetry = csv_path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        let sidecar = csv_path.with_extension("json");
        let writer =
            Writer::new(csv_path.clone(), file).map_err(|io| RecordError::write(&csv_path, io))?;
        // Nothing moves yet, so the disk may be slow and an error is reported at once.
        json(&trial)
            .and_then(|bytes| replace(&sidecar, &bytes))
            .map_err(|io| RecordError::write(&sidecar, io))?;
        Ok(Self {
            sidecar,
            csv: csv::Writer::from_writer(writer.appender()),
            writer,
            csv_path,
            trial,
            failed: None,
            reported: false,
            latched: None,
        })
    }

    #[must_use]
    pub fn sidecar(&self) -> &Path {
        &self.sidecar
    }

    #[must_use]
    pub fn csv(&self) -> &Path {
        &self.csv_path
    }

    /// Whether the machine has accepted the action.
    pub(crate) fn has_begun(&self) -> bool {
        self.trial.has_begun()
    }

    /// Notes how the start was coordinated with a run.
    pub(crate) fn coordinated(&mut self, coordination: Coordination) {
        self.trial.coordination = Some(coordination);
    }

    /// Notes the fault latched after a stopped action. An emergency stop at rest is not in the device's record, but it
    /// still costs the position.
    pub(crate) fn latched(&mut self, fault: Option<String>) {
        self.latched = fault;
    }

    /// The first error in writing. Returned once, as soon as it is known, so that the observer can still stop the
    /// trial.
    pub fn news(&mut self) -> Option<RecordError> {
        if self.reported {
            return None;
        }
        let failure = self.failure();
        self.reported = failure.is_some();
        failure
    }

    /// The first error in writing so far.
    fn failure(&self) -> Option<RecordError> {
        (self.failed.as_ref())
            .or_else(|| self.writer.failure())
            .cloned()
    }

    /// Completes the record with the end of the trial and the device's record of it.
    ///
    /// # Errors
    /// The first error in writing, including those during the trial.
    pub fn finish(mut self, ending: Ending, lost_events: u32) -> Result<TrialRecord, RecordError> {
        self.trial.end(ending);
        if let Some(fault) = self.latched.take() {
            self.trial.status = Status::Faulted;
            self.trial.error = Some(fault);
        }
        self.trial.lost_events = lost_events;
        self.flush();
        drop(self.csv);
        let written = self.writer.finish();
        let failure = self.failed.or(written.err());
        if let Some(failure) = &failure {
            self.trial.samples = keep_whole_rows(&self.csv_path).unwrap_or(0);
            // Keep the fault, if there was one: `TrialRecord::not_whole` searches the text for this error.
            let cut = Some(format!("{CUT}: {failure}"));
            let errors = self.trial.error.take().into_iter().chain(cut);
            self.trial.error = Some(errors.collect::<Vec<_>>().join("; "));
        }
        // Write the sidecar even after a failure: it says how the trial ended.
        let written = json(&self.trial)
            .and_then(|bytes| replace(&self.sidecar, &bytes))
            .map_err(|io| RecordError::write(&self.sidecar, io));
        match failure {
            Some(error) => Err(error),
            None => written.map(|()| self.trial),
        }
    }

    fn row(&mut self, row: impl Serialize) {
        if self.trial.samples == plain::ROWS {
            let why = format!("it has {} rows, the most of a record", plain::ROWS);
            let remedy = "take a longer interval, `--telemetry-ms`, or a shorter run";
            self.failed
                .get_or_insert_with(|| RecordError::new(&self.csv_path, why, remedy));
            return;
        }
        self.trial.samples += 1;
        if let Err(error) = self.csv.serialize(row) {
            self.failed
                .get_or_insert(RecordError::rows(&self.csv_path, error));
        }
    }

    fn flush(&mut self) {
        if let Err(io) = self.csv.flush() {
            self.failed
                .get_or_insert(RecordError::write(&self.csv_path, io));
        }
    }

    fn write_sidecar(&mut self) {
        match json(&self.trial) {
            Ok(bytes) => self.writer.replace(self.sidecar.clone(), bytes),
            Err(io) => {
                self.failed
                    .get_or_insert(RecordError::write(&self.sidecar, io));
            }
        }
    }
}

/// Truncates an incomplete last row of a file after a failed write. Returns the number of complete rows.
fn keep_whole_rows(csv: &Path) -> io::Result<u64> {
    let file = plain::open_to_write(csv)?;
    let mut reader = io::BufReader::new(&file);
    let (mut line, mut lines, mut whole) = (vec![], 0_u64, 0);
    loop {
        line.clear();
        let count = reader.read_until(b'\n', &mut line)?;
        if line.last() != Some(&b'\n') {
            break;
        }
        (lines, whole) = (lines + 1, whole + count as u64);
    }
    file.set_len(whole)?;
    // The first line is the header.
    Ok(lines.saturating_sub(1))
}

/// Text of a JSON file.
pub fn json(value: &impl Serialize) -> io::Result<Vec<u8>> {
    let mut bytes = serde_json::to_vec_pretty(value)?;
    bytes.push(b'\n');
    Ok(bytes)
}

/// The machine's record of a trial, or why there is none.
#[derive(Clone, Debug)]
pub enum Ending {
    /// The rig's record of a run.
    Run(RunRecord),
    /// The capsule's record.
    Actuation(ActuationRecord),
    /// The reason why it never began.
    Refused(String),
    /// The reason why there is no record.
    Lost(String),
}

impl Observer for Recorder {
    fn begun(&mut self, begun: &Begun) {
        match (&mut self.trial.action, begun) {
            (Action::Run { achieved, .. }, Begun::Run(run)) => {
                *achieved = Some(Achieved::from(run));
            }
            (Action::Actuation { accepted, .. }, Begun::Actuation(actuation)) => {
                *accepted = Some(*actuation);
            }
            _ => {}
        }
        self.write_sidecar();
    }

    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        self.trial.missed_samples += u64::from(missed);
        let origin = self.trial.device.origin;
        match (sample, &self.trial.action) {
            (Telemetry::Rig(rig), Action::Run { screw, .. }) => {
                let position_nm = screw.nm(rig.position_steps.into());
                self.row(RigSample {
                    time_us: rig.time_us,
                    state: wording::name(&rig.state),
                    position_mm: decimal::write_signed(position_nm, 6),
                    speed_mm_s: decimal::write_signed(rig.speed_um_s.into(), 3),
                    stroke: rig.stroke,
                    position_steps: rig.position_steps,
                    commanded_steps: rig.commanded_steps,
                    residual_steps: rig.residual_steps,
                    home_flag_open: rig.inputs.home_flag,
                    far_limit_open: rig.inputs.far_limit,
                    estop_loop_open: rig.inputs.estop_loop,
                    missed,
                    origin,
                });
            }
            (Telemetry::Capsule(capsule), Action::Actuation { .. }) => self.row(CapsuleSample {
                time_us: capsule.time_us,
                state: wording::name(&capsule.state),
                thread_um: capsule.thread_um,
                current_ma: capsule.current_ma,
                battery_mv: capsule.battery_mv,
                drive_mv: capsule.drive_mv,
                missed,
                origin,
            }),
            _ => {}
        }
    }

    fn event(&mut self, event: &Event) {
        self.trial.events.push(*event);
    }

    fn progress(&mut self, _: &Progress) {
        self.flush();
    }
}

/// Creates a CSV file under a name that no CSV or sidecar uses yet, and its folder if that is missing.
pub fn create_new(folder: &Path, name: &str) -> Result<(PathBuf, File), RecordError> {
    fs::create_dir_all(folder).map_err(|io| RecordError::write(folder, io))?;
    for number in 1..=9_999 {
        let suffix = if number == 1 {
            String::new()
        } else {
            format!("-{number}")
        };
        let path = folder.join(format!("{name}{suffix}.csv"));
        if path.with_extension("json").exists() {
            continue;
        }
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => return Ok((path, file)),
            Err(io) if io.kind() == io::ErrorKind::AlreadyExists => {}
            Err(io) => return Err(RecordError::write(&path, io)),
        }
    }
    Err(RecordError::write(
        folder,
        io::Error::other("too many trials started in this second"),
    ))
}

#[cfg(test)]
pub(crate) mod tests;
