//! Scripts of changed files.

use fuzz::documents::Kind;
use fuzz::folders::Step;
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

/// The folder as it was written, and each way in which it is changed. Files are counted by their names: the manifest is
/// the first, then the order, the plan, the readings, the ledger, and conditions, telemetry and record of two attempts.
pub fn of_folders() -> Vec<Example> {
    use Step::{Edit, Exchange, Link, Pipe, Remove, Resume, Seal, Swap};
    let example = |name, steps: &[Step]| ("folders", name, script(&[], steps));
    vec![
        example("as-written", &[]),
        example("edited", &[Edit(4, Number(500, 3))]),
        example("sealed", &[Edit(10, Word(300, 5)), Seal]),
        example("ledger-row", &[Edit(11, Twice(900)), Resume(false)]),
        example("ledger-taken-up", &[Edit(11, Twice(900)), Resume(true)]),
        example("exchanged", &[Exchange, Seal]),
        example("swapped", &[Swap(5, 8), Seal]),
        example("linked", &[Link(6, 0), Seal]),
        example("device", &[Link(6, 2), Link(11, 2)]),
        example("linked-folder", &[Link(9, 1), Resume(true)]),
        example("pipe", &[Pipe(4), Seal]),
        example("removed", &[Remove(7), Seal, Resume(true)]),
        example(
            "plan",
            &[
                Edit(2, Word(100, 2)),
                Edit(2, Replace(0, 3, vec![b'y'])),
                Seal,
            ],
        ),
        example("cut", &[Edit(11, Cut(950)), Resume(true)]),
    ]
}
