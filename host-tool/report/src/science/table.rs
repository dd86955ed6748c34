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
            Value::String(text) => text.clone(),
            other => other.to_string(),
        });
        writer.write_record(cells.chain(origin.map(str::to_owned)))?;
    }
    writer
        .into_inner()
        .map_err(|error| error.into_error().into())
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
