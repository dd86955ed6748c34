//! The language of comments: how a comment of Rust or Python, or a docstring, begins.
//!
//! A comment that begins with "What", "So" or "Nobody" is half a sentence, or one that leans on another: the reader has
//! to turn it round before it says anything. Only the first word counts; later lines and paragraphs may begin as they
//! like.

use std::fs;
use std::process::Command;

use crate::process::{Failure, Result, lines_of, root};

/// Words that no comment begins with.
const REFUSED: [&str; 3] = ["What", "So", "Nobody"];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Language {
    Rust,
    Python,
}

/// Checks every source file of Rust and Python that git knows, or would take.
pub(crate) fn check() -> Result<()> {
    let mut git = Command::new("git");
    git.args(["ls-files", "--cached", "--others", "--exclude-standard"]);
    git.args(["*.rs", "*.py"]).current_dir(root());
    let remedy = "run it in a checkout, with git; if that is somebody else's, git says above what it asks for";
    let names = lines_of(&mut git, remedy)?;
    if names.is_empty() {
        return Err(Failure::new("git knows no source here", remedy));
    }
    let mut wrong = vec![];
    for name in names {
        let language = match name.ends_with(".py") {
            true => Language::Python,
            false => Language::Rust,
        };
        // A file may be deleted but not committed.
        if let Ok(text) = fs::read_to_string(root().join(&name)) {
            wrong.extend(objections(&name, &text, language));
        }
    }
    if wrong.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        wrong.join("\n"),
        "let the sentence say the thing itself: what a constant is, what a function does, and then why",
    ))
}

/// Objections to the comments of a file.
fn objections(name: &str, text: &str, language: Language) -> Vec<String> {
    let begins = |text: &str| {
        let of_word = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_');
        let end = text.find(|c| !of_word(c)).unwrap_or(text.len());
        REFUSED.into_iter().find(|word| *word == &text[..end])
    };
    let objection = |(line, text): (usize, &str)| {
        let word = begins(text)?;
        Some(format!(
            "{name}:{line}: a comment begins with \"{word}\"; let the sentence say the thing itself"
        ))
    };
    let found = Source::new(text, language).comments().into_iter();
    found.filter_map(objection).collect()
}

/// A source file, read from the beginning to the end.
struct Source<'a> {
    text: &'a str,
    language: Language,
    /// Bytes that have been read.
    at: usize,
    /// Lines and texts of the comments and docstrings so far, from their first word on.
    found: Vec<(usize, &'a str)>,
    /// Line and mark of the last comment that has its line to itself.
    last: Option<(usize, &'a str)>,
}

impl<'a> Source<'a> {
    fn new(text: &'a str, language: Language) -> Self {
        Self {
            text,
            language,
            at: 0,
            found: vec![],
            last: None,
        }
    }

    /// Where comments and docstrings begin. Consecutive lines with the same mark are one comment.
    fn comments(mut self) -> Vec<(usize, &'a str)> {
        while self.at < self.text.len() {
            let rest = &self.text[self.at..];
            match self.language {
                Language::Rust if rest.starts_with("//") => self.line_comment(),
                Language::Rust if rest.starts_with("/*") => self.block_comment(),
                Language::Rust if rest.starts_with('\'') => self.at += character(rest),
                Language::Python if rest.starts_with('#') => self.line_comment(),
                Language::Python if rest.starts_with(['"', '\'']) => self.python_string(),
                _ if rest.starts_with('"') => self.at += string(rest, "\"", self.hashes()),
                _ => self.at += rest.chars().next().map_or(1, char::len_utf8),
            }
        }
        self.found
    }

    /// Text before here on the same line.
    fn before(&self) -> &'a str {
        let read = &self.text[..self.at];
        &read[read.rfind('\n').map_or(0, |end| end + 1)..]
    }

    fn line(&self) -> usize {
        1 + self.text[..self.at].matches('\n').count()
    }

    fn line_comment(&mut self) {
        let rest = &self.text[self.at..];
        let rest = &rest[..rest.find('\n').unwrap_or(rest.len())];
        let marks = ["///", "//!", "//", "#"];
        let mark = marks.into_iter().find(|mark| rest.starts_with(mark));
        let mark = mark.unwrap_or_default();
        let line = self.line();
        let goes_on = self.last == Some((line - 1, mark)) && self.before().trim().is_empty();
        if !goes_on {
            self.found.push((line, rest[mark.len()..].trim_start()));
        }
        if self.before().trim().is_empty() {
            self.last = Some((line, mark));
        }
        self.at += rest.len();
    }

    /// Reads `/* ... */`, with those inside it.
    fn block_comment(&mut self) {
        let rest = &self.text[self.at..];
        let words = rest.trim_start_matches(['/', '*', '!']).trim_start();
        let words = words.trim_start_matches('*').trim_start();
        let lines = rest[..rest.len() - words.len()].matches('\n').count();
        self.found.push((self.line() + lines, words));
        let (mut depth, mut end) = (1, 2);
        while depth > 0 && end < rest.len() {
            match &rest.as_bytes()[end..] {
                [b'*', b'/', ..] => (depth, end) = (depth - 1, end + 2),
                [b'/', b'*', ..] => (depth, end) = (depth + 1, end + 2),
                _ => end += 1,
            }
        }
        self.at += end;
    }

    /// Hashes of the raw string whose quote is here; none if it is not raw.
    fn hashes(&self) -> Option<usize> {
        let name = self.before().trim_end_matches('#');
        let hashes = self.before().len() - name.len();
        let prefix = name.len() - name.trim_end_matches(|c: char| c.is_alphanumeric()).len();
        matches!(&name[name.len() - prefix..], "r" | "br" | "cr").then_some(hashes)
    }

    /// A string that begins its line is a docstring: nothing else stands there by itself.
    fn python_string(&mut self) {
        let rest = &self.text[self.at..];
        let quotes = ["\"\"\"", "'''", "\"", "'"];
        let quote = quotes.into_iter().find(|quote| rest.starts_with(quote));
        let quote = quote.unwrap_or("\"");
        let letters = |c: char| matches!(c, 'r' | 'R' | 'u' | 'U');
        let stands_alone = self.before().trim().trim_matches(letters).is_empty();
        if stands_alone && quote.len() == 3 {
            let words = rest[quote.len()..].trim_start();
            let lines = rest[..rest.len() - words.len()].matches('\n').count();
            self.found.push((self.line() + lines, words));
        }
        self.at += string(rest, quote, None);
    }
}

/// Length of the string that begins here, with its quotes; `hashes` belong to a raw string of Rust.
fn string(text: &str, quote: &str, hashes: Option<usize>) -> usize {
    let end = format!("{quote}{}", "#".repeat(hashes.unwrap_or_default()));
    let mut at = quote.len();
    while let Some(next) = text[at..].chars().next() {
        if text[at..].starts_with(&end) {
            return at + end.len();
        }
        at += next.len_utf8();
        if next == '\\' && hashes.is_none() {
            at += text[at..].chars().next().map_or(0, char::len_utf8);
        }
    }
    text.len()
}

/// Length of the character literal of Rust that begins here; 1 if the quote belongs to a lifetime.
fn character(text: &str) -> usize {
    let mut chars = text[1..].chars();
    match (chars.next(), chars.next()) {
        (Some('\\'), Some(escaped)) => {
            let at = 2 + escaped.len_utf8();
            at + text[at..].find('\'').map_or(0, |end| end + 1)
        }
        (Some(letter), Some('\'')) => 2 + letter.len_utf8(),
        _ => 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(text: &str, language: Language) -> Vec<usize> {
        let found = objections("f", text, language);
        let line = |told: &String| told.split(':').nth(1)?.parse().ok();
        found.iter().filter_map(line).collect()
    }

    fn rust(text: &str) -> Vec<usize> {
        lines(text, Language::Rust)
    }

    fn python(text: &str) -> Vec<usize> {
        lines(text, Language::Python)
    }

    #[test]
    fn an_objection_names_file_and_line_and_asks_for_the_thing_itself() {
        let told = objections("a/b.rs", "\n/// So it is.\n", Language::Rust);
        assert_eq!(
            told,
            ["a/b.rs:2: a comment begins with \"So\"; let the sentence say the thing itself"]
        );
    }

    #[test]
    fn every_kind_of_comment_in_rust_is_read() {
        for comment in [
            "// What it is.",
            "/// Nobody knows.",
            "//! So it is.",
            "    //So it is.",
            "let a = 1; // What it is.",
            "/* What it is. */",
            "/** Nobody knows. */",
            "/// What's that?",
        ] {
            assert_eq!(rust(comment), [1], "{comment}");
        }
        assert_eq!(rust("/*\n * So it is.\n */\n// So.\n"), [2, 4]);
        assert_eq!(rust("/* /* */ */ // So.\n"), [1]);
    }

    #[test]
    fn only_the_first_word_counts() {
        for comment in [
            "// Something.",
            "// Whatever.",
            "// so.",
            "// So-called.",
            "//",
            "/// A line\n/// So that.\n",
            "/// A line.\n///\n/// What follows.\n",
        ] {
            assert_eq!(rust(comment), <[usize; 0]>::default(), "{comment}");
        }
        assert_eq!(rust("// A line.\n/// What.\n"), [2], "another mark");
        assert_eq!(rust("// A line.\n\n// What.\n"), [3], "another comment");
        assert_eq!(rust("// A line.\nlet a = 1; // So.\n"), [2], "beside code");
        assert_eq!(rust("let a = 1; // A line.\n// So.\n"), [2], "below code");
    }

    #[test]
    fn a_string_in_rust_is_no_comment() {
        for code in [
            "\"// So\"",
            "\"\\\"// So\"",
            "\"\n// So\n\"",
            "r\"\\\" // A.",
            "r#\"\"// So\"#",
            "br##\"\"#// So\"##",
            "('\"', \"// So\")",
            "('\\'', '\\u{41}', \"// So\")",
            "fn f<'a>(a: &'a str) { \"// So\" }",
        ] {
            assert_eq!(rust(code), <[usize; 0]>::default(), "{code}");
            assert_eq!(rust(&format!("{code}\n// So")).len(), 1, "{code}");
        }
    }

    #[test]
    fn comments_and_docstrings_of_python_are_read() {
        for text in [
            "# What it is.",
            "a = 1  # So it is.",
            "\"\"\"What it is.\"\"\"",
            "    '''Nobody knows.'''",
            "    r\"\"\"So it is.\"\"\"",
        ] {
            assert_eq!(python(text), [1], "{text}");
        }
        assert_eq!(python("\"\"\"\nSo it is.\n\"\"\"\n# So.\n"), [2, 4]);
        for text in [
            "\"\"\"A line.\nSo it is.\n\"\"\"\n",
            "# A line.\n# So it is.\n",
            "a = \"\"\"What it is.\"\"\"",
            "a = '# So'",
            "a = \"\\\"# So\"",
            "\"\"\"A line.\n# So it is.\n\"\"\"\n",
        ] {
            assert_eq!(python(text), <[usize; 0]>::default(), "{text}");
        }
    }
}
