//! The comparison table is complete, and the manual contains what the code prints.

use std::sync::OnceLock;

use locomotion::comparison::{
    Asked, BODIES, Bodies, Chosen, Evidence, Kind, Odds, ROWS, Row, Share, Sheet, Table, Values,
    frictions, odds,
};
use locomotion::model::{Model, Setting, Value};
use locomotion::paper::pressures_pa;
use locomotion::parameter::Label;
use locomotion::prior::{Words, agreeing, draws};
use rayon::prelude::*;

const BOTH: [Words; 2] = [Words::Rig, Words::Tube];

/// The default model's sheet and the values of the bodies, computed once.
struct Judged {
    sheet: Sheet,
    own: Values,
    prior: Vec<Values>,
    rig: Vec<Values>,
    tube: Vec<Values>,
}

impl Judged {
    fn asked(&self) -> Asked<'_> {
        Asked {
            prior: &self.prior,
            rig: &self.rig,
            tube: &self.tube,
            ..Asked::default()
        }
    }

    fn odds(&self) -> [Odds; ROWS] {
        odds(&self.sheet.rows, &self.own, &self.asked())
    }
}

fn judged() -> &'static Judged {
    static JUDGED: OnceLock<Judged> = OnceLock::new();
    JUDGED.get_or_init(|| {
        let sheet = Sheet::new(&Model::ONE).unwrap();
        let values = |models: Vec<Model>, worlds: &[Words]| -> Vec<Values> {
            models
                .par_iter()
                .map(|model| sheet.values(model, worlds).unwrap())
                .collect()
        };
        let kept = |words| {
            agreeing(words)
                .map(|draw| draw.apply(&Model::ONE))
                .collect()
        };
        let first = draws().take(BODIES.into());
        Judged {
            own: sheet.values(&Model::ONE, &BOTH).unwrap(),
            prior: values(first.map(|draw| draw.apply(&Model::ONE)).collect(), &BOTH),
            rig: values(kept(Words::Rig), &[Words::Rig]),
            tube: values(kept(Words::Tube), &[Words::Tube]),
            sheet,
        }
    })
}

/// The rows of the default model.
fn rows() -> Vec<Row> {
    judged().sheet.rows.to_vec()
}

#[test]
fn the_manual_holds_this_table() {
    let manual = include_str!("../../../docs/paper-comparison.md").replace("\r\n", "\n");
    let (_, rest) = manual.split_once("<!-- comparison: begin -->\n").unwrap();
    let (table, _) = rest.split_once("<!-- comparison: end -->").unwrap();
    let judged = judged();
    let rows = Table {
        rows: &judged.sheet.rows,
        odds: &judged.odds(),
        bodies: Bodies {
            prior: judged.prior.len(),
            rig: judged.rig.len(),
            tube: judged.tube.len(),
            posterior: 0,
        },
    }
    .to_string();
    if std::env::var_os("BLESS").is_some() {
        let path = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../docs/paper-comparison.md"
        );
        std::fs::write(path, manual.replace(table, &rows)).unwrap();
    }
    assert_eq!(
        table, rows,
        "`BLESS=1` writes it anew; look at the difference"
    );
}

/// The conditions are those of the sentences: values in the paper's column, or our named thresholds.
#[test]
fn a_condition_is_what_the_papers_column_says() {
    for row in rows() {
        let asked = row.condition.map(|condition| condition.to_string());
        let expected = match row.paper {
            "less" => "less than 0",
            "more than 0" => "more than 0",
            "less than 1" => "less than 1",
            "more than 1" if row.sentence.starts_with("faster") => "at least 1.5",
            "more than 1" => "more than 1",
            "opposite" => "less than 0",
            "about 14" => "13 to 15",
            "about 15" => "14 to 16",
            "14; 15" => "14 to 15",
            "15 to 18" => "15 to 18",
            "all" => {
                let number = row
                    .quantity
                    .split(' ')
                    .find_map(|word| word.trim_end_matches(',').parse::<f64>().ok());
                assert_eq!(asked, number.map(|number| number.to_string()), "{row:?}");
                continue;
            }
            // No condition where the text has no number, or for a row without a model value.
            "-" => {
                assert_eq!(asked, None, "{row:?}");
                continue;
            }
            other => {
                if row.evidence != Evidence::Outside {
                    assert!(asked.is_some(), "{row:?}");
                    if let Ok(value) = other.parse::<f64>() {
                        assert!(row.condition.unwrap().met(value), "{row:?}");
                        assert!(!row.condition.unwrap().met(value + 0.06), "{row:?}");
                    }
                } else {
                    assert_eq!(asked, None, "{row:?}");
                }
                continue;
            }
        };
        assert_eq!(asked.as_deref(), Some(expected), "{row:?}");
    }
}

/// Each row is of one kind: a miss if and only if its value does not meet the condition, and then it says why.
#[test]
fn each_row_is_of_a_kind() {
    let judged = judged();
    let mut counts = [0; Kind::JUDGED.len()];
    for (row, odds) in judged.sheet.rows.iter().zip(judged.odds()) {
        let kind = Kind::of(row, &odds);
        let met = (row.condition.zip(row.model)).map(|(condition, value)| condition.met(value));
        assert_eq!(met == Some(false), kind == Kind::Miss, "{row:?}");
        assert!(kind != Kind::Miss || !row.remark.is_empty(), "{row:?}");
        let (prior, decided) = match odds {
            Odds::Shares { prior, .. } => (prior.map(|share| share.part()), true),
            _ => (None, false),
        };
        match kind {
            Kind::Arithmetic | Kind::Input => assert!(!decided, "{row:?}"),
            Kind::ChosenByIt => assert!(
                row.chosen.is_some() || row.evidence == Evidence::Fitted,
                "{row:?}"
            ),
            Kind::NearlyAll => assert!(prior >= Some(0.9), "{row:?}"),
            Kind::Evidence => assert!(prior < Some(0.9) && row.chosen.is_none(), "{row:?}"),
            Kind::Miss => {}
            Kind::Unstated | Kind::Outside => {
                assert_eq!(met, None);
                continue;
            }
        }
        let place = Kind::JUDGED.iter().position(|one| *one == kind);
        counts[place.expect("judged")] += 1;
    }
    let [arithmetic, input, chosen, nearly_all, evidence, miss] = counts;
    assert!(
        arithmetic > 5 && input > 20 && chosen > 5 && nearly_all >= 5 && miss > 10,
        "{counts:?}"
    );
    assert_eq!(
        evidence, 0,
        "docs/paper-comparison.md says that no row is evidence"
    );
}

/// A wider or weaker condition would call these met.
#[test]
fn these_sentences_are_missed() {
    let judged = judged();
    let odds = judged.odds();
    for quantity in [
        "tail forward by an even squeeze of 5.05 mm",
        "displacement in 40 s with m = 13 less with 9, a = 5.05 mm",
        "displacement in 40 s, beta = 45 deg, less with 33.69, a = 5.05 mm",
        "d0 at c/W = 0.4 over d0, a = 3 mm",
        "bend of the two lines nearest to the series",
    ] {
        let rows = judged.sheet.rows.iter().zip(&odds);
        let missed = rows
            .filter(|(row, odds)| row.quantity == quantity && Kind::of(row, odds) == Kind::Miss);
        assert_eq!(missed.count(), 1, "{quantity}");
    }
}

/// Counts again, one body at a time.
#[test]
fn shares_are_counts() {
    let judged = judged();
    let count = |bodies: &[Values], place: usize| {
        let condition = judged.sheet.rows[place].condition.unwrap();
        let mut met = 0;
        for body in bodies {
            if condition.met(body[place].unwrap()) {
                met += 1;
            }
        }
        met
    };
    let mut decided = 0;
    for (place, odds) in judged.odds().into_iter().enumerate() {
        let row = &judged.sheet.rows[place];
        let shares = match odds {
            Odds::Unstated => {
                assert_eq!(row.condition, None);
                continue;
            }
            Odds::AnyBody(met) => {
                let all = judged.prior.len();
                assert_eq!(
                    count(&judged.prior, place),
                    if met { all } else { 0 },
                    "{row:?}"
                );
                continue;
            }
            Odds::Shares {
                prior,
                words,
                posterior,
            } => {
                assert_eq!(posterior, None);
                [
                    (prior, &judged.prior),
                    (
                        words,
                        match row.world {
                            Some(Words::Rig) => &judged.rig,
                            _ => &judged.tube,
                        },
                    ),
                ]
            }
        };
        decided += 1;
        for (share, bodies) in shares {
            let Share {
                met,
                bodies: asked,
                interval: (low, high),
            } = share.expect("asked");
            assert_eq!(
                (met, asked),
                (count(bodies, place), bodies.len()),
                "{row:?}"
            );
            let part = met as f64 / asked as f64;
            assert!(
                low - 1e-9 <= part && part <= high + 1e-9 && high - low < 0.17,
                "{row:?}"
            );
        }
    }
    assert!(decided > 15, "{decided}");
}

/// Kinematics and inputs hold for any body, as this measures. The rows of the rig do not depend on the tube's wall,
/// nor those of the tube on parameters that only the rig has.
#[test]
fn what_the_body_decides_is_measured() {
    let judged = judged();
    let odds = judged.odds();
    for (row, odds) in judged.sheet.rows.iter().zip(odds) {
        let decided = matches!(odds, Odds::Shares { .. });
        assert!(!decided || row.world.is_some(), "{row:?}");
        assert!(row.evidence != Evidence::Input || !decided, "{row:?}");
    }
    let mut wall = Model::ONE;
    let mut rollers = Model::ONE;
    for (model, key, value) in [
        (&mut wall, "tube.critical_pa", 7400.0),
        (&mut rollers, "rig.radius_mm", 15.0),
    ] {
        model
            .set(Setting::named(key).unwrap(), Value::Number(value))
            .unwrap();
    }
    for (model, world, other) in [
        (wall, Words::Tube, Words::Rig),
        (rollers, Words::Rig, Words::Tube),
    ] {
        let values = judged.sheet.values(&model, &BOTH).unwrap();
        let mut changed = 0;
        for ((row, value), own) in judged.sheet.rows.iter().zip(values).zip(judged.own) {
            if value != own {
                assert_ne!(row.world, Some(other), "{row:?}");
                changed += usize::from(row.world == Some(world));
            }
        }
        assert!(changed > 3, "{world:?}: {changed}");
    }
}

/// Evaluated in one world alone, a row has the same value as in both, or none.
#[test]
fn a_world_is_asked_alone() {
    let judged = judged();
    for (world, bodies) in BOTH.into_iter().zip([&judged.rig, &judged.tube]) {
        let draw = agreeing(world).next().unwrap();
        let both = judged
            .sheet
            .values(&draw.apply(&Model::ONE), &BOTH)
            .unwrap();
        for ((row, alone), both) in judged.sheet.rows.iter().zip(bodies[0]).zip(both) {
            if row.world.is_none_or(|of| of == world) {
                assert_eq!(alone, both, "{row:?}");
            } else {
                assert_eq!(alone, None, "{row:?}");
            }
        }
    }
}

/// All selected bodies meet a row that selected them, so it is no evidence. Before the selection, most rows were
/// missed by some.
#[test]
fn what_chose_the_bodies_is_met_by_all_of_them() {
    let judged = judged();
    let (mut wholly, mut decided) = (0, 0);
    for (row, odds) in judged.sheet.rows.iter().zip(judged.odds()) {
        let (prior, words) = match odds {
            Odds::Shares {
                prior: Some(prior),
                words: Some(words),
                ..
            } => (prior, words),
            Odds::AnyBody(met) => {
                assert!(met || row.chosen.is_none(), "{row:?}");
                continue;
            }
            _ => {
                assert_eq!(row.chosen, None, "{row:?}");
                continue;
            }
        };
        match row.chosen {
            Some(Chosen::Wholly) => {
                wholly += 1;
                decided += usize::from(prior.met < prior.bodies);
                assert_eq!(words.met, words.bodies, "{row:?}");
            }
            Some(Chosen::Partly) => assert!(words.part() > prior.part(), "{row:?}"),
            None => {}
        }
    }
    assert!(wholly >= 7 && decided >= 5, "{wholly} {decided}");
}

/// Bodies of another kind have other odds. A posterior of one body is as certain as that body.
#[test]
fn a_posterior_decides_its_own_column() {
    let judged = judged();
    let place = judged
        .sheet
        .rows
        .iter()
        .position(|row| row.quantity == "greatest share of an antegrade pass, a_1 to a_5")
        .unwrap();
    let of = |ratio: f64| {
        let mut model = Model::ONE;
        let setting = Setting::named("body.friction_ratio").unwrap();
        model.set(setting, Value::Number(ratio)).unwrap();
        let values = vec![judged.sheet.values(&model, &[Words::Rig]).unwrap(); 50];
        let asked = Asked {
            posterior: &values,
            independent: 20.0,
            ..judged.asked()
        };
        odds(&judged.sheet.rows, &judged.own, &asked)
    };
    let share = |odds: &[Odds; ROWS]| match odds[place] {
        Odds::Shares { posterior, .. } => posterior.unwrap(),
        other => panic!("{other:?}"),
    };
    let (slippery, hooked) = (of(1.3), of(40.0));
    assert_eq!((share(&slippery).met, share(&hooked).met), (0, 50));
    // Fifty draws with an effective number of twenty: the interval for none of twenty.
    assert!((share(&slippery).interval.1 - 0.161).abs() < 1e-3);
    for (row, odds) in judged.sheet.rows.iter().zip(hooked) {
        if let Odds::Shares { posterior, .. } = odds {
            assert_eq!(
                posterior.is_some(),
                row.world == Some(Words::Rig),
                "{row:?}"
            );
        }
    }
}

#[test]
fn each_row_has_a_value_or_lies_outside() {
    for row in rows() {
        assert_eq!(
            row.model.is_none(),
            row.evidence == Evidence::Outside,
            "{}",
            row.sentence
        );
        assert!(row.model.is_none_or(f64::is_finite), "{}", row.sentence);
        let cells = [
            row.section,
            row.sentence,
            row.quantity,
            row.paper,
            row.unit,
            row.remark,
        ];
        assert!(
            cells.iter().all(|cell| !cell.contains('|')),
            "{}",
            row.sentence
        );
    }
}

/// Sections II to III.A in the paper's order, complete.
#[test]
fn every_section_with_numbers_is_there() {
    let mut sections: Vec<_> = rows().iter().map(|row| row.section).collect();
    sections.dedup();
    assert_eq!(
        sections,
        ["I", "II", "II.A", "II.B", "II.C", "II.D", "III", "III.A"]
    );
}

#[test]
fn the_series_of_section_2b() {
    let frictions: Vec<f64> = frictions().collect();
    assert_eq!(
        (frictions[0], frictions[1], frictions[24]),
        (0.08, 0.085, 0.2)
    );
    assert_eq!(frictions.len(), 25);
    for pair in frictions.windows(2) {
        assert!((pair[1] - pair[0] - 0.005).abs() < 1e-12);
    }
    let pressures: Vec<f64> = pressures_pa().collect();
    assert_eq!(pressures.len(), 11);
    assert_eq!((pressures[0], pressures[10]), (3000.0, 7000.0));
    assert!(pressures.windows(2).all(|pair| pair[1] - pair[0] == 400.0));
}

fn value(quantity: &str) -> f64 {
    let all = rows();
    let mut found = all.iter().filter(|row| row.quantity == quantity);
    let row = found.next().unwrap_or_else(|| panic!("{quantity}"));
    assert!(found.next().is_none(), "{quantity} twice");
    row.model.unwrap()
}

/// An input of the model is not labelled as a result.
#[test]
fn nothing_that_was_put_in_is_a_result() {
    for row in rows() {
        let circular = row.remark.starts_with("circular") || row.remark.starts_with("calibrated");
        assert!(!(circular && row.evidence == Evidence::Outcome), "{row:?}");
    }
}

/// Compared without the effect of length: at the same core length steep wings move less far, and a long body gains
/// less per crescent.
#[test]
fn beta_and_m_are_compared_fairly() {
    assert!(value("the same with as long a core") < -1.0);
    assert!(value("displacement per crescent with m = 13 less with 9, a = 5.05 mm") < 0.0);
    assert!(value("wave's length over phi, beta = 45 less 33.69 deg, a = 5.05 mm") < -2.0);
}

#[test]
fn a_line_through_the_origin_fits_worse() {
    let (five, six) = (
        value("R^2 of a line, 5 indentations"),
        value("R^2 of a line, 5 indentations and the origin"),
    );
    assert!(five > 0.99 && six < five, "{five} {six}");
}

/// Another body gives other values, and an invalid one gives none.
#[test]
fn the_rows_are_those_of_the_model_that_is_asked() {
    let short = |mut model: Model| {
        for (key, value) in [("tube.placements", 1.0), ("tube.duration_s", 10.0)] {
            let setting = Setting::named(key).unwrap();
            model.set(setting, Value::Number(value)).unwrap();
        }
        locomotion::comparison::rows(&model).unwrap()
    };
    let differ = short(Model::RIG)
        .iter()
        .zip(short(Model::ONE))
        .filter(|(rig, one)| rig.model != one.model)
        .count();
    assert!(differ > 10, "{differ}");
}

/// A report prints the label beside the number.
#[test]
fn labels_are_words() {
    let labels = [
        Label::Paper,
        Label::Derived,
        Label::Calibrated,
        Label::Assumed,
        Label::Given,
    ];
    let words = labels.map(|label| label.to_string());
    assert_eq!(words, ["paper", "derived", "cal", "assumed", "given"]);
    assert_eq!(
        format!("{:<9}|", Label::Paper),
        "paper    |",
        "it can be padded"
    );
}
