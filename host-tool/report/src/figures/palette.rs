//! The colours of all charts by meaning, on a light page and on a dark one.

use plotters::style::RGBColor;

macro_rules! palette {
    ($($(#[doc = $doc:literal])* $name:ident: $light:expr, dark $dark:expr;)*) => {
        $($(#[doc = $doc])* pub(crate) const $name: RGBColor = $light;)*

        /// Each colour and its replacement on a dark page.
        const ON_DARK: &[(RGBColor, RGBColor)] = &[$(($light, $dark)),*];
    };
}

palette! {
    /// Measurements; in a chart without measurements, the model.
    MEASURED: RGBColor(0x1f, 0x5a, 0xa8), dark RGBColor(0x7f, 0xb2, 0xf0);
    /// Plans; in a chart of two models, the second one.
    PLANNED: RGBColor(0xf0, 0xa0, 0x30), dark RGBColor(0xf0, 0xa0, 0x30);
    /// Axes and text.
    INK: RGBColor(0x33, 0x33, 0x33), dark RGBColor(0xe6, 0xe6, 0xe6);
    /// Marks unreliable data.
    WARNING: RGBColor(0xb0, 0x1c, 0x1c), dark RGBColor(0xff, 0x8f, 0x8a);
    /// Values printed in the paper.
    PAPER: RGBColor(0xc2, 0x1f, 0x26), dark RGBColor(0xff, 0x86, 0x8c);
    /// Trials with dry walls.
    DRY: RGBColor(0xc0, 0x6a, 0x10), dark RGBColor(0xe6, 0x9c, 0x4c);
    /// A body that folds within its run.
    IN_RUN: RGBColor(0x3a, 0x8a, 0x4c), dark RGBColor(0x74, 0xc8, 0x88);
}

/// The style rules for drawings on a dark page. The colours are attributes of their elements, so a rule finds them by
/// value.
pub(crate) fn dark_style() -> String {
    let hex = |RGBColor(r, g, b): RGBColor| format!("{r:02X}{g:02X}{b:02X}");
    let rules = ON_DARK.iter().flat_map(|(light, dark)| {
        let (light, dark) = (hex(*light), hex(*dark));
        ["fill", "stroke"].map(|kind| format!("svg [{kind}='#{light}' i]{{{kind}:#{dark}}}"))
    });
    rules.collect()
}
