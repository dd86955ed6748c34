//! The interface of a displacement model. On the virtual bench the rollers touch nothing, so a model gives the
//! displacement.

use std::error::Error;
use std::path::Path;

use crate::campaign::ledger::Source;
use crate::campaign::order::Planned;
use crate::campaign::plan::{CampaignPlan, Millimetres};

/// A calculated displacement and its description.
#[derive(Clone, Debug, PartialEq)]
pub struct Modelled {
    /// The displacement, rounded to the caliper's resolution.
    pub value: Millimetres,
    /// The model, with or without scatter.
    pub source: Source,
    /// Model and scatter in words, for the record.
    pub text: String,
}

/// The attempt to calculate a displacement for.
#[derive(Clone, Copy, Debug)]
pub struct Wanted<'a> {
    /// The campaign's plan.
    pub plan: &'a CampaignPlan,
    /// The trial.
    pub planned: &'a Planned,
    /// The number of the attempt.
    pub attempt: u32,
    /// Indentation of the body by the rollers, mm.
    pub indentation_mm: f64,
    /// The record of the run.
    pub sidecar: &'a Path,
}

/// A model of the displacement. This crate has none itself.
pub trait DisplacementModel {
    /// The displacement in this attempt, with the scatter that the plan declares.
    ///
    /// # Errors
    /// The model does not cover it, or a record cannot be read.
    fn displacement(&self, wanted: &Wanted<'_>) -> Result<Modelled, Box<dyn Error>>;
}
