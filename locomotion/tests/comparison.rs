//! The comparison table: it is complete, and the manual holds what the code prints.

use locomotion::comparison::{Evidence, Table, frictions, pressures_pa, rows};
use locomotion::parameter::Label;

#[test]
fn the_manual_holds_this_table() {
    let manual = include_str!("../../docs/science.md").replace("\r\n", "\n");
    let (_, rest) = manual.split_once("<!-- comparison: begin -->\n").unwrap();
    let (table, _) = rest.split_once("<!-- comparison: end -->").unwrap();
    assert_eq!(table, Table(&rows().unwrap()).to_string());
}

#[test]
fn each_row_has_a_value_or_lies_outside() {
    for row in rows().unwrap() {
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
    let mut sections: Vec<_> = rows().unwrap().iter().map(|row| row.section).collect();
    sections.dedup();
    assert_eq!(
        sections,
        ["II", "II.A", "II.B", "II.C", "II.D", "III", "III.A"]
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

/// A report prints the label beside the number.
#[test]
fn labels_are_words() {
    let labels = [
        Label::Paper,
        Label::Derived,
        Label::Calibrated,
        Label::Assumed,
    ];
    let words = labels.map(|label| label.to_string());
    assert_eq!(words, ["paper", "derived", "cal", "assumed"]);
    assert_eq!(
        format!("{:<9}|", Label::Paper),
        "paper    |",
        "it can be padded"
    );
}
