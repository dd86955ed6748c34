//! Settings on the command line: an import checks its whole file first, and each refusal says what is allowed.

use std::fs;
use std::path::PathBuf;

use crate::support::tool::{Memory, ready};
use protocol::settings::SettingKey;
use protocol::system::DeviceKind;
use serde_json::Value;
use simulated_machines::machine::{Log, Script};
use tempfile::TempDir;

/// A rig and a folder for files.
struct Bench {
    rig: Memory,
    folder: TempDir,
}

impl Bench {
    fn new(script: Script) -> Self {
        Self {
            rig: Memory::with(vec![script]),
            folder: tempfile::tempdir().expect("folder"),
        }
    }

    fn file(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn settings(&self, args: &[&str]) -> (u8, String, String) {
        self.rig.run(&[&["--rig", "0", "settings"], args].concat())
    }

    fn import(&self, text: &str) -> (u8, String, String) {
        let file = self.file("import.json");
        fs::write(&file, text).expect("written");
        self.settings(&["import", file.to_str().expect("UTF-8")])
    }

    /// Reads the log of the last rig that was connected.
    fn log<T>(&self, ask: impl FnOnce(&Log) -> T) -> T {
        let logs = self.rig.logs.lock().expect("logs");
        ask(&logs.last().expect("a rig").lock().expect("log"))
    }

    fn values(&self) -> Vec<u32> {
        self.log(Log::settings)
    }

    fn value(&self, key: SettingKey) -> u32 {
        self.values()[key as usize]
    }

    fn name(&self) -> String {
        self.log(Log::name)
    }

    fn heard(&self, name: &str) -> usize {
        let heard = self.rig.heard();
        heard.iter().filter(|heard| **heard == name).count()
    }
}

fn rig() -> Bench {
    Bench::new(ready(DeviceKind::Rig))
}

/// Files, and what is said of them. `BELL` is a control character.
const WRONG: &str = r#"
no JSON => this is not JSON at line 1 column 2
{"settings": {}} => missing field `name`
{"name": "", "settings": []} => settings
{"name": "", "settings": {}, "setings": {}} => unknown field `setings`
{"name": "", "name": "x", "settings": {}} => duplicate field `name`
{"name": 5, "settings": {}} => name: 5 is not text
{"name": "a name of twenty-five bytes", "settings": {}} => the name has 27 bytes
{"name": "BELL", "settings": {}} => the name has a control character
{"name": "", "settings": {"dead_man_ms": 350, "lead": 4000}} => there is no setting `lead`
{"name": "", "settings": {"dead_man_ms": 350, "dead_man_ms": 360}} => dead_man_ms appears twice
{"name": "", "settings": {"dead_man_ms": 350, "lead_um": 4.5}} => lead_um cannot be 4.5: settings are whole numbers
{"name": "", "settings": {"dead_man_ms": 350, "lead_um": "4000"}} => lead_um cannot be "4000"
{"name": "", "settings": {"dead_man_ms": 350, "lead_um": -1}} => lead_um cannot be -1
{"name": "", "settings": {"dead_man_ms": 350, "microsteps": 5000000000}} => microsteps is 5000000000, allowed is 1 to 256
{"name": "", "settings": {"lead": 1, "microsteps": 512}} => `lead` => microsteps is 512, allowed is 1 to 256
{"name": "", "settings": {"end_force_ma": 100}} => these are the settings of a capsule, not of a rig"#;

#[test]
fn a_file_with_anything_wrong_is_refused_before_the_first_change() {
    for row in WRONG.trim().lines() {
        let mut parts = row.split(" => ");
        let text = parts.next().expect("a file").replace("BELL", "\\u0007");
        let bench = rig();
        let (code, _, err) = bench.import(&text);
        assert_eq!(code, 2, "{row}: {err}");
        assert!(parts.all(|says| err.contains(says)), "{row}: {err}");
        assert!(err.contains("import.json"), "{err}");
        assert!(bench.rig.heard().is_empty(), "{row}: something was sent");
    }
}

#[test]
fn an_import_sets_the_values_in_the_order_of_the_file_and_the_name_at_last() {
    let bench = rig();
    let text = r#"{"name": "left bench",
        "settings": {"pull_off_um": 500, "flag_um": 500, "stroke_um": 2000}}"#;
    let (code, out, err) = bench.import(text);
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("4 settings changed"), "{out}");
    assert!(out.contains("name from \"\" to \"left bench\""), "{out}");
    assert_eq!(bench.value(SettingKey::StrokeUm), 2_000);
    assert_eq!(bench.name(), "left bench");
    assert!(err.contains("`retrograde home`"), "{err}");
}

#[test]
fn an_import_ends_at_the_first_refusal_and_says_what_was_set() {
    let rule =
        r#"{"name": "new", "settings": {"dead_man_ms": 350, "stroke_um": 2000, "seek_um_s": 500}}"#;
    let first = r#"{"name": "new", "settings": {"stroke_um": 2000, "dead_man_ms": 350}}"#;
    for (text, set, dead_man_ms) in [
        // A rule between settings that only the rig knows.
        (
            rule,
            "before it these were set: dead_man_ms from 300 to 350",
            350,
        ),
        (first, "nothing was changed before", 300),
    ] {
        let bench = rig();
        let (code, _, err) = bench.import(text);
        assert_eq!(code, 3, "{err}");
        assert!(
            err.contains("import.json: stroke_um: test rig refused"),
            "{err}"
        );
        assert!(err.contains(set), "{err}");
        assert_eq!(bench.value(SettingKey::DeadManMs), dead_man_ms);
        assert_eq!(bench.value(SettingKey::SeekUmS), 20_000);
        assert_eq!(bench.name(), "");
    }
}

#[test]
fn a_value_that_is_none_says_what_may_be_used() {
    for (value, code, says) in [
        (
            "4.5",
            2,
            "settings are whole numbers in the unit of their name, 500 to 50000 um here",
        ),
        ("-1", 2, "settings are whole numbers"),
        ("-1.5", 2, "settings are whole numbers"),
        ("4mm", 2, "settings are whole numbers"),
        ("", 2, "settings are whole numbers"),
        ("499", 3, "lead_um is 499, allowed is 500 to 50000"),
        (
            "4294967296",
            3,
            "lead_um is 4294967296, allowed is 500 to 50000",
        ),
        (
            "99999999999999999999999",
            3,
            "lead_um is 99999999999999999999999, allowed is 500 to 50000",
        ),
    ] {
        let bench = rig();
        let (got, _, err) = bench.settings(&["set", "lead_um", value]);
        assert_eq!(got, code, "{value}: {err}");
        assert!(err.contains(says), "{value}: {err}");
        assert!(bench.rig.heard().is_empty(), "{value}");
    }
}

#[test]
fn what_the_rig_refuses_has_changed_nothing() {
    let (code, _, err) = rig().settings(&["set", "microsteps", "24"]);
    assert_eq!(code, 3, "{err}");
    assert!(err.contains("help: nothing was changed"), "{err}");
    let broken = Bench::new(Script {
        failing_writes: 0..usize::MAX,
        ..ready(DeviceKind::Rig)
    });
    let (code, _, err) = broken.settings(&["name", "new"]);
    assert_eq!(code, 3, "{err}");
    assert!(err.contains("help: nothing was changed"), "{err}");
    assert_eq!(broken.name(), "");
}

#[test]
fn a_setting_that_moves_the_positions_asks_to_home_again() {
    for (key, value, homes) in [("stroke_um", "100000", true), ("telemetry_ms", "20", false)] {
        let (code, out, err) = rig().settings(&["set", key, value]);
        assert_eq!(code, 0, "{err}");
        assert_eq!(out, format!("{key} = {value}\n"));
        assert_eq!(err.contains("`retrograde home`"), homes, "{err}");
    }
}

#[test]
fn a_name_that_no_terminal_can_show_is_refused() {
    let bench = rig();
    let (code, _, err) = bench.settings(&["name", "a\u{1b}[2Jb"]);
    assert_eq!(code, 2, "{err}");
    assert!(err.contains("control character"), "{err}");
    assert!(bench.rig.heard().is_empty());
    assert_eq!(bench.settings(&["name", "Röhre 1"]).0, 0);
    assert_eq!(bench.name(), "Röhre 1");
}

#[test]
fn an_export_replaces_a_file_only_if_told_to() {
    let bench = rig();
    let file = bench.file("rig.json");
    let path = file.to_str().expect("UTF-8");
    fs::write(&file, "precious").expect("written");
    let (code, _, err) = bench.settings(&["export", path]);
    assert_eq!(code, 3, "{err}");
    assert!(err.contains("--force") && err.contains("rig.json"), "{err}");
    assert_eq!(fs::read_to_string(&file).expect("there"), "precious");
    assert!(bench.rig.heard().is_empty());
    let (code, out, err) = bench.settings(&["export", path, "--force"]);
    assert_eq!(code, 0, "{err}");
    let all = SettingKey::of(DeviceKind::Rig).count();
    assert!(out.contains(&format!("{all} settings in ")), "{out}");
    let (code, out, err) = bench.settings(&["import", path]);
    assert_eq!(code, 0, "what export writes import reads: {err}");
    assert!(out.contains("0 settings changed"), "{out}");
    let json: Value = serde_json::from_slice(&fs::read(&file).expect("there")).expect("JSON");
    assert_eq!(json["settings"]["lead_um"], 4_000);
}

#[test]
fn a_reset_wants_a_yes() {
    let bench = rig();
    let (code, _, err) = bench.settings(&["reset"]);
    assert_eq!(code, 3, "{err}");
    assert!(err.contains("--yes"), "{err}");
    assert_eq!(bench.heard("FactoryReset"), 0);
    for (answer, code, resets) in [("no\n", 3, 0), ("", 3, 0), ("yes\n", 0, 1), ("y\n", 0, 2)] {
        let (got, _, err) = bench
            .rig
            .run_typed(&["--rig", "0", "settings", "reset"], answer);
        assert_eq!(got, code, "{answer:?}: {err}");
        assert!(err.contains("yes"), "it asks: {err}");
        assert_eq!(bench.heard("FactoryReset"), resets);
    }
    assert_eq!(bench.settings(&["reset", "--yes"]).0, 0);
    assert_eq!(bench.heard("FactoryReset"), 3);
    // The advice names the capsule: without that it would reset the rig.
    let capsule = Memory::with(vec![ready(DeviceKind::Capsule)]);
    let (code, _, err) = capsule.run(&["--capsule", "0", "settings", "--of", "capsule", "reset"]);
    assert_eq!(code, 3, "{err}");
    assert!(
        err.contains("`retrograde settings export --of capsule FILE`"),
        "{err}"
    );
    assert!(
        err.contains("`retrograde settings reset --of capsule --yes`"),
        "{err}"
    );
}
