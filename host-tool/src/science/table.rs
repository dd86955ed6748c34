//! Rows as CSV: a header with units in the names, numbers with enough digits to restore the same bits.

use locomotion::parameter::Parameter;
use locomotion::{folded, roller, tube};
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

/// One parameter of one model, and the origin of its value.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ParameterRow {
    /// `roller`, `tube` or `folded`.
    pub model: &'static str,
    /// Name, with the path in the model's parameters.
    pub name: &'static str,
    /// Value in `unit`.
    pub value: f64,
    /// Unit; empty for a pure number.
    pub unit: &'static str,
    /// `paper`, `derived`, `cal` or `assumed`.
    pub origin: String,
    /// Section or sentence of the paper, or the reason for the choice.
    pub source: &'static str,
}

/// All parameters of all models.
#[must_use]
pub fn parameters() -> Vec<ParameterRow> {
    let rows = |model, parameters: &'static [Parameter]| {
        parameters.iter().map(move |parameter| ParameterRow {
            model,
            name: parameter.name,
            value: parameter.value,
            unit: parameter.unit,
            origin: parameter.label.to_string(),
            source: parameter.source,
        })
    };
    rows("roller", &roller::PARAMETERS)
        .chain(rows("tube", &tube::PARAMETERS))
        .chain(rows("folded", &folded::PARAMETERS))
        .collect()
}
