//! Each refusal here has a remedy that is not refused as well: its command exists, and does what is wanted.

use std::fs;

use crate::support::plan::{PAPER, changed};
use crate::support::tool::{Memory, ready};
use protocol::system::DeviceKind;
use simulated_machines::machine::{Script, VIRTUAL_UID};

/// Sessions at a folder `@` of their own: lines with `$` succeed, lines with `!` are refused with these parts.
/// `bare.toml` is a plan without an expected width, `odd.toml` one with a width that its caliper cannot show.
const SESSIONS: [&str; 9] = [
    r"
! campaign run @bare.toml --out @c --yes --trials 1 AT | it has no readings.width_about_mm
! campaign run @odd.toml --out @c --yes --trials 1 AT | the caliper's resolution is 0.02 mm
$ campaign run @plan.toml --out @c --yes --trials 1 AT
$ campaign new @bare.toml --out @d
! campaign run @d --yes AT | leave `--yes` out | `retrograde campaign run PLAN.toml --yes`",
    r"
! campaign new @plan.toml --out @other | `--out DIR` names another folder
$ campaign new @plan.toml --out @c
! campaign new @plan.toml --out @c | `retrograde campaign run @c` continues
! campaign new @plan.toml --out /dev/null/x/y | take another path | `--out DIR`",
    r"
$ campaign run @plan.toml --out @c --yes --trials 1 AT
! campaign edit @c include 1 | `retrograde campaign status @c`
$ campaign status @c
! campaign edit @c displacement 1 5 | `retrograde campaign edit @c undo 1` | `retrograde campaign run @c --yes`
$ campaign edit @c undo 1
$ campaign run @c --yes --trials 1 AT",
    r"
$ campaign new @plan.toml --out @c
! report @c --out @x.html | `retrograde report @c`
$ report @c
! report @c --out @x.html | `retrograde report @c --force`
$ report @c --force",
    r"
! simulate roller --model @m.toml | takes a model as TOML
! design --model @m.toml | takes a model as TOML
! simulate roller --model / | takes a model as TOML",
    r"
! run --rig 0 --waves-per-minute 1000 | `--duration-s 31.430613` in place of the timing that was given
! plan --waves-per-minute 1000 --duration-s 31.430613 | cannot be used with
$ plan --duration-s 31.430613",
    r"
! settings --rig 0 import @capsule.json | `retrograde settings --of capsule import @capsule.json`
! settings --rig 0 import @both.json | a setting of the capsule | `retrograde settings --of capsule export FILE`",
    // The file is good, and no rig is concerned.
    r"
! settings --of capsule --capsule 1 import @capsule.json | try again in a second | `retrograde info capsule`",
    r"
! settings --rig 0 name anamethatislongerthanarigcantake | shorten it to 24 letters
$ settings --rig 0 name anamethatislongerthanari",
];

/// The paper's plan with one trial of each condition, and short runs.
fn plan() -> String {
    let changes = [
        ("repeats = 10", "repeats = 1"),
        ("cycles = 5", "cycles = 1"),
        ("duration_s = 40", "duration_s = 8"),
        ("telemetry_ms = 10 ", "telemetry_ms = 50 "),
        ("count = 5", "count = 2"),
    ];
    changed(PAPER, &changes)
}

fn files() -> [(&'static str, String); 5] {
    let plan = plan();
    let about = |line: &&str| !line.starts_with("width_about_mm");
    let bare: Vec<_> = plan.lines().filter(about).collect();
    let odd = changed(
        &plan,
        &[
            ("width_about_mm = 24.40", "width_about_mm = 24.43"),
            (
                "caliper_resolution_mm = 0.01",
                "caliper_resolution_mm = 0.02",
            ),
        ],
    );
    let settings = |text: &str| format!("{{\"name\": \"\", \"settings\": {{{text}}}}}");
    [
        ("bare.toml", bare.join("\n")),
        ("odd.toml", odd),
        ("plan.toml", plan),
        ("capsule.json", settings("\"end_force_ma\": 100")),
        (
            "both.json",
            settings("\"end_force_ma\": 100, \"lead_um\": 4000"),
        ),
    ]
}

#[test]
fn no_remedy_is_refused_as_well() {
    for (index, session) in SESSIONS.iter().enumerate() {
        let place = tempfile::tempdir().expect("a folder");
        for (name, text) in files() {
            fs::write(place.path().join(name), text).expect("written");
        }
        fs::create_dir(place.path().join("other")).expect("made");
        let machines = Memory::with(
            [DeviceKind::Rig, DeviceKind::Capsule]
                .map(|kind| match index {
                    // A new capsule, whose flash is busy for a moment.
                    7 => Script::new(kind),
                    _ => Script {
                        uid: VIRTUAL_UID,
                        ..ready(kind)
                    },
                })
                .to_vec(),
        );
        let folder = format!("{}/", place.path().display());
        for row in session.trim().lines() {
            let mut parts = row[2..].split(" | ");
            let line = parts.next().expect("a command");
            let line = line
                .replace("AT", "--rig 0 --capsule 1")
                .replace('@', &folder);
            let (code, _, err) = machines.run(&line.split(' ').collect::<Vec<_>>());
            let err = err.replace(&folder, "@");
            assert_eq!(code == 0, row.starts_with('$'), "{row}: {err}");
            for part in parts {
                assert!(err.contains(part), "{row}: {err}");
            }
        }
        // A refused plan has made no folder.
        assert!(index != 0 || place.path().join("c").is_dir());
    }
}
