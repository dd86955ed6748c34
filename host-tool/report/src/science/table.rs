//! Rows as CSV: a header with units in the names, numbers with enough digits to restore the same bits.

use locomotion::model::Model;
use locomotion::parameter::Parameter;
use serde::Serialize;
use serde_json::{Value, json};

/// The rows as the bytes of a CSV file.
pub fn csv<T: Serialize>(rows: &[T]) -> Result<Vec<u8>, csv::Error> {
    written(rows, None)
}

/// As [`csv()`], with the origin of the values in a last column of each row.
pub fn csv_of<T: Serialize>(rows: &[T], origin: &str) -> Result<Vec<u8>, csv::Error> {
    written(rows, Some(origin))
}

fn written<T: Serialize>(rows: &[T], origin: Option<&str>) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(vec![]);
    for (line, row) in rows.iter().enumerate() {
        let row = serde_json::to_value(row).map_err(std::io::Error::from)?;
        let columns = || row.as_object().into_iter().flatten();
        if line == 0 {
            let names = columns().map(|(name, _)| name.as_str());
            writer.write_record(names.chain(origin.map(|_| "origin")))?;
        }
        let cells = columns().map(|(_, value)| match value {
            Value::Null => String::new(),
            Value::String(text) => defused(text),
            other => other.to_string(),
        });
        writer.write_record(cells.chain(origin.map(str::to_owned)))?;
    }
    writer
        .into_inner()
        .map_err(|error| error.into_error().into())
}

/// The text, with an apostrophe before it where a spreadsheet would execute it. A number stays a number.
fn defused(text: &str) -> String {
    let begins = |text: &str| text.starts_with(|char| "=+-@\t\r\n＝＋－＠".contains(char));
    let is_number = text.parse::<f64>().is_ok() && text.ends_with(|c: char| c.is_ascii_digit());
    match (begins(text) || begins(text.trim_start())) && !is_number {
        true => format!("'{text}"),
        false => text.to_owned(),
    }
}

/// All parameters of a model with their units and sources: the rows of `parameters.csv`.
pub fn parameters(model: &Model) -> Vec<Value> {
    let row = |parameter: Parameter| {
        json!({
            "name": parameter.name,
            "value": parameter.value,
            "word": parameter.word,
            "unit": parameter.unit,
            "label": parameter.label.to_string(),
            "source": parameter.source,
        })
    };
    model.parameters().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_cell_is_a_formula_and_a_number_stays_one() {
        let cells = [
            ("=1+1", "'=1+1"),
            ("+cmd", "'+cmd"),
            ("-1+1", "'-1+1"),
            ("@SUM(A1)", "'@SUM(A1)"),
            ("\t=1", "'\t=1"),
            ("＝1", "'＝1"),
            ("-4.25", "-4.25"),
            ("-1e-9", "-1e-9"),
            ("+3", "+3"),
            ("a = b", "a = b"),
            ("", "\"\""),
        ];
        for (text, expected) in cells {
            let table = csv(&[json!({ "reason": text })]).expect("memory");
            let table = String::from_utf8(table).expect("UTF-8");
            assert_eq!(table, format!("reason\n{expected}\n"));
        }
        let table = csv(&[json!({ "mm": -4.25 })]).expect("memory");
        assert_eq!(table, b"mm\n-4.25\n");
    }
}
