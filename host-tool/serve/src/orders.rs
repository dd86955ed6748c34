//! Turns the body of a request into an order. It uses the arguments of the command line, so that fields, defaults and
//! refusals are the same.

use clap::{Args, Command};
use lab::trials::experiment::Actuation;
use protocol::capsule::ActuationKind;
use protocol::rig::{Jog, MoveTo, Run};
use protocol::system::DeviceKind;
use serde_json::{Map, Value, json};

use lab::operations::arguments::{JogArgs, MoveArgs, PartialArgs, RecordArgs, RunArgs};
use lab::operations::failure::{self, Failure};
use lab::operations::folding;

#[derive(Debug)]
pub enum Work {
    Home,
    Run(Run, RecordArgs),
    Move(MoveTo),
    Jog(Jog),
    Hold,
    Resume,
    Acknowledge,
    Actuate(Actuation, RecordArgs),
}

/// Fields of a recorded action, named after the command's options.
const RECORD: [&str; 2] = ["telemetry_ms", "note"];
const FOLD: [&str; 5] = [
    "thread_mm",
    "indentation_mm",
    "slack_mm",
    "telemetry_ms",
    "note",
];
/// Fields of a run.
pub const RUN: [&str; 14] = [
    "cycles",
    "stroke_mm",
    "duration_s",
    "speed_mm_s",
    "return_speed_mm_s",
    "waves_per_minute",
    "preset",
    "accel_mm_s2",
    "far_dwell_s",
    "home_dwell_s",
    "start_delay_s",
    "on_link_loss",
    "telemetry_ms",
    "note",
];

impl Work {
    /// Reads the body of `POST /api/v1/MACHINE/NAME`; `None` if there is no such command.
    pub fn read(
        machine: DeviceKind,
        name: &str,
        body: &Map<String, Value>,
    ) -> Option<Result<Self, Failure>> {
        let alone = |work| words(&[], None, body).map(|_| work);
        let actuation = |kind: ActuationKind| {
            parse(&RECORD, None, body).map(|record| Self::Actuate(kind.into(), record))
        };
        Some(match (machine, name) {
            (DeviceKind::Rig, "home") => alone(Self::Home),
            (DeviceKind::Rig, "run") => waves(body).map(|(run, record)| Self::Run(run, record)),
            (DeviceKind::Rig, "move") => {
                parse(&["speed_mm_s"], Some("position_mm"), body).map(|args: MoveArgs| {
                    Self::Move(MoveTo {
                        position_um: args.position_mm.0,
                        speed_um_s: args.speed_mm_s.0,
                    })
                })
            }
            (DeviceKind::Rig, "jog") => {
                parse(&["speed_mm_s"], Some("direction"), body).map(|args: JogArgs| {
                    Self::Jog(Jog {
                        direction: args.direction,
                        speed_um_s: args.speed_mm_s.0,
                    })
                })
            }
            (DeviceKind::Rig, "hold") => alone(Self::Hold),
            (DeviceKind::Rig, "resume") => alone(Self::Resume),
            (_, "ack") => alone(Self::Acknowledge),
            (DeviceKind::Capsule, "fold") => {
                parse(&FOLD, None, body).and_then(|args: PartialArgs| {
                    Ok(Self::Actuate(folding::motion(&args)?, args.fold.record))
                })
            }
            (DeviceKind::Capsule, "unfold") => actuation(ActuationKind::Unfold),
            (DeviceKind::Capsule, "reference") => actuation(ActuationKind::Reference),
            (DeviceKind::Capsule, "calibrate") => actuation(ActuationKind::Calibrate),
            (DeviceKind::Capsule, "check") => actuation(ActuationKind::CheckFolded),
            _ => return None,
        })
    }

    /// Name of the command, as in the path of its request.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Home => "home",
            Self::Run(..) => "run",
            Self::Move(_) => "move",
            Self::Jog(_) => "jog",
            Self::Hold => "hold",
            Self::Resume => "resume",
            Self::Acknowledge => "ack",
            Self::Actuate(motion, _) => match motion.kind {
                ActuationKind::Reference => "reference",
                ActuationKind::Calibrate => "calibrate",
                ActuationKind::CheckFolded => "check",
                ActuationKind::Fold | ActuationKind::FoldTo => "fold",
                ActuationKind::Unfold => "unfold",
            },
        }
    }

    /// The requested values, as JSON.
    pub fn requested(&self) -> Value {
        match self {
            Self::Run(run, _) => json!(run),
            Self::Move(to) => json!(to),
            Self::Jog(jog) => json!(jog),
            Self::Actuate(motion, _) if motion.kind == ActuationKind::FoldTo => {
                json!({ "thread_um": motion.target_um })
            }
            _ => json!({}),
        }
    }

    /// Whether only the owner of the line may send it.
    pub fn is_for_owner(&self) -> bool {
        !matches!(self, Self::Hold | Self::Resume | Self::Acknowledge)
    }
}

/// A run from the body of `POST /api/v1/plan`.
pub fn run(body: &Map<String, Value>) -> Result<Run, Failure> {
    waves(body).map(|(run, _)| run)
}

fn waves(body: &Map<String, Value>) -> Result<(Run, RecordArgs), Failure> {
    let args: RunArgs = parse(&RUN, None, body)?;
    Ok((args.run()?, args.record))
}

/// Parses the arguments of one command. The whole command line has a hundred times as many, and building it would take
/// longer than the rest of the request.
fn parse<A: Args>(
    options: &[&str],
    argument: Option<&str>,
    body: &Map<String, Value>,
) -> Result<A, Failure> {
    let words = words(options, argument, body)?;
    let mut command = A::augment_args(Command::new("retrograde").no_binary_name(true));
    let parsed = command
        .try_get_matches_from_mut(words)
        .and_then(|matches| A::from_arg_matches(&matches));
    parsed.map_err(|error| {
        let usage = failure::usage(&failure::usage_text(&error));
        let why = usage["error"]["message"].as_str().unwrap_or_default();
        // Name the field, not the option: a user of the page has no command line.
        let why = command.get_arguments().fold(why.to_owned(), |why, arg| {
            why.replace(&format!("'{arg}'"), &format!("`{}`", arg.get_id()))
        });
        Failure::input(
            why,
            match argument {
                Some(field) if !body.contains_key(field) => {
                    format!("nothing was done; the field `{field}` is missing")
                }
                _ => "nothing was done; correct the value and send it again".to_owned(),
            },
        )
    })
}

/// Converts the fields to words of a command line.
fn words(
    options: &[&str],
    argument: Option<&str>,
    body: &Map<String, Value>,
) -> Result<Vec<String>, Failure> {
    let mut words = vec![];
    let mut last = None;
    for (field, value) in body {
        let known = options.contains(&field.as_str());
        if !known && argument != Some(field) {
            let fields: Vec<_> = argument.iter().chain(options).copied().collect();
            return Err(Failure::input(
                format!("there is no field `{}` here", shown(field)),
                match fields.is_empty() {
                    true => "this request has no fields: send {}".to_owned(),
                    false => format!("nothing was done; the fields are {}", fields.join(", ")),
                },
            ));
        }
        let Some(text) = text(field, value)? else {
            continue;
        };
        match known {
            true => words.push(format!("--{}={text}", field.replace('_', "-"))),
            false => last = Some(text),
        }
    }
    if let Some(last) = last {
        words.extend(["--".to_owned(), last]);
    }
    Ok(words)
}

/// A value as written on the command line; `None` if it is null.
fn text(field: &str, value: &Value) -> Result<Option<String>, Failure> {
    Ok(Some(match value {
        Value::Null => return Ok(None),
        Value::String(text) => text.clone(),
        Value::Number(number) => match (number.as_u64(), number.as_f64()) {
            (Some(whole), _) => whole.to_string(),
            // The shortest decimal that gives the same number.
            (None, Some(decimal)) => decimal.to_string(),
            (None, None) => number.to_string(),
        },
        _ => {
            return Err(Failure::input(
                format!(
                    "the field `{}` is neither a number nor a text",
                    shown(field)
                ),
                "nothing was done; write for example 130, 12.5 or \"12.5\"",
            ));
        }
    }))
}

/// The name of an unknown field, shortened and on one line.
fn shown(field: &str) -> String {
    let clean = field.chars().map(|c| if c.is_control() { ' ' } else { c });
    clean.take(40).collect()
}

#[cfg(test)]
mod tests {
    use lab::trials::experiment::PAPER_RUN;

    use super::*;

    const RIG: DeviceKind = DeviceKind::Rig;
    const BOTH: &str = r#"{"duration_s":40,"speed_mm_s":5}"#;

    fn read(machine: DeviceKind, name: &str, body: &str) -> Result<Work, Failure> {
        let body = serde_json::from_str(body).expect("JSON");
        Work::read(machine, name, &body).expect("a command")
    }

    fn a_run(body: &str) -> (Run, RecordArgs) {
        match read(RIG, "run", body) {
            Ok(Work::Run(run, record)) => (run, record),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn an_empty_run_is_the_papers_and_a_null_is_no_field() {
        for body in ["{}", r#"{"stroke_mm":null,"note":null}"#] {
            let (run, record) = a_run(body);
            assert_eq!((run, record.telemetry_ms), (PAPER_RUN, 10));
        }
    }

    #[test]
    fn a_note_is_a_note_whatever_is_in_it() {
        let note = "--on-link-loss=finish \n $(x)";
        let (run, record) = a_run(&json!({ "note": note }).to_string());
        assert_eq!((run, record.note.as_deref()), (PAPER_RUN, Some(note)));
    }

    #[test]
    fn numbers_and_texts_mean_the_same_and_are_shown_with_the_units_of_the_machine() {
        let to = json!({ "position_um": 12_500, "speed_um_s": 3_000 });
        let capsule = DeviceKind::Capsule;
        let (number, text) = (
            r#"{"position_mm":12.5,"speed_mm_s":3}"#,
            r#"{"position_mm":"12.500","speed_mm_s":"3"}"#,
        );
        let thread = json!({ "thread_um": 5_000 });
        for (machine, name, body, shown) in [
            (RIG, "move", number, to.clone()),
            (RIG, "move", text, to),
            (RIG, "home", "{}", json!({})),
            (RIG, "run", "{}", json!(PAPER_RUN)),
            (capsule, "fold", r#"{"thread_mm":5}"#, thread),
            (capsule, "fold", "{}", json!({})),
        ] {
            let work = read(machine, name, body).expect(name);
            assert_eq!(work.requested(), shown, "{name}");
        }
        let jog = read(RIG, "jog", r#"{"direction":"away"}"#).expect("good");
        assert_eq!(jog.requested()["speed_um_s"], 5_000);
    }

    #[test]
    fn a_refusal_has_the_text_of_the_command_line_and_names_the_field() {
        for (name, body, text) in [
            ("run", r#"{"stroke_mm":-5}"#, "for `stroke_mm`: negative"),
            ("run", r#"{"stroke_mm":"1,5"}"#, "a comma: write a point"),
            ("run", r#"{"stroke_mm":1.23456}"#, "than 3 decimals"),
            ("run", r#"{"duration_s":1}"#, "too little time"),
            ("run", r#"{"telemetry_ms":1}"#, "1 is not in 5 to 1000"),
            ("run", r#"{"out":"/etc"}"#, "no field `out` here"),
            ("run", r#"{"rig":"tcp:x:1"}"#, "no field `rig` here"),
            ("run", r#"{"note":["x"]}"#, "neither a number nor a text"),
            ("run", BOTH, "`duration_s` cannot be used with `speed_mm_s`"),
            ("move", "{}", "the field `position_mm` is missing"),
            ("move", r#"{"position_mm":"x"}"#, "'x' for `position_mm`"),
            ("jog", r#"{"direction":"left"}"#, "away, home"),
            ("home", r#"{"fast":true}"#, "no field `fast` here"),
        ] {
            let failure = read(RIG, name, body).expect_err(text);
            let message = failure.in_one_line();
            assert!(message.contains(text), "{message}");
            assert!(!failure.to_string().contains("--"), "{failure}");
        }
        // A value is never read as an option.
        for (name, body) in [
            ("run", r#"{"cycles":"--estop"}"#),
            ("move", r#"{"position_mm":"--speed-mm-s=9"}"#),
        ] {
            let failure = read(RIG, name, body).expect_err("refused");
            assert!(failure.to_string().contains("invalid value"), "{failure}");
        }
    }

    #[test]
    fn a_hold_a_resume_and_an_acknowledgement_pass_another_owner() {
        for (name, is_for_owner) in [
            ("hold", false),
            ("resume", false),
            ("ack", false),
            ("home", true),
            ("run", true),
        ] {
            let work = read(RIG, name, "{}").expect(name);
            assert_eq!(work.is_for_owner(), is_for_owner, "{name}");
        }
    }
}
