//! Scripts of changed files.

use fuzz::documents::Kind;
use fuzz::folders::{self, FILES, Step};
use fuzz::text::Change::{self, Cut, Number, Replace, Twice, Word};

use crate::{Example, bytes, script};

/// Each kind of file as it was written, and changed in a way of its own.
pub fn of_documents() -> Vec<Example> {
    let example =
        |name, kind: Kind, changes: &[Change]| ("documents", name, script(&bytes(&kind), changes));
    vec![
        example("plan", Kind::Plan, &[]),
        example(
            "plan-numbers",
            Kind::Plan,
            &[Number(950, 3), Number(500, 8)],
        ),
        example(
            "plan-word",
            Kind::Plan,
            &[Word(50, 5), Replace(0, 6, vec![b'x'])],
        ),
        example("settings", Kind::Settings, &[]),
        example(
            "settings-number",
            Kind::Settings,
            &[Number(300, 2), Number(700, 1)],
        ),
        example("settings-word", Kind::Settings, &[Word(400, 7)]),
        example(
            "settings-name",
            Kind::Settings,
            &[Replace(20, 3, "é\u{202e}".into())],
        ),
        // The rig refuses the second one, and the first has to be put back.
        example(
            "settings-refused",
            Kind::Settings,
            &[
                Cut(0),
                Replace(
                    0,
                    0,
                    br#"{"name": "new", "settings": {"dead_man_ms": 350, "microsteps": 24}}"#
                        .to_vec(),
                ),
            ],
        ),
        example("model", Kind::Model, &[]),
        example("model-word", Kind::Model, &[Word(0, 0), Word(980, 2)]),
        example("model-number", Kind::Model, &[Number(300, 8)]),
        example("owner", Kind::Owner, &[]),
        example("owner-word", Kind::Owner, &[Word(100, 7), Word(900, 9)]),
        example("owner-cut", Kind::Owner, &[Cut(500)]),
        example(
            "commissioning",
            Kind::Commissioning,
            &[Word(200, 2), Number(900, 7)],
        ),
        example("commissioning-cut", Kind::Commissioning, &[Cut(900)]),
        example("fetched", Kind::Fetched, &[]),
        example(
            "fetched-word",
            Kind::Fetched,
            &[Word(100, 5), Number(300, 6)],
        ),
        example("fetched-cut", Kind::Fetched, &[Cut(300), Twice(0)]),
    ]
}

/// The folder as it was written, and each way in which it is changed. The first word of a name says which files.
pub fn of_folders() -> Vec<Example> {
    use Step::{Edit, Exchange, Link, Pipe, Remove, Resume, Seal, Swap};
    let example = |name, steps: &[Step]| ("folders", name, script(&[], steps));
    let [_, manifest, order, plan, _, ledger, rest @ ..] = numbers();
    let [
        conditions,
        telemetry,
        record,
        other_conditions,
        other_telemetry,
        other_record,
    ] = rest;
    vec![
        example("as-written", &[]),
        example("ledger-edited", &[Edit(ledger, Number(500, 3))]),
        example("record-sealed", &[Edit(other_record, Word(300, 5)), Seal]),
        example("ledger-row", &[Edit(ledger, Twice(800)), Resume(false)]),
        example("ledger-taken-up", &[Edit(ledger, Twice(800)), Resume(true)]),
        example("attempts-exchanged", &[Exchange, Seal]),
        example(
            "conditions-swapped",
            &[Swap(conditions, other_conditions), Seal],
        ),
        example("telemetry-linked", &[Link(telemetry, 0), Seal]),
        example(
            "telemetry-device",
            &[Link(telemetry, 2), Link(other_telemetry, 2)],
        ),
        example(
            "conditions-linked-folder",
            &[Link(other_conditions, 1), Resume(true)],
        ),
        example("ledger-pipe", &[Pipe(ledger), Seal]),
        example("record-removed", &[Remove(record), Seal, Resume(true)]),
        example(
            "plan-edited",
            &[
                Edit(plan, Word(100, 2)),
                Edit(plan, Replace(0, 3, vec![b'y'])),
                Seal,
            ],
        ),
        example("ledger-cut", &[Edit(ledger, Cut(950)), Resume(true)]),
        // Nothing says any more that it was a campaign, so nothing misses what the link has replaced.
        example(
            "found-no-campaign",
            &[
                Remove(manifest),
                Remove(order),
                Remove(plan),
                Remove(ledger),
                Link(conditions, 0),
            ],
        ),
    ]
}

/// The number of each of [`FILES`], in their order.
fn numbers() -> [u8; FILES.len()] {
    std::array::from_fn(|number| number as u8)
}

#[test]
fn each_script_of_folders_changes_the_files_that_its_name_says() {
    for (_, name, bytes) in of_folders() {
        let said: &[&str] = match name.split('-').next() {
            Some("as") => &[],
            Some("ledger") => &["trials.csv"],
            Some("record") => &["Z.json"],
            Some("telemetry") => &["Z.csv"],
            Some("conditions") => &["conditions.json"],
            Some("plan") => &["plan.toml"],
            Some("attempts") => &["Z.json", "Z.csv", "conditions.json"],
            Some("found") => continue,
            _ => panic!("{name} says no file"),
        };
        let changed = folders::changed(&bytes);
        let is_said = |file: &&str| said.iter().any(|end| file.ends_with(end));
        assert!(changed.iter().all(is_said), "{name} changes {changed:?}");
        for end in said {
            let is_changed = changed.iter().any(|file| file.ends_with(end));
            assert!(is_changed, "{name} changes {changed:?}");
        }
    }
}
