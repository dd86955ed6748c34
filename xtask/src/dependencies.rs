//! Which foreign code may be part of the programs: its licence, its source, and the crates that are banned.
//!
//! Cargo itself lists the crates, so that the check needs no other program and is never skipped.

use crate::process::{Failure, Result, host_cargo, installed, lines_of, root, run};

/// Licences that let images and programs be used and passed on under ours (SPDX identifiers).
const ALLOWED: [&str; 8] = [
    "0BSD",
    "MIT",
    "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception",
    "BSD-3-Clause",
    "ISC",
    "Unicode-3.0",
    "Zlib",
];

/// Copyleft by file: these crates are used unchanged, and only in programs for the host.
const EXCEPTIONS: [(&str, &str); 3] = [
    ("serialport", "MPL-2.0"),
    ("alterable_logger", "MPL-2.0"),
    ("colored", "MPL-2.0"),
];

/// Plain `cargo test` works with nothing installed: no C++ parser and no system libraries.
const BANNED: [&str; 3] = ["bindgen", "libudev-sys", "openssl-sys"];

const REMEDY: &str = "choose another crate, or argue for an exception in xtask/src/dependencies.rs";

/// Checks licences, sources and banned crates of everything that the workspace is built from, on all platforms.
pub(crate) fn check() -> Result<()> {
    let mut cargo = host_cargo("tree");
    cargo.args([
        "--workspace",
        "--locked",
        "--all-features",
        "--target",
        "all",
    ]);
    cargo.args(["--edges", "normal,build,dev", "--prefix", "none"]);
    cargo.args(["--no-dedupe", "--format", "{p}|{l}"]);
    let mut crates = lines_of(
        &mut cargo,
        "`cargo update --workspace`, and commit Cargo.lock",
    )?;
    crates.sort();
    crates.dedup();
    let ours = root().display().to_string();
    let wrong: Vec<_> = crates
        .iter()
        .filter_map(|line| wrong_crate(line, &ours))
        .collect();
    if !wrong.is_empty() {
        return Err(Failure::new(wrong.join("\n"), REMEDY));
    }
    println!(
        "{} crates: licences, sources and bans as they should be",
        crates.len()
    );
    advisories()
}

/// Known vulnerabilities and withdrawn versions. Skipped without `cargo-deny` and its copy of the database: the
/// database changes without a change here, and a new copy needs the network.
fn advisories() -> Result<()> {
    let home = std::env::var_os("CARGO_HOME").map(std::path::PathBuf::from);
    let home = home.or_else(|| std::env::home_dir().map(|home| home.join(".cargo")));
    let copy = home.is_some_and(|home| home.join("advisory-dbs").is_dir());
    if !copy || !installed("deny") {
        println!(
            "advisories: no copy of their database here; `cargo deny check advisories` fetches it"
        );
        return Ok(());
    }
    let mut cargo = host_cargo("deny");
    cargo.args([
        "--workspace",
        "--locked",
        "--offline",
        "check",
        "advisories",
    ]);
    run(
        &mut cargo,
        "update the crate that is named, or choose another",
    )
}

/// Returns what is wrong with a crate, from `NAME vVERSION [(SOURCE)] [(proc-macro)]|LICENCE`. Cargo names every source
/// except its default registry.
fn wrong_crate(line: &str, ours: &str) -> Option<String> {
    let (about, licence) = line.split_once('|')?;
    let (name, rest) = about.split_once(' ')?;
    let rest = rest.replace(" (proc-macro)", "");
    if let Some((_, source)) = rest.split_once(" (")
        && !source.starts_with(ours)
    {
        return Some(format!(
            "{name} comes from elsewhere: {}",
            source.trim_end_matches(')')
        ));
    }
    if BANNED.contains(&name) {
        return Some(format!("{name} may not be used"));
    }
    let allowed = |one: &str| ALLOWED.contains(&one) || EXCEPTIONS.contains(&(name, one));
    (!satisfied(licence, &allowed))
        .then(|| format!("{about}: its licence, \"{licence}\", is not among those allowed"))
}

/// Whether one alternative of an SPDX expression has only allowed licences: `AND` binds before `OR`, and older crates
/// write `/` for `OR`. Without any licence: no.
fn satisfied(expression: &str, allowed: &dyn Fn(&str) -> bool) -> bool {
    let expression = expression.replace('/', " OR ");
    let expression = expression.split_whitespace().collect::<Vec<_>>().join(" ");
    any(&expression, allowed)
}

fn any(expression: &str, allowed: &dyn Fn(&str) -> bool) -> bool {
    let mut choices = outside_parentheses(expression, " OR ").into_iter();
    choices.any(|choice| {
        let mut parts = outside_parentheses(choice, " AND ").into_iter();
        parts.all(|part| {
            let inner = part
                .strip_prefix('(')
                .and_then(|part| part.strip_suffix(')'));
            inner.map_or_else(|| allowed(part), |inner| any(inner, allowed))
        })
    })
}

/// Splits at a word that is not within parentheses.
fn outside_parentheses<'a>(text: &'a str, word: &str) -> Vec<&'a str> {
    let (mut parts, mut depth, mut from) = (vec![], 0_i32, 0);
    for (at, letter) in text.char_indices() {
        match letter {
            '(' => depth += 1,
            ')' => depth -= 1,
            _ if depth == 0 && at >= from && text[at..].starts_with(word) => {
                parts.push(text[from..at].trim());
                from = at + word.len();
            }
            _ => {}
        }
    }
    parts.push(text[from..].trim());
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_choice_of_allowed_licences_is_enough() {
        for good in [
            "one v1.0.0|MIT",
            "one v1.0.0 (proc-macro)|MIT OR GPL-3.0-only",
            "one v1.0.0|Unlicense/MIT",
            "one v1.0.0|(MIT OR Apache-2.0) AND Unicode-3.0",
            "one v1.0.0|Apache-2.0 WITH LLVM-exception",
            "serialport v4.0.0|MPL-2.0",
        ] {
            assert_eq!(wrong_crate(good, "/ours"), None, "{good}");
        }
        for bad in [
            "one v1.0.0|",
            "one v1.0.0|GPL-3.0-only",
            "one v1.0.0|MPL-2.0",
            "one v1.0.0|MIT AND GPL-3.0-only",
            "one v1.0.0|(MIT OR Apache-2.0) AND OpenSSL",
            "one v1.0.0|GPL-2.0 OR MIT AND OpenSSL",
            "openssl-sys v0.9.0|MIT",
        ] {
            assert!(wrong_crate(bad, "/ours").is_some(), "{bad}");
        }
    }

    #[test]
    fn a_source_beside_the_registry_is_named() {
        let of = |about: &str| wrong_crate(&format!("{about}|MIT"), "/ours");
        for good in [
            "one v1.0.0",
            "one v1.0.0 (proc-macro)",
            "mine v0.1.0 (/ours/mine)",
            "mine v0.1.0 (/ours/mine) (proc-macro)",
        ] {
            assert_eq!(of(good), None, "{good}");
        }
        for bad in [
            "one v1.0.0 (ssh://somewhere/one#0123)",
            "one v1.0.0 (registry `somewhere`)",
            "one v1.0.0 (/theirs/one)",
        ] {
            assert!(of(bad).is_some(), "{bad}");
        }
    }
}
