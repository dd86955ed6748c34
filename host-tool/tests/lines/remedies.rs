//! Each refusal here has a remedy that is not refused as well: its command exists, and does what is wanted.

use std::fs;
use std::path::PathBuf;

use crate::support::plan::{PAPER, changed};
use crate::support::tool::{Memory, ready};
use protocol::system::DeviceKind;
use simulated_machines::machine::{Script, VIRTUAL_UID};

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

/// A folder with files, and machines that are made anew for each command.
struct Desk {
    place: tempfile::TempDir,
    machines: Memory,
}

impl Desk {
    fn of(scripts: [Script; 2]) -> Self {
        Self {
            place: tempfile::tempdir().expect("a folder"),
            machines: Memory::with(scripts.to_vec()),
        }
    }

    fn measured() -> Self {
        Self::of([ready(DeviceKind::Rig), ready(DeviceKind::Capsule)])
    }

    fn simulated() -> Self {
        Self::of([DeviceKind::Rig, DeviceKind::Capsule].map(|kind| Script {
            uid: VIRTUAL_UID,
            ..ready(kind)
        }))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.place.path().join(name)
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).expect("written");
    }

    /// Runs a command line in which `@` stands for the folder: exit code, output and errors with `@` for it.
    fn run(&self, line: &str) -> (u8, String, String) {
        let folder = format!("{}/", self.place.path().display());
        let line = line.replace('@', &folder);
        let (code, out, err) = self.machines.run(&line.split(' ').collect::<Vec<_>>());
        (code, out.replace(&folder, "@"), err.replace(&folder, "@"))
    }

    /// Runs a command line that is refused, and returns what it says.
    fn refused(&self, line: &str) -> String {
        let (code, _, err) = self.run(line);
        assert_ne!(code, 0, "{line}: {err}");
        err
    }

    fn done(&self, line: &str) -> String {
        let (code, out, err) = self.run(line);
        assert_eq!(code, 0, "{line}: {err}");
        out
    }
}

const AT: &str = "--rig 0 --capsule 1";

/// Its folder was made before; the corrected plan was refused for that, and the folder for its plan.
#[test]
fn a_plan_that_nobody_can_answer_is_refused_before_its_folder_is_made() {
    let desk = Desk::simulated();
    let lines = plan();
    let kept = lines
        .lines()
        .filter(|line| !line.starts_with("width_about_mm"));
    let bare = kept.collect::<Vec<_>>().join("\n");
    desk.write("plan.toml", &bare);
    let begin = format!("campaign run @plan.toml --out @c --yes --trials 1 {AT}");
    let err = desk.refused(&begin);
    assert!(err.contains("it has no readings.width_about_mm"), "{err}");
    assert!(!desk.path("c").exists());
    // Regression: the plan gave a reading that was refused, again and again without end.
    let fine = plan().replace("width_about_mm = 24.40", "width_about_mm = 24.43");
    let fine = fine.replace(
        "caliper_resolution_mm = 0.01",
        "caliper_resolution_mm = 0.02",
    );
    assert_ne!(fine, plan());
    desk.write("plan.toml", &fine);
    let err = desk.refused(&begin);
    assert!(err.contains("the caliper's resolution is 0.02 mm"), "{err}");
    assert!(!desk.path("c").exists());
    desk.write("plan.toml", &plan());
    desk.done(&begin);
    // A plan is fixed once its campaign has a folder.
    desk.write("plan.toml", &bare);
    desk.done("campaign new @plan.toml --out @d");
    let err = desk.refused(&format!("campaign run @d --yes {AT}"));
    assert!(
        err.contains("leave `--yes` out")
            && err.contains("`retrograde campaign run PLAN.toml --yes`"),
        "{err}"
    );
}

#[test]
fn a_folder_that_is_no_campaign_is_not_gone_on_with() {
    let desk = Desk::measured();
    desk.write("plan.toml", &plan());
    fs::create_dir(desk.path("other")).expect("made");
    let err = desk.refused("campaign new @plan.toml --out @other");
    assert!(err.contains("`--out DIR` names another folder"), "{err}");
    assert!(!err.contains("goes on"), "{err}");
    desk.done("campaign new @plan.toml --out @c");
    let err = desk.refused("campaign new @plan.toml --out @c");
    assert!(
        err.contains("`retrograde campaign run @c` goes on"),
        "{err}"
    );
    let err = desk.refused("campaign new @plan.toml --out /dev/null/x/y");
    assert!(
        err.contains("choose a folder") && err.contains("`--out DIR`"),
        "{err}"
    );
}

/// `campaign status` without a folder is refused.
#[test]
fn a_refused_edit_names_the_folder_whose_status_to_look_at() {
    let desk = Desk::simulated();
    desk.write("plan.toml", &plan());
    desk.done(&format!(
        "campaign run @plan.toml --out @c --yes --trials 1 {AT}"
    ));
    let err = desk.refused("campaign edit @c include 1");
    assert!(err.contains("`retrograde campaign status @c`"), "{err}");
    desk.done("campaign status @c");
    let err = desk.refused("campaign edit @c displacement 1 5");
    for command in ["campaign edit @c undo 1", "campaign run @c --yes"] {
        assert!(
            err.contains(&format!("`retrograde {command}`")),
            "{command}: {err}"
        );
    }
    desk.done("campaign edit @c undo 1");
    let out = desk.done(&format!("campaign run @c --yes --trials 1 {AT}"));
    assert!(out.contains("Displacement by the model"), "{out}");
}

#[test]
fn a_path_with_blanks_is_quoted_in_a_command() {
    let desk = Desk::measured();
    desk.write("plan.toml", &plan());
    let (plan, folder) = (desk.path("plan.toml"), desk.path("my study"));
    let (plan, folder) = (
        plan.to_str().expect("UTF-8"),
        folder.to_str().expect("UTF-8"),
    );
    let new = ["campaign", "new", plan, "--out", folder];
    let (code, out, err) = desk.machines.run(&new);
    assert_eq!(code, 0, "{err}");
    let wanted = format!("`retrograde campaign run '{folder}'`");
    assert!(out.contains(&wanted), "{out}");
    let (_, _, err) = desk.machines.run(&new);
    assert!(err.contains(&wanted), "{err}");
    let (_, _, err) = desk
        .machines
        .run(&["campaign", "edit", folder, "note", "hello"]);
    assert!(err.contains(&wanted), "{err}");
    let (_, _, err) = desk.machines.run(&["report", folder, "--out", "x.html"]);
    assert!(
        err.contains(&format!("`retrograde report '{folder}'`")),
        "{err}"
    );
}

/// Without `--force` it was refused again.
#[test]
fn a_campaigns_report_is_advised_with_the_options_it_needs() {
    let desk = Desk::simulated();
    desk.write("plan.toml", &plan());
    desk.done("campaign new @plan.toml --out @c");
    let err = desk.refused("report @c --out @x.html");
    assert!(err.contains("`retrograde report @c`"), "{err}");
    desk.done("report @c");
    let err = desk.refused("report @c --out @x.html");
    assert!(err.contains("`retrograde report @c --force`"), "{err}");
}

/// It advised a folder that can be written.
#[test]
fn a_model_that_cannot_be_read_is_to_be_named() {
    let desk = Desk::measured();
    for line in [
        "simulate roller --model @m.toml",
        "design --model @m.toml",
        "simulate roller --model /",
    ] {
        let err = desk.refused(line);
        assert!(
            err.contains("takes a model as TOML") && !err.contains("written"),
            "{err}"
        );
    }
}

/// `--duration-s` beside `--waves-per-minute` or `--preset` is refused.
#[test]
fn a_duration_is_advised_in_place_of_another_timing() {
    let desk = Desk::measured();
    for timing in [
        "--waves-per-minute 1000",
        "--preset paper --start-delay-s 30",
    ] {
        let err = desk.refused(&format!("run --rig 0 {timing}"));
        let advised = err.split('`').nth(1).expect("an option");
        assert!(advised.starts_with("--duration-s "), "{err}");
        assert!(
            err.contains("in place of the timing that was given"),
            "{err}"
        );
        desk.refused(&format!("plan {timing} {advised}"));
        let rest = timing.trim_start_matches("--preset paper");
        let rest = rest.trim_start_matches("--waves-per-minute 1000").trim();
        desk.done(format!("plan {advised} {rest}").trim());
    }
}

#[test]
fn a_settings_file_is_led_to_its_machine() {
    let desk = Desk::of([DeviceKind::Rig, DeviceKind::Capsule].map(Script::new));
    desk.write(
        "capsule.json",
        r#"{"name": "", "settings": {"end_force_ma": 100}}"#,
    );
    let err = desk.refused("settings --rig 0 import @capsule.json");
    assert!(
        err.contains("`retrograde settings --of capsule import @capsule.json`"),
        "{err}"
    );
    let both = r#"{"name": "", "settings": {"end_force_ma": 100, "lead_um": 4000}}"#;
    desk.write("both.json", both);
    let err = desk.refused("settings --rig 0 import @both.json");
    assert!(
        err.contains("end_force_ma is a setting of the capsule") && !err.contains("`--of`"),
        "{err}"
    );
    assert!(
        err.contains("`retrograde settings --of capsule export FILE`"),
        "{err}"
    );
    // The file is good, and no rig is concerned.
    let err = desk.refused("settings --of capsule --capsule 1 import @capsule.json");
    assert!(err.contains("again in a second"), "{err}");
    assert!(err.contains("`retrograde info capsule`"), "{err}");
}

/// It has nothing but letters.
#[test]
fn a_long_name_is_to_be_shortened() {
    let desk = Desk::measured();
    let err = desk.refused("settings --rig 0 name anamethatislongerthanarigcantake");
    assert!(err.contains("shorten it to 24 letters"), "{err}");
    desk.done("settings --rig 0 name anamethatislongerthanari");
}
