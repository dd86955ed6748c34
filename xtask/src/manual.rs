//! The manual: links that lead somewhere, and pages that can be read.
//!
//! * Every relative link in a Markdown file leads to a file that is there, and every `#anchor` to a heading of it.
//! * No page of `docs/` has more than 400 lines, and none of its lines of prose more than 120 columns.
//!
//! Code, tables, pictures and what is generated may be as wide as they are.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Component, Path, PathBuf};
use std::process::Command;

use crate::process::{Failure, Result, lines_of, root};

/// Longest page, lines.
const MOST_LINES: usize = 400;
/// Page that may be longer: a reference of the messages.
const LONGER: &str = "docs/protocol.md";
/// Longest line of prose, columns.
const MOST_COLUMNS: usize = 120;

/// Checks every Markdown file that git knows.
pub(crate) fn check() -> Result<()> {
    let mut git = Command::new("git");
    git.args(["ls-files", "*.md"]).current_dir(root());
    let mut pages = BTreeMap::new();
    let remedy = "run it in a checkout, with git; if that is somebody else's, git says above what it asks for";
    let names = lines_of(&mut git, remedy)?;
    if names.is_empty() {
        return Err(Failure::new("git knows no page here", remedy));
    }
    for name in names {
        // A page that is deleted but not committed is reported where a link leads to it.
        if let Ok(text) = fs::read_to_string(root().join(&name)) {
            pages.insert(PathBuf::from(name), text);
        }
    }
    let wrong = objections(&pages, &|path| root().join(path).exists());
    if wrong.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        wrong.join("\n"),
        "correct the link, split the page or wrap the line; `xtask/src/manual.rs` says what is kept",
    ))
}

/// Objections to these pages; `exists` knows all files.
fn objections(pages: &BTreeMap<PathBuf, String>, exists: &dyn Fn(&Path) -> bool) -> Vec<String> {
    let mut wrong = vec![];
    for (page, text) in pages {
        let name = page.display();
        let in_docs = page.starts_with("docs");
        let count = text.lines().count();
        if in_docs && count > MOST_LINES && page != Path::new(LONGER) {
            wrong.push(format!("{name}: {count} lines, {MOST_LINES} at most"));
        }
        for (number, line, generated) in prose(text) {
            for link in links(line) {
                if let Some(reason) = broken(page, &link, pages, exists) {
                    wrong.push(format!("{name}:{number}: `{link}` {reason}"));
                }
            }
            let columns = line.chars().count();
            if in_docs && !generated && columns > MOST_COLUMNS && !line.starts_with(['|', '!']) {
                wrong.push(format!(
                    "{name}:{number}: {columns} columns, {MOST_COLUMNS} at most"
                ));
            }
        }
    }
    wrong
}

/// The lines outside code blocks: number, text, and whether it lies between the marks `generated` and `end`.
fn prose(text: &str) -> impl Iterator<Item = (usize, &str, bool)> {
    let (mut code, mut generated) = (false, false);
    text.lines().enumerate().filter_map(move |(at, line)| {
        if line.trim_start().starts_with("```") {
            code = !code;
            return None;
        }
        match line {
            _ if line.starts_with("<!-- generated") => generated = true,
            "<!-- end -->" => generated = false,
            _ => {}
        }
        (!code).then_some((at + 1, line, generated))
    })
}

/// Targets of the links in a line, those in code left out.
fn links(line: &str) -> Vec<String> {
    let shown: String = line.split('`').step_by(2).collect();
    let targets = shown.split("](").skip(1);
    targets
        .filter_map(|rest| Some(rest.split_once(')')?.0.to_owned()))
        .collect()
}

/// Why a link leads nowhere, if it does.
fn broken(
    page: &Path,
    link: &str,
    pages: &BTreeMap<PathBuf, String>,
    exists: &dyn Fn(&Path) -> bool,
) -> Option<String> {
    if link.contains("://") || link.starts_with("mailto:") {
        return None;
    }
    let (file, anchor) = match link.split_once('#') {
        Some((file, anchor)) => (file, Some(anchor)),
        None => (link, None),
    };
    let target = match file {
        "" => page.to_path_buf(),
        _ => beside(page, file),
    };
    if !exists(&target) {
        return Some("leads to no file".to_owned());
    }
    let anchor = anchor?;
    match pages.get(&target) {
        Some(text) if anchors(text).contains(anchor) => None,
        Some(_) => Some(format!("leads to no heading of {}", target.display())),
        None => Some("has an anchor, and leads to no page".to_owned()),
    }
}

/// The path from the root of a file that a page calls `file`.
fn beside(page: &Path, file: &str) -> PathBuf {
    let mut path = PathBuf::new();
    for part in page.parent().unwrap_or(page).join(file).components() {
        match part {
            Component::ParentDir => {
                path.pop();
            }
            part => path.push(part),
        }
    }
    path
}

/// The anchors of a page's headings, as GitHub makes them: lower case, dashes for spaces, no punctuation, and a number
/// behind a heading that was there before.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut seen = BTreeMap::<String, usize>::new();
    let mut found = BTreeSet::new();
    for (_, line, _) in prose(text) {
        let heading = line.trim_start_matches('#');
        if !(1..=6).contains(&(line.len() - heading.len())) || !heading.starts_with(' ') {
            continue;
        }
        let kept = |c: &char| c.is_alphanumeric() || matches!(c, '-' | '_');
        let dashed = heading.trim().to_lowercase().replace(' ', "-");
        let anchor: String = dashed.chars().filter(kept).collect();
        let before = seen.entry(anchor.clone()).or_default();
        found.insert(match *before {
            0 => anchor,
            before => format!("{anchor}-{before}"),
        });
        *before += 1;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Objections to two pages, one of which is `docs/a.md` with this text.
    fn wrong(text: &str) -> Vec<String> {
        let other = "# It's `b`, (c): d\n## Twice\n```\n# Code\n```\n## Twice\n".to_owned();
        let pages: BTreeMap<_, _> = [("docs/a.md", text.to_owned()), ("b/README.md", other)]
            .into_iter()
            .map(|(name, text)| (PathBuf::from(name), text))
            .collect();
        let picture = Path::new("docs/p.svg");
        objections(&pages, &|path| path == picture || pages.contains_key(path))
    }

    #[test]
    fn links_lead_to_files_and_headings() {
        let good = "# A\n[a](#a), ![p](p.svg), [b](../b/README.md#its-b-c-d), [t](../b/README.md#twice-1),\n\
            [x\ny](../b/README.md), [web](https://example.org/#x), `[code](gone.md)`\n```\n[code](gone.md)\n```\n";
        assert_eq!(wrong(good), <[&str; 0]>::default());
        for bad in [
            "[a](gone.md)",
            "[a](b/README.md)",
            "[a](#b)",
            "[b](../b/README.md#code)",
            "[b](../b/README.md#twice-2)",
            "[x\ny](gone.md)",
            "[a](#a) [p](p.svg#a)",
            "`code` [a](gone.md)",
        ] {
            assert_eq!(wrong(&format!("# A\n{bad}\n")).len(), 1, "{bad}");
        }
    }

    #[test]
    fn pages_are_short_and_lines_narrow() {
        let wide = "x".repeat(MOST_COLUMNS + 1);
        assert_eq!(wrong(&"x\n".repeat(MOST_LINES)), <[&str; 0]>::default());
        assert_eq!(wrong(&"x\n".repeat(MOST_LINES + 1)).len(), 1);
        assert_eq!(wrong(&"ä".repeat(MOST_COLUMNS)), <[&str; 0]>::default());
        assert_eq!(wrong(&wide).len(), 1);
        let marks = format!("<!-- generated: x -->\n{wide}\n<!-- end -->\n");
        for allowed in [
            format!("| {wide}"),
            format!("```\n{wide}\n```"),
            marks.clone(),
        ] {
            assert_eq!(wrong(&allowed), <[&str; 0]>::default());
        }
        assert_eq!(wrong(&format!("{marks}{wide}")).len(), 1);
    }
}
