//! The comparison table: it is complete, and the manual holds what the code prints.

use std::sync::OnceLock;

use locomotion::comparison::{Evidence, Row, Table, frictions, pressures_pa};
use locomotion::model::{Model, Setting, Value};
use locomotion::parameter::Label;

/// The rows of the default model, worked out once.
fn rows() -> Vec<Row> {
    static ROWS: OnceLock<Vec<Row>> = OnceLock::new();
    let work = || locomotion::comparison::rows(&Model::ONE).unwrap().to_vec();
    ROWS.get_or_init(work).clone()
}

#[test]
fn the_manual_holds_this_table() {
    let manual = include_str!("../../docs/science.md").replace("\r\n", "\n");
    let (_, rest) = manual.split_once("<!-- comparison: begin -->\n").unwrap();
    let (table, _) = rest.split_once("<!-- comparison: end -->").unwrap();
    let rows = Table(&rows()).to_string();
    if std::env::var_os("BLESS").is_some() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/science.md");
        std::fs::write(path, manual.replace(table, &rows)).unwrap();
    }
    assert_eq!(
        table, rows,
        "`BLESS=1` writes it anew; look at the difference"
    );
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

/// Section II to III.A, in the paper's order, none left out.
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

/// Where the paper names a direction, the row has it, or its remark begins with "missed".
#[test]
fn a_trend_is_met_or_called_missed() {
    for row in rows() {
        let Some(value) = row.model else { continue };
        let met = match row.paper {
            "less" => value < 0.0,
            "more than 0" => value > 0.0,
            "less than 1" => value < 1.0,
            "more than 1" => value > 1.0,
            "0" => value.abs() < 1e-9,
            "opposite" => value < 0.0,
            _ => continue,
        };
        assert_ne!(met, row.remark.starts_with("missed"), "{row:?}");
    }
}

/// What was put in is not called a result.
#[test]
fn nothing_that_was_put_in_is_a_result() {
    for row in rows() {
        let circular = row.remark.starts_with("circular") || row.remark.starts_with("calibrated");
        assert!(!(circular && row.evidence == Evidence::Outcome), "{row:?}");
    }
}

/// Without a length that tips the scales: at as long a core steep wings go less far, and a long body gains less per
/// crescent.
#[test]
fn beta_and_m_are_compared_fairly() {
    assert!(
        value(
            "displacement in 40 s, beta = 45 deg and as long a core, less with 33.69, a = 5.05 mm"
        ) < -1.0
    );
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

/// Another body gives other values, and a bad one none.
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
