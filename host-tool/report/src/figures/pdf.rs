//! Figures as PDF: converts the drawing library's output to lines, areas and text on one page, with the font in the
//! file, as journals ask for.

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::ops::RangeInclusive;
use std::sync::LazyLock;

use pdf_writer::types::FontFlags;
use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str, TextStr};
use plotters_backend::text_anchor::{HPos, VPos};
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingBackend, DrawingErrorKind,
    FontTransform,
};

/// Width of a page, pt: 180 mm.
const WIDTH_PT: f32 = 510.236;
const FONT: Name<'_> = Name(b"F");
/// The drawing library's font sizes are divided by this, as in its SVG output.
const LETTERS: f64 = 1.24;
/// Half the height of a small letter, and the height of a capital, relative to the font size.
const HALF_X: f32 = 0.26;
const CAPITAL: f32 = 0.76;
/// Length of the control lines of a quarter circle, relative to its radius.
const QUARTER: f32 = 0.552_285;

/// Arimo, as wide as Helvetica, with the letters of Latin-1. Its licence, the SIL Open Font License 1.1, is beside it.
const ARIMO: &[u8] = include_bytes!("arimo.ttf");
/// The font's name; the letters before it say that it is not whole (ISO 32000-1 section 9.6.4).
const FONT_NAME: Name<'_> = Name(b"RETROG+Arimo");
/// Bytes of [`encoded`] text with a letter in the font.
const LETTERS_OF_FONT: RangeInclusive<u8> = 32..=255;

/// Content of a page while it is drawn.
pub(crate) struct Drawn {
    content: Content,
    /// Opacities in use, percent.
    opacities: BTreeSet<u8>,
}

impl Drawn {
    pub(crate) fn new() -> Self {
        Self {
            content: Content::new(),
            opacities: BTreeSet::new(),
        }
    }

    /// The file, with a page of `size` units of the drawing.
    pub(crate) fn into_pdf(self, size: (u32, u32), title: &str, subject: &str) -> Vec<u8> {
        let mut next = 0;
        let mut id = || {
            next += 1;
            Ref::new(next)
        };
        let (catalog, pages, page, content, font, info) = (id(), id(), id(), id(), id(), id());
        let (descriptor, font_file) = (id(), id());
        let opacities: Vec<(u8, Ref)> = self.opacities.iter().map(|o| (*o, id())).collect();
        let scale = WIDTH_PT / size.0 as f32;
        let height_pt = size.1 as f32 * scale;
        let mut pdf = Pdf::new();
        pdf.catalog(catalog).pages(pages);
        pdf.pages(pages).kids([page]).count(1);
        let mut sheet = pdf.page(page);
        sheet
            .media_box(Rect::new(0.0, 0.0, WIDTH_PT, height_pt))
            .parent(pages)
            .contents(content);
        let mut resources = sheet.resources();
        resources.fonts().pair(FONT, font);
        let mut states = resources.ext_g_states();
        for (percent, state) in &opacities {
            states.pair(Name(state_name(*percent).as_bytes()), *state);
        }
        states.finish();
        resources.finish();
        sheet.finish();
        for (percent, state) in &opacities {
            let opacity = f32::from(*percent) / 100.0;
            let mut state = pdf.ext_graphics(*state);
            state.stroking_alpha(opacity).non_stroking_alpha(opacity);
        }
        write_font(&mut pdf, font, descriptor, font_file);
        let mut about = pdf.document_info(info);
        about.title(TextStr(title)).subject(TextStr(subject));
        about.finish();
        // Let y point down, as on a screen.
        let mut whole = Content::new();
        whole.transform([scale, 0.0, 0.0, -scale, 0.0, height_pt]);
        let mut bytes = whole.finish().to_vec();
        bytes.push(b'\n');
        bytes.extend_from_slice(&self.content.finish());
        pdf.stream(content, &bytes);
        pdf.finish()
    }

    /// Colours for one shape; [`Content::restore_state`] ends it.
    fn begin(&mut self, color: BackendColor) {
        let [r, g, b] = <[u8; 3]>::from(color.rgb).map(|part| f32::from(part) / 255.0);
        self.content
            .save_state()
            .set_fill_rgb(r, g, b)
            .set_stroke_rgb(r, g, b);
        let percent = (color.alpha * 100.0).round().clamp(0.0, 100.0) as u8;
        if percent < 100 {
            self.opacities.insert(percent);
            self.content
                .set_parameters(Name(state_name(percent).as_bytes()));
        }
    }

    fn go_round(&mut self, points: impl IntoIterator<Item = BackendCoord>) {
        for (index, at) in points.into_iter().enumerate() {
            let (x, y) = place(at);
            if index == 0 {
                self.content.move_to(x, y);
            } else {
                self.content.line_to(x, y);
            }
        }
    }
}

fn state_name(percent: u8) -> String {
    format!("G{percent}")
}

fn place((x, y): BackendCoord) -> (f32, f32) {
    (x as f32, y as f32)
}

/// Text in the font's own encoding: Latin-1 for all text in figures.
fn encoded(text: &str) -> Vec<u8> {
    let byte = |letter: char| u8::try_from(u32::from(letter)).unwrap_or(b'?');
    text.chars().map(byte).collect()
}

/// The font's measures that a PDF states, in thousandths of the font size.
struct Metrics {
    /// Of the letters of [`LETTERS_OF_FONT`]; 0 for what the font lacks.
    widths: Vec<f32>,
    bounds: Rect,
    ascent: f32,
    descent: f32,
    capital: f32,
}

static METRICS: LazyLock<Metrics> = LazyLock::new(|| {
    let face = ttf_parser::Face::parse(ARIMO, 0).expect("the font is part of the program");
    let scaled = |units: i16| f32::from(units) * 1_000.0 / f32::from(face.units_per_em());
    let width = |byte| {
        let glyph = face.glyph_index(char::from(byte))?;
        face.glyph_hor_advance(glyph)
    };
    let bounds = face.global_bounding_box();
    Metrics {
        widths: LETTERS_OF_FONT
            .map(|byte| scaled(width(byte).unwrap_or(0).cast_signed()))
            .collect(),
        bounds: Rect::new(
            scaled(bounds.x_min),
            scaled(bounds.y_min),
            scaled(bounds.x_max),
            scaled(bounds.y_max),
        ),
        ascent: scaled(face.ascender()),
        descent: scaled(face.descender()),
        capital: scaled(face.capital_height().unwrap_or(0)),
    }
});

/// Width of a text that the drawing library writes at a size.
pub(super) fn text_width(text: &str, size: f64) -> f32 {
    width(&encoded(text)) * (size / LETTERS) as f32
}

/// Width of encoded text, relative to the font size.
fn width(text: &[u8]) -> f32 {
    let place = |byte: &u8| usize::from(byte.wrapping_sub(*LETTERS_OF_FONT.start()));
    let of = |byte| METRICS.widths.get(place(byte));
    text.iter().filter_map(of).sum::<f32>() / 1_000.0
}

/// Writes the font, its description and its file (ISO 32000-1 sections 9.6.3, 9.8 and 9.9).
fn write_font(pdf: &mut Pdf, font: Ref, descriptor: Ref, file: Ref) {
    let mut dict = pdf.indirect(font).dict();
    dict.pair(Name(b"Type"), Name(b"Font"))
        .pair(Name(b"Subtype"), Name(b"TrueType"))
        .pair(Name(b"BaseFont"), FONT_NAME)
        .pair(Name(b"FirstChar"), i32::from(*LETTERS_OF_FONT.start()))
        .pair(Name(b"LastChar"), i32::from(*LETTERS_OF_FONT.end()))
        .pair(Name(b"FontDescriptor"), descriptor)
        .pair(Name(b"Encoding"), Name(b"WinAnsiEncoding"));
    dict.insert(Name(b"Widths"))
        .array()
        .items(METRICS.widths.iter().copied());
    dict.finish();
    pdf.font_descriptor(descriptor)
        .name(FONT_NAME)
        .flags(FontFlags::NON_SYMBOLIC)
        .bbox(METRICS.bounds)
        .italic_angle(0.0)
        .ascent(METRICS.ascent)
        .descent(METRICS.descent)
        .cap_height(METRICS.capital)
        // The font does not state its stem width; 0 means unknown.
        .stem_v(0.0)
        .font_file2(file);
    let length = i32::try_from(ARIMO.len()).unwrap_or(i32::MAX);
    pdf.stream(file, ARIMO).pair(Name(b"Length1"), length);
}

type Done = Result<(), DrawingErrorKind<Infallible>>;

/// A page for the drawing library to draw on.
pub(crate) struct Page<'a> {
    pub(crate) drawn: &'a mut Drawn,
    pub(crate) size: (u32, u32),
}

impl DrawingBackend for Page<'_> {
    type ErrorType = Infallible;

    fn get_size(&self) -> (u32, u32) {
        self.size
    }

    fn ensure_prepared(&mut self) -> Done {
        Ok(())
    }

    fn present(&mut self) -> Done {
        Ok(())
    }

    fn draw_pixel(&mut self, point: BackendCoord, color: BackendColor) -> Done {
        let (x, y) = place(point);
        self.drawn.begin(color);
        let content = &mut self.drawn.content;
        content.rect(x, y, 1.0, 1.0).fill_nonzero().restore_state();
        Ok(())
    }

    fn draw_line<S: BackendStyle>(
        &mut self,
        from: BackendCoord,
        to: BackendCoord,
        style: &S,
    ) -> Done {
        self.draw_path([from, to], style)
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        upper_left: BackendCoord,
        bottom_right: BackendCoord,
        style: &S,
        fill: bool,
    ) -> Done {
        let ((left, top), (right, bottom)) = (upper_left, bottom_right);
        let corners = [(left, top), (right, top), (right, bottom), (left, bottom)];
        if fill {
            return self.fill_polygon(corners, style);
        }
        self.draw_path(corners.into_iter().chain([upper_left]), style)
    }

    fn draw_path<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        path: I,
        style: &S,
    ) -> Done {
        if style.color().alpha > 0.0 {
            self.drawn.begin(style.color());
            self.drawn
                .content
                .set_line_width(style.stroke_width() as f32);
            self.drawn.go_round(path);
            self.drawn.content.stroke().restore_state();
        }
        Ok(())
    }

    fn draw_circle<S: BackendStyle>(
        &mut self,
        center: BackendCoord,
        radius: u32,
        style: &S,
        fill: bool,
    ) -> Done {
        if style.color().alpha == 0.0 {
            return Ok(());
        }
        self.drawn.begin(style.color());
        let ((x, y), r) = (place(center), radius as f32);
        let lead = r * QUARTER;
        let content = &mut self.drawn.content;
        content
            .set_line_width(style.stroke_width() as f32)
            .move_to(x + r, y)
            .cubic_to(x + r, y + lead, x + lead, y + r, x, y + r)
            .cubic_to(x - lead, y + r, x - r, y + lead, x - r, y)
            .cubic_to(x - r, y - lead, x - lead, y - r, x, y - r)
            .cubic_to(x + lead, y - r, x + r, y - lead, x + r, y)
            .close_path();
        if fill {
            content.fill_nonzero();
        } else {
            content.stroke();
        }
        content.restore_state();
        Ok(())
    }

    fn fill_polygon<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        vert: I,
        style: &S,
    ) -> Done {
        if style.color().alpha > 0.0 {
            self.drawn.begin(style.color());
            self.drawn.go_round(vert);
            self.drawn
                .content
                .close_path()
                .fill_nonzero()
                .restore_state();
        }
        Ok(())
    }

    fn draw_text<T: BackendTextStyle>(&mut self, text: &str, style: &T, pos: BackendCoord) -> Done {
        if style.color().alpha == 0.0 {
            return Ok(());
        }
        let text = encoded(text);
        let size = (style.size() / LETTERS) as f32;
        let along = match style.anchor().h_pos {
            HPos::Left => 0.0,
            HPos::Center => -width(&text) * size / 2.0,
            HPos::Right => -width(&text) * size,
        };
        let down = match style.anchor().v_pos {
            VPos::Top => CAPITAL * size,
            VPos::Center => HALF_X * size,
            VPos::Bottom => -HALF_X * size,
        };
        // Direction of a line of text, y down.
        let (cos, sin) = match style.transform() {
            FontTransform::Rotate90 => (0.0, 1.0),
            FontTransform::Rotate180 => (-1.0, 0.0),
            FontTransform::Rotate270 => (0.0, -1.0),
            FontTransform::None => (1.0, 0.0),
        };
        let (x, y) = place(pos);
        let (x, y) = (x + along * cos - down * sin, y + along * sin + down * cos);
        self.drawn.begin(style.color());
        self.drawn
            .content
            .begin_text()
            .set_font(FONT, size)
            .set_text_matrix([cos, sin, sin, -cos, x, y])
            .show(Str(&text))
            .end_text()
            .restore_state();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_as_wide_as_helvetica() {
        for (text, thousandths) in [
            ("0", 556),
            (" ", 278),
            ("~", 584),
            ("mm", 1_666),
            ("Fig", 1_389),
        ] {
            let wide = width(&encoded(text)) * 1_000.0;
            assert!((wide - thousandths as f32).abs() < 1.0, "{text}: {wide}");
        }
        assert_eq!(encoded("R² ± 1"), b"R\xb2 \xb1 1");
    }

    #[test]
    fn the_font_is_in_the_file_with_all_that_figures_write() {
        let pdf = Drawn::new().into_pdf((10, 10), "a figure", "nothing");
        let has = |part: &[u8]| pdf.windows(part.len()).any(|window| window == part);
        assert!(has(ARIMO) && has(b"/FontFile2") && !has(b"/Type1"));
        for byte in encoded("0123456789 µm ± R² Δ° (a_n), mm/s")
            .into_iter()
            .filter(|byte| *byte != b'?')
        {
            assert!(METRICS.widths[usize::from(byte - 32)] > 0.0, "{byte}");
        }
    }
}
