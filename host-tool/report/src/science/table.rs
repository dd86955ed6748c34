//! Rows as CSV: a header with units in the names, numbers with enough digits to restore the same bits.

use locomotion::model::Model;
use locomotion::parameter::Parameter;
use serde::Serialize;

/// The rows as the bytes of a CSV file.
///
/// # Errors
/// A row that is not a flat record.
pub fn csv<T: Serialize>(rows: &[T]) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(vec![]);
    for row in rows {
        writer.serialize(row)?;
    }
    writer
        .into_inner()
        .map_err(|error| error.into_error().into())
}

/// As [`csv()`], with the origin of the values in a last column of each row.
///
/// # Errors
/// As [`csv()`].
pub fn csv_of<T: Serialize>(rows: &[T], origin: &str) -> Result<Vec<u8>, csv::Error> {
    let bare = csv(rows)?;
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .from_reader(bare.as_slice());
    let mut writer = csv::Writer::from_writer(vec![]);
    for (line, record) in reader.records().enumerate() {
        let mut record = record?;
        record.push_field(if line == 0 { "origin" } else { origin });
        writer.write_record(&record)?;
    }
    writer
        .into_inner()
        .map_err(|error| error.into_error().into())
}

/// One parameter of the model and the origin of its value.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ParameterRow {
    /// Section and name, as in a model file.
    pub name: &'static str,
    /// Value in `unit`.
    pub value: f64,
    /// The word that set it, if a word did; the value then follows from other parameters.
    pub word: Option<&'static str>,
    /// Unit; empty for a pure number.
    pub unit: &'static str,
    /// `paper`, `derived`, `cal`, `assumed` or `given`.
    pub label: String,
    /// Section or sentence of the paper, or the reason for the choice.
    pub source: &'static str,
}

/// All parameters of a model.
#[must_use]
pub fn parameters(model: &Model) -> Vec<ParameterRow> {
    model.parameters().map(row).collect()
}

/// The row of a parameter.
#[must_use]
pub fn row(parameter: Parameter) -> ParameterRow {
    ParameterRow {
        name: parameter.name,
        value: parameter.value,
        word: parameter.word,
        unit: parameter.unit,
        label: parameter.label.to_string(),
        source: parameter.source,
    }
}
