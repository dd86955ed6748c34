//! The comparison table: it is complete, and the manual holds what the code prints.

use locomotion::comparison::{Evidence, Table, rows};

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
