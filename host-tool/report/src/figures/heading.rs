//! The title of a figure, for readers of the screen and of a caption, and the line in it on the origin of its values.

use client::identity::Origin;
use plotters::style::RGBColor;

use crate::figures::palette::{INK, WARNING};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    Records(Origin),
    Model,
    Plan,
}

impl Source {
    /// The origin in words, for the figure.
    pub const fn text(self) -> &'static str {
        match self {
            Self::Records(origin) => origin.meaning(),
            Self::Model => "model: calculated, not a measurement",
            Self::Plan => "plan: calculated, not a measurement",
        }
    }

    pub(super) const fn colour(self) -> RGBColor {
        match self {
            Self::Records(Origin::Virtual | Origin::Unknown) => WARNING,
            Self::Records(Origin::Board) | Self::Model | Self::Plan => INK,
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Heading {
    pub title: String,
    pub source: Source,
    /// Which model, for a model's figure.
    pub model: Option<ModelName>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelName {
    /// For the line above the charts: at most about 53 letters.
    pub short: String,
    /// For the description of the file, at any length.
    pub full: String,
}

impl Heading {
    pub fn of_model(title: impl Into<String>, model: ModelName) -> Self {
        Self {
            title: title.into(),
            source: Source::Model,
            model: Some(model),
        }
    }

    /// The origin of the values in words, for the figure: one line.
    pub(super) fn line(&self) -> &str {
        match &self.model {
            Some(model) => &model.short,
            None => self.source.text(),
        }
    }

    /// The origin of the values, in full.
    pub(super) fn description(&self) -> &str {
        match &self.model {
            Some(model) => &model.full,
            None => self.source.text(),
        }
    }

    pub fn new(title: impl Into<String>, source: Source) -> Self {
        Self {
            title: title.into(),
            source,
            model: None,
        }
    }
}
