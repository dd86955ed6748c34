//! The title of a figure and the line on the origin of its values, in as many lines as they need.

use client::identity::Origin;
use plotters::style::RGBColor;

use crate::figures::palette::{INK, WARNING};
use crate::figures::{LETTERS, SIZE};

/// Height of a title of one line and of the line below it, units of the drawing.
const HEIGHT: u32 = 116;
const ROW: i32 = 54;
/// Left edge of the lines, and the room that is kept at the right.
const MARGIN: i32 = 24;
/// Width of a letter over the font size for the drawing library: a little more than the mean of a browser's sans-serif
/// fonts, whose size is 1 / 1.24 of it.
const LETTER: f32 = 0.58 / 1.24;

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

    const fn colour(self) -> RGBColor {
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
    /// For a model's figure: which model.
    pub model: Option<ModelName>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ModelName {
    /// For the line below the title: at most about 55 letters.
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

    /// The origin of the values in words, for the figure.
    fn line(&self) -> &str {
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

    /// Height of all lines, units of the drawing.
    pub(super) fn height(&self) -> u32 {
        // Two are in the height of the shortest heading.
        HEIGHT + ROW as u32 * (self.lines().len() as u32 - 2)
    }

    /// The lines with their places: those of the title, and of the origin below them.
    pub(super) fn lines(&self) -> Vec<Line> {
        let (title, origin) = (LETTERS + 4, LETTERS - 4);
        let of = |text: &str, size, colour| {
            let lines = wrapped(text, size).into_iter();
            lines.map(move |text| (text, size, colour))
        };
        let lines =
            of(&self.title, title, INK).chain(of(self.line(), origin, self.source.colour()));
        let placed = (0..).zip(lines).map(|(row, (text, size, colour))| Line {
            text,
            size,
            colour,
            at: (MARGIN, 34 + ROW * row),
        });
        placed.collect()
    }
}

pub(super) struct Line {
    pub(super) text: String,
    /// For the drawing library, as [`LETTERS`].
    pub(super) size: i32,
    pub(super) colour: RGBColor,
    pub(super) at: (i32, i32),
}

/// Whether a line of this size is within the drawing.
fn fits(text: &str, size: i32) -> bool {
    let room = (SIZE.0 as i32 - 2 * MARGIN) as f32;
    text.chars().count() as f32 * LETTER * size as f32 <= room
}

/// A text in lines that fit, at least one. A word that is too long for a line, such as the name of an indentation, is
/// broken where the line ends.
fn wrapped(text: &str, size: i32) -> Vec<String> {
    let mut lines = vec![];
    let mut line = String::new();
    for word in text.split(' ') {
        let longer = match line.as_str() {
            "" => word.to_owned(),
            line => format!("{line} {word}"),
        };
        if fits(&longer, size) {
            line = longer;
            continue;
        }
        if !line.is_empty() {
            lines.push(std::mem::take(&mut line));
        }
        for letter in word.chars() {
            if !line.is_empty() && !fits(&format!("{line}{letter}"), size) {
                lines.push(std::mem::take(&mut line));
            }
            line.push(letter);
        }
    }
    lines.push(line);
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_title_is_wrapped_and_not_cut() {
        let name = "a-name-of-an-indentation-of-forty-letters";
        for title in [
            format!("Trial 102: lubricated, {name}, repeat 10"),
            "w".repeat(150),
        ] {
            let heading = Heading::new(title.clone(), Source::Records(Origin::Virtual));
            let lines = heading.lines();
            assert!(lines.len() > 2, "{title}");
            let mut said = String::new();
            for line in &lines[..lines.len() - 1] {
                assert!(fits(&line.text, line.size), "{}", line.text);
                said += &line.text;
            }
            let letters = |text: &str| text.replace(' ', "");
            assert_eq!(letters(&said), letters(&title));
            let last = &lines[lines.len() - 1];
            assert_eq!(last.text, "virtual: simulated, not a measurement");
            assert!(last.at.1 < heading.height() as i32 - 20);
        }
        let short = Heading::new("Friction", Source::Model);
        assert_eq!((short.lines().len(), short.height()), (2, HEIGHT));
    }
}
