//! Lets the step compressor of Klipper's host program, compiled from its sources on this computer, time a move.
//!
//! Klipper plans on a host: its motion solver finds the instant of each step, the compressor describes them by commands
//! of equally growing intervals, and the microcontroller plays these. The exact instants stand for the solver here.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::thread;

use tempfile::TempDir;

use crate::unmeasured::FigureError;
use crate::verdicts::{Stroke, TICK_HZ};

/// Largest error that Klipper allows its compressor: 25 us (`MAX_STEPCOMPRESS_ERROR` in its `stepper.py`).
const MAX_ERROR_TICKS: u64 = TICK_HZ / 40_000;
/// Folder of its C code, and the parts that the compressor needs.
const FOLDER: &str = "klippy/chelper";
const SOURCES: [&str; 3] = ["stepcompress.c", "msgblock.c", "pyhelper.c"];

/// The compiled compressor.
pub(super) struct Compressor {
    program: PathBuf,
    /// Holds the program.
    _folder: TempDir,
}

/// A command for the microcontroller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct QueuedSteps {
    /// Tick of the first step.
    first: u64,
    interval: i64,
    steps: u64,
    /// Added to the interval after each step.
    add: i64,
}

impl QueuedSteps {
    fn parse(line: &str) -> Option<Self> {
        let mut words = line.split(' ').map(str::parse::<i64>);
        let mut next = || words.next()?.ok();
        Some(Self {
            first: next()?.try_into().ok()?,
            interval: next()?,
            steps: next()?.try_into().ok()?,
            add: next()?,
        })
    }

    /// Ticks of its steps, as the microcontroller plays them.
    fn ticks(self) -> impl Iterator<Item = u64> {
        let (mut tick, mut interval) = (self.first, self.interval);
        (0..self.steps).map(move |_| {
            let now = tick;
            interval += self.add;
            tick = tick.saturating_add_signed(interval);
            now
        })
    }
}

impl Compressor {
    /// Compiles the compressor from Klipper's sources in `klipper`.
    pub(super) fn build(klipper: &Path) -> Result<Self, FigureError> {
        let failed = |what: String| FigureError::Klipper { what };
        let folder = TempDir::with_prefix("klipper-").map_err(|error| failed(error.to_string()))?;
        let (program, sources) = (folder.path().join("compress"), klipper.join(FOLDER));
        let ours = Path::new(env!("CARGO_MANIFEST_DIR")).join("peers/klipper.c");
        let mut compiler = Command::new("cc");
        compiler.arg("-O2").arg("-I").arg(&sources).arg(ours);
        compiler.args(SOURCES.map(|source| sources.join(source)));
        compiler.arg("-lm").arg("-o").arg(&program);
        let built = compiler
            .output()
            .map_err(|error| failed(format!("cc: {error}")))?;
        succeeded(built)?;
        Ok(Self {
            program,
            _folder: folder,
        })
    }

    /// The tick of each step, and the number of commands.
    pub(super) fn run(&self, order: &Stroke) -> Result<(Vec<u64>, usize), FigureError> {
        let mut input = format!("{TICK_HZ} {MAX_ERROR_TICKS}\n");
        for step in 1..=order.steps {
            let instant_s = order.instant(step) as f64 / 1e3 / TICK_HZ as f64;
            let _ = writeln!(input, "{instant_s:.12}");
        }
        let failed = |error: std::io::Error| FigureError::Klipper {
            what: error.to_string(),
        };
        let mut command = Command::new(&self.program);
        command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = command.spawn().map_err(failed)?;
        let stdin = child.stdin.take();
        let output = thread::scope(|scope| {
            // If the program ends early, its output says why.
            scope.spawn(move || stdin.map(|mut stdin| stdin.write_all(input.as_bytes())));
            child.wait_with_output()
        });
        let commands = succeeded(output.map_err(failed)?)?;
        let commands: Option<Vec<_>> = commands.lines().map(QueuedSteps::parse).collect();
        let commands = commands.ok_or_else(|| FigureError::Klipper {
            what: "the compressor's commands cannot be read".into(),
        })?;
        let ticks = commands
            .iter()
            .flat_map(|command| command.ticks())
            .collect();
        Ok((ticks, commands.len()))
    }
}

/// Output of a program, if it succeeded.
fn succeeded(output: Output) -> Result<String, FigureError> {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    if output.status.success() {
        Ok(text(&output.stdout))
    } else {
        let what = text(&output.stderr);
        Err(FigureError::Klipper { what })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_is_played_as_the_microcontroller_plays_it() {
        let command = QueuedSteps::parse("1000 300 4 -10").expect("four numbers");
        let ticks: Vec<_> = command.ticks().collect();
        assert_eq!(ticks, [1_000, 1_290, 1_570, 1_840]);
        assert_eq!(QueuedSteps::parse("1000 300 4"), None);
        assert_eq!(QueuedSteps::parse("1000 300 -4 1"), None);
    }
}
