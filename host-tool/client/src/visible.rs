//! Makes text safe for a terminal or a page. Text from a device, a record or another person may contain sequences that
//! a terminal obeys, and characters that reverse the order of others.

use std::borrow::Cow;
use std::fmt::Write as _;

/// Whether a terminal shows the character as itself and keeps the position of the others.
fn is_visible(c: char) -> bool {
    let is_hidden = matches!(c,
        '\u{00AD}' | '\u{061C}' | '\u{180E}' | '\u{FEFF}'
        // Zero-width characters, directional marks and embeddings, line separators, invisible operators.
        | '\u{200B}'..='\u{200F}' | '\u{2028}'..='\u{202E}' | '\u{2060}'..='\u{206F}'
        | '\u{FFF9}'..='\u{FFFB}' | '\u{E0000}'..='\u{E0FFF}');
    !c.is_control() && !is_hidden
}

fn replaced<'a>(text: &'a str, stays: fn(char) -> bool, shown: fn(u32) -> String) -> Cow<'a, str> {
    if text.chars().all(stays) {
        return Cow::Borrowed(text);
    }
    let mut clean = String::with_capacity(text.len());
    for c in text.chars() {
        match stays(c) {
            true => clean.push(c),
            false => clean.push_str(&shown(c.into())),
        }
    }
    Cow::Owned(clean)
}

/// Text of several lines, with everything that a terminal would obey shown by its number, such as `<U+001B>`.
#[must_use]
pub fn lines(text: &str) -> Cow<'_, str> {
    let stays = |c| is_visible(c) || matches!(c, '\n' | '\t');
    replaced(text, stays, |code| format!("<U+{code:04X}>"))
}

/// Text of one line: as [`lines`], with line breaks shown by their number, too.
#[must_use]
pub fn line(text: &str) -> Cow<'_, str> {
    replaced(text, is_visible, |code| format!("<U+{code:04X}>"))
}

/// Breaks a text at its words into lines of at most `width` letters. Every line but the first begins with `indent`.
#[must_use]
pub fn wrapped(text: &str, width: usize, indent: &str) -> Vec<String> {
    let lead = &text[..text.len() - text.trim_start().len()];
    let mut lines: Vec<String> = vec![];
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                line.push_str(word);
            }
            Some(_) => lines.push(format!("{indent}{word}")),
            None => lines.push(format!("{lead}{word}")),
        }
    }
    lines
}

/// An HTML document with invisible characters shown by their number, as in [`lines`].
#[must_use]
pub fn html(document: &str) -> Cow<'_, str> {
    let stays = |c| is_visible(c) || matches!(c, '\n' | '\t');
    replaced(document, stays, |code| format!("&lt;U+{code:04X}&gt;"))
}

/// An equivalent JSON document without anything that a terminal would obey.
#[must_use]
pub fn json(document: &str) -> Cow<'_, str> {
    let stays = |c| is_visible(c) || c == '\n';
    replaced(document, stays, |code| {
        let mut escaped = String::new();
        let mut units = [0; 2];
        let c = char::from_u32(code).unwrap_or(char::REPLACEMENT_CHARACTER);
        for unit in c.encode_utf16(&mut units) {
            let _ = write!(escaped, "\\u{unit:04x}");
        }
        escaped
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_left_that_a_terminal_would_obey() {
        let bad = "rig\u{1b}[2J\u{9b}31m\u{7f}\u{202e}gpj\u{2066}\u{200b}\r\u{e0041}";
        let clean = lines(bad);
        assert_eq!(
            clean,
            "rig<U+001B>[2J<U+009B>31m<U+007F><U+202E>gpj<U+2066><U+200B><U+000D><U+E0041>"
        );
        for good in ["µm, °, “ü”, 日本", "two\nlines\tand a tab"] {
            assert_eq!(lines(good), good);
        }
        assert_eq!(line("two\nlines"), "two<U+000A>lines");
    }

    #[test]
    fn json_means_the_same() {
        let value = serde_json::json!({"a\u{202e}": "\u{9b}\u{e0041}\n\u{1b}µ\u{7f}"});
        let text = format!("{value:#}");
        let clean = json(&text);
        assert!(
            clean.chars().all(|c| is_visible(c) || c == '\n'),
            "{clean:?}"
        );
        let again: serde_json::Value = serde_json::from_str(&clean).expect("JSON");
        assert_eq!(again, value);
    }

    #[test]
    fn a_page_shows_what_its_reader_would_not_see() {
        assert_eq!(html("a\u{202e}b\u{7f}"), "a&lt;U+202E&gt;b&lt;U+007F&gt;");
        let page = "<p>µm\n\tand more</p>\n";
        assert_eq!(html(page), page);
        assert_eq!(html("a\r"), "a&lt;U+000D&gt;");
    }
}
