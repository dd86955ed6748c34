//! The structure of the workspace: what the crates and their files import from each other.
//!
//! * No two files import each other, directly or by way of others; nor do two modules of a crate, each with the files
//!   below it.
//! * Crates import in one direction, which cargo enforces, and only as `docs/architecture.md` draws it.
//! * No crate is larger than a fifth of the source, no source file longer than 800 lines, no function longer than 100.
//!
//! Imports are read from the text: `use`, and paths that begin with `crate`, `self` or `super`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use crate::process::{Failure, Result, host_cargo, lines_of, root};

/// Largest share of the source that one crate may be, percent.
const MOST_PERCENT: usize = 20;
/// Longest source file, lines.
const MOST_LINES: usize = 800;
/// Files that may be longer, each with the reason.
const LONGER: [(&str, &str); 1] = [(
    "virtual-bench/src/emulator.rs",
    "one processor with its peripherals; the parts that stand alone are files below it",
)];
/// Longest function, lines.
const MOST_LINES_OF_FUNCTION: usize = 100;
/// Functions that may be longer, by file and name, each with the reason.
const LONGER_FUNCTIONS: [(&str, &str, &str); 4] = [
    (
        "firmware-capsule/src/fold.rs",
        "decide",
        "one table of states and readings",
    ),
    (
        "firmware-capsule/src/leg.rs",
        "decide",
        "one table of readings",
    ),
    (
        "virtual-bench/src/cycles/thumb.rs",
        "instructions_are_told_apart",
        "one table of encodings",
    ),
    (
        "virtual-bench/src/figures.rs",
        "run",
        "one figure after the other, each from the last",
    ),
];
/// Crates that only test: they count as tests, not as source.
const TESTING: [&str; 4] = ["exemplars", "fuzz", "simulated-machines", "step-peers"];
/// Crates that a crate must not import, and why.
const APART: [(&str, &[&str], &str); 4] = [
    (
        "virtual-bench",
        &["motion", "planning", "firmware-rig", "firmware-capsule"],
        "it judges the images, so it must not share the code that it judges",
    ),
    (
        "campaign",
        &["calibration", "analysis", "serve"],
        "it knows no science",
    ),
    ("analysis", &["operations", "serve"], "it knows no line"),
    (
        "serve",
        &["analysis"],
        "it shows what is going on; `report` evaluates it",
    ),
];
/// Root of the one test program of a crate.
const ALL_TESTS: &str = "tests/all.rs";
/// The images, and the script that puts the source revision into them.
const IMAGES: [&str; 2] = ["firmware-rig", "firmware-capsule"];
const REVISION: &str = "device/build.rs";
/// Where the figure of the crates is.
const FIGURE: &str = "docs/architecture.md";

/// A package of the workspace.
#[derive(Debug)]
struct Package {
    name: String,
    folder: PathBuf,
    /// Packages of the workspace that it depends on, without those of its tests.
    depends: BTreeSet<String>,
}

/// A crate that is compiled as one: library, program or test.
#[derive(Debug)]
struct Unit {
    /// Files by the path of their module.
    modules: BTreeMap<Vec<String>, PathBuf>,
}

/// Checks all of it.
pub(crate) fn check() -> Result<()> {
    let packages = packages()?;
    let mut wrong = vec![];
    for package in &packages {
        let units = units(&package.folder)?;
        wrong.extend(unnamed(&package.folder, &units));
        for unit in units {
            let imports = unit.imports()?;
            wrong.extend(
                circles(&imports)
                    .iter()
                    .map(|circle| format!("these files import each other: {}", circle.join(", "))),
            );
            let rooms = unit.rooms(&imports);
            wrong.extend(circles(&rooms).iter().map(|circle| {
                let modules = circle.join(", ");
                format!(
                    "in {}, these modules import each other: {modules}",
                    package.name
                )
            }));
        }
    }
    wrong.extend(sizes(&packages)?);
    wrong.extend(apart(&packages));
    let drawn = fs::read_to_string(root().join(FIGURE)).unwrap_or_default();
    wrong.extend(figure(&drawn, &packages));
    wrong.extend(unwatched(&read(&root().join(REVISION))?, &packages));
    if wrong.is_empty() {
        return Ok(());
    }
    Err(Failure::new(
        wrong.join("\n"),
        "move what both need into a third file below them; `xtask/src/structure.rs` says what is kept",
    ))
}

/// The packages of the workspace.
fn packages() -> Result<Vec<Package>> {
    let mut cargo = host_cargo("metadata");
    cargo.args(["--no-deps", "--format-version", "1"]);
    let text = lines_of(&mut cargo, "cargo metadata should work")?.join("\n");
    let manifests = text.split("\"manifest_path\":\"").skip(1);
    let manifests: BTreeSet<_> = manifests
        .filter_map(|rest| rest.split('"').next())
        .collect();
    let mut packages: Vec<_> = manifests.into_iter().filter_map(package).collect();
    let names: BTreeSet<_> = packages
        .iter()
        .map(|package| package.name.clone())
        .collect();
    for package in &mut packages {
        package.depends.retain(|name| names.contains(name));
    }
    Ok(packages)
}

/// Reads a manifest: names and sections, which is all that is needed here.
fn package(manifest: &str) -> Option<Package> {
    let text = fs::read_to_string(manifest).ok()?;
    let folder = Path::new(manifest).parent()?.to_path_buf();
    let (mut section, mut name, mut depends) = ("", None, BTreeSet::new());
    for line in text.lines() {
        if line.starts_with('[') {
            section = line.trim();
        } else if section == "[package]"
            && let Some(value) = line.strip_prefix("name = ")
        {
            name = Some(value.trim_matches('"').to_owned());
        } else if section.ends_with("dependencies]") && !section.contains("dev-") {
            let key = line.split(['.', '=', ' ']).next().unwrap_or_default();
            depends.insert(key.to_owned());
        }
    }
    Some(Package {
        name: name?,
        folder,
        depends,
    })
}

/// The crates of a package: its library and programs, and each of its test programs and examples.
fn units(folder: &Path) -> Result<Vec<Unit>> {
    let mut roots = vec![];
    for name in ["src/lib.rs", "src/main.rs"] {
        roots.push(folder.join(name));
    }
    // Further programs have their root in the manifest.
    let manifest = read(&folder.join("Cargo.toml"))?;
    let named = manifest
        .lines()
        .filter_map(|line| line.strip_prefix("path = \"src/"));
    roots.extend(named.map(|rest| folder.join("src").join(rest.trim_end_matches('"'))));
    roots.push(folder.join(ALL_TESTS));
    for kind in ["tests", "examples"] {
        if kind == "tests" && folder.join(ALL_TESTS).is_file() {
            continue;
        }
        let Ok(entries) = fs::read_dir(folder.join(kind)) else {
            continue;
        };
        for entry in entries.flatten() {
            let path = entry.path();
            roots.push(match path.is_dir() {
                true => path.join("main.rs"),
                false => path,
            });
        }
    }
    roots.retain(|root| root.is_file() && root.extension().is_some_and(|end| end == "rs"));
    roots.sort();
    roots.dedup();
    roots.iter().map(|root| Unit::read(root)).collect()
}

/// Test files that no program names: they would not be built.
fn unnamed(folder: &Path, units: &[Unit]) -> Vec<String> {
    let named: BTreeSet<_> = units
        .iter()
        .flat_map(|unit| unit.modules.values())
        .collect();
    let (mut folders, mut wrong) = (vec![folder.join("tests")], vec![]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            let path = entry.path();
            // Other folders hold what programs share by `#[path]`.
            if path.join("main.rs").is_file() {
                folders.push(path);
            } else if path.extension().is_some_and(|end| end == "rs") && !named.contains(&path) {
                wrong.push(format!("{} is in no test program", path.display()));
            }
        }
    }
    wrong
}

impl Unit {
    /// Follows the declarations of modules from the root of a crate.
    fn read(root: &Path) -> Result<Self> {
        let mut modules = BTreeMap::new();
        let mut open = vec![(vec![], root.to_path_buf())];
        while let Some((module, file)) = open.pop() {
            let text = read(&file)?;
            let folder = folder_of(&file, module.is_empty());
            let mut path: Option<String> = None;
            for line in text.lines() {
                if let Some(rest) = line.strip_prefix("#[path = \"") {
                    path = rest.split('"').next().map(str::to_owned);
                } else if let Some(name) = declared(line) {
                    let beside = file.parent().unwrap_or(Path::new("."));
                    let found = match path.take() {
                        Some(path) => Some(beside.join(path)),
                        None => [format!("{name}.rs"), format!("{name}/mod.rs")]
                            .iter()
                            .map(|name| folder.join(name))
                            .find(|file| file.is_file()),
                    };
                    if let Some(found) = found {
                        let mut inner = module.clone();
                        inner.push(name.to_owned());
                        open.push((inner, found));
                    }
                } else if !line.starts_with("#[") {
                    path = None;
                }
            }
            modules.insert(module, file);
        }
        Ok(Self { modules })
    }

    /// The files that each file imports from.
    fn imports(&self) -> Result<BTreeMap<String, BTreeSet<String>>> {
        let mut imports = BTreeMap::new();
        for (module, file) in &self.modules {
            let mut from = BTreeSet::new();
            for path in paths(&read(file)?, module) {
                let target = self.file_of(&path);
                if target != file {
                    from.insert(shown(target));
                }
            }
            imports.insert(shown(file), from);
        }
        Ok(imports)
    }

    /// The file that defines what a path names: that of the innermost module on it.
    fn file_of(&self, path: &[String]) -> &Path {
        (0..=path.len())
            .rev()
            .find_map(|length| self.modules.get(&path[..length]))
            .map_or(Path::new(""), PathBuf::as_path)
    }

    /// The imports between the modules below the root, each with all files below it.
    fn rooms(
        &self,
        imports: &BTreeMap<String, BTreeSet<String>>,
    ) -> BTreeMap<String, BTreeSet<String>> {
        let room: BTreeMap<_, _> = self
            .modules
            .iter()
            .map(|(module, file)| {
                let first = module.first().map_or("the root", String::as_str);
                (shown(file), first.to_owned())
            })
            .collect();
        let mut rooms: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
        for (file, from) in imports {
            let inner = rooms.entry(room[file].clone()).or_default();
            inner.extend(from.iter().map(|file| room[file].clone()));
            inner.remove(&room[file]);
        }
        rooms
    }
}

/// The folder where the modules of a file are.
fn folder_of(file: &Path, is_root: bool) -> PathBuf {
    let beside = file.parent().unwrap_or(Path::new("."));
    let stem = file.file_stem().unwrap_or_default();
    match is_root || stem == "mod" {
        true => beside.to_path_buf(),
        false => beside.join(stem),
    }
}

/// The module that a line declares, if it is in a file of its own.
fn declared(line: &str) -> Option<&str> {
    let line = line.strip_prefix("pub(crate) ").unwrap_or(line);
    let line = line.strip_prefix("pub ").unwrap_or(line);
    line.strip_prefix("mod ")?.strip_suffix(';')
}

fn read(file: &Path) -> Result<String> {
    fs::read_to_string(file).map_err(|io| {
        Failure::new(
            format!("{}: {io}", file.display()),
            "is the checkout whole?",
        )
    })
}

/// As a person would name the file.
fn shown(file: &Path) -> String {
    file.strip_prefix(root())
        .unwrap_or(file)
        .display()
        .to_string()
}

/// All paths within the crate that a file names, from the root of the crate.
fn paths(text: &str, module: &[String]) -> Vec<Vec<String>> {
    let tokens = tokens(text);
    let mut found = vec![];
    // Modules that are open within the file, each with the depth of its brace.
    let (mut inline, mut depth) = (Vec::<(String, usize)>::new(), 0);
    let mut at = 0;
    while at < tokens.len() {
        match tokens[at].as_str() {
            "{" => depth += 1,
            "}" => {
                depth = usize::saturating_sub(depth, 1);
                inline.retain(|(_, opened)| *opened <= depth);
            }
            "mod" if tokens.get(at + 2).is_some_and(|next| next == "{") => {
                inline.push((tokens[at + 1].clone(), depth + 1));
            }
            "crate" | "super" | "self"
                if tokens.get(at + 1).is_some_and(|next| next == "::")
                    && (at == 0 || tokens[at - 1] != "::") =>
            {
                let mut here = module.to_vec();
                here.extend(inline.iter().map(|(name, _)| name.clone()));
                tree(&tokens, at, &here, &mut found);
            }
            _ => {}
        }
        at += 1;
    }
    found
}

/// The paths of a tree of imports that begins here: `crate::a::{b, c::d}`.
fn tree(tokens: &[String], at: usize, here: &[String], found: &mut Vec<Vec<String>>) {
    let mut path = match tokens[at].as_str() {
        "crate" => vec![],
        "super" => here[..here.len().saturating_sub(1)].to_vec(),
        _ => here.to_vec(),
    };
    let mut at = at + 1;
    while tokens.get(at).is_some_and(|token| token == "::") {
        match tokens.get(at + 1).map(String::as_str) {
            Some("super") => {
                path.pop();
            }
            Some("{") => {
                branches(tokens, at + 2, &path, found);
                return;
            }
            Some(name) => path.push(name.to_owned()),
            None => break,
        }
        at += 2;
    }
    found.push(path);
}

/// The paths within a pair of braces that opened before `at`; returns where it closes.
fn branches(
    tokens: &[String],
    mut at: usize,
    path: &[String],
    found: &mut Vec<Vec<String>>,
) -> usize {
    while at < tokens.len() && tokens[at] != "}" {
        let mut inner = path.to_vec();
        while at < tokens.len() && tokens[at] != "," && tokens[at] != "}" {
            match tokens[at].as_str() {
                "{" => {
                    at = branches(tokens, at + 1, &inner, found);
                }
                "::" | "self" | "as" => {}
                name => inner.push(name.to_owned()),
            }
            at += 1;
        }
        found.push(inner);
        at += usize::from(tokens.get(at).is_some_and(|token| token == ","));
    }
    at
}

/// Words, `::` and single characters, without comments and the inside of strings.
fn tokens(text: &str) -> Vec<String> {
    let mut tokens = vec![];
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let length = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if first == '"' {
            quoted(rest)
        } else if let Some(raw) = raw_string(rest) {
            raw
        } else if first == '\'' && rest[1..].starts_with(['"', '{', '}', '\\']) {
            rest[2..].find('\'').map_or(1, |end| end + 3)
        } else if rest.starts_with("::") {
            tokens.push("::".to_owned());
            2
        } else if first.is_alphanumeric() || first == '_' {
            let end = rest
                .find(|c: char| !c.is_alphanumeric() && c != '_')
                .unwrap_or(rest.len());
            tokens.push(rest[..end].to_owned());
            end
        } else {
            if !first.is_whitespace() {
                tokens.push(first.to_string());
            }
            first.len_utf8()
        };
        rest = &rest[length..];
    }
    tokens
}

/// The length of a string literal that begins here.
fn quoted(text: &str) -> usize {
    let mut escaped = false;
    for (at, c) in text.char_indices().skip(1) {
        match c {
            _ if escaped => escaped = false,
            '\\' => escaped = true,
            '"' => return at + 1,
            _ => {}
        }
    }
    text.len()
}

/// The length of a raw string literal, if one begins here.
fn raw_string(text: &str) -> Option<usize> {
    let hashes = text.strip_prefix('r')?;
    let count = hashes.len() - hashes.trim_start_matches('#').len();
    let inside = hashes[count..].strip_prefix('"')?;
    let end = format!("\"{}", "#".repeat(count));
    let length = inside.find(&end).unwrap_or(inside.len());
    Some((text.len() - inside.len() + length + end.len()).min(text.len()))
}

/// The groups of nodes that reach each other.
fn circles(edges: &BTreeMap<String, BTreeSet<String>>) -> Vec<Vec<String>> {
    let reached: BTreeMap<_, _> = edges
        .keys()
        .map(|node| (node, reach(node, edges)))
        .collect();
    let mut circles = BTreeSet::new();
    for (node, far) in &reached {
        if far.contains(*node) {
            let back = |other: &&String| reached.get(other).is_some_and(|far| far.contains(*node));
            circles.insert(far.iter().filter(back).cloned().collect::<Vec<_>>());
        }
    }
    circles.into_iter().collect()
}

/// All nodes on the ways from this one.
fn reach(node: &str, edges: &BTreeMap<String, BTreeSet<String>>) -> BTreeSet<String> {
    let (mut far, mut open) = (BTreeSet::new(), vec![node]);
    while let Some(node) = open.pop() {
        for next in edges.get(node).into_iter().flatten() {
            if far.insert(next.clone()) {
                open.push(next);
            }
        }
    }
    far
}

/// Each source file of a folder, with its text.
fn sources(folder: &Path) -> Result<Vec<(PathBuf, String)>> {
    let (mut files, mut open) = (vec![], vec![folder.to_path_buf()]);
    while let Some(folder) = open.pop() {
        let Ok(entries) = fs::read_dir(&folder) else {
            continue;
        };
        for entry in entries.flatten() {
            let path = entry.path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|end| end == "rs") {
                let text = read(&path)?;
                files.push((path, text));
            }
        }
    }
    files.sort();
    Ok(files)
}

/// The functions with a body in a formatted text, with their lines.
fn functions(text: &str) -> Vec<(&str, usize)> {
    let lines: Vec<_> = text.lines().collect();
    let mut found = vec![];
    for (at, line) in lines.iter().enumerate() {
        let from = &lines[at..];
        let Some(name) = function(line) else {
            continue;
        };
        let opens = from.iter().position(|line| line.ends_with(['{', '}', ';']));
        let Some(head) = opens.filter(|head| from[*head].ends_with('{')) else {
            continue;
        };
        let indent = &line[..line.len() - line.trim_start().len()];
        let closes = |line: &&str| line.strip_prefix(indent) == Some("}");
        if let Some(body) = from[head..].iter().position(closes) {
            found.push((name, head + body + 1));
        }
    }
    found
}

/// The function that a line begins.
fn function(line: &str) -> Option<&str> {
    let (before, rest) = line.split_once("fn ")?;
    let words = ["pub", "const", "async", "unsafe", "extern"];
    let mut before = before.split_whitespace();
    let is_head =
        before.all(|word| words.iter().any(|known| word.starts_with(known)) || word == "\"C\"");
    let name = rest.split(['(', '<']).next()?;
    is_head.then_some(name)
}

/// Crates, files and functions that are too large.
fn sizes(packages: &[Package]) -> Result<Vec<String>> {
    let mut wrong = vec![];
    let mut of_package = vec![];
    for package in packages {
        let (mut lines, files) = (0, sources(&package.folder.join("src"))?);
        for (file, text) in &files {
            let (file, count) = (shown(file), text.lines().count());
            lines += count;
            if count > MOST_LINES && !LONGER.iter().any(|(name, _)| *name == file) {
                wrong.push(format!(
                    "{file} has {count} lines; {MOST_LINES} are the most"
                ));
            }
            for (function, count) in functions(text) {
                let known =
                    |(known, name, _): &(&str, &str, &str)| (*known, *name) == (&*file, function);
                if count > MOST_LINES_OF_FUNCTION && !LONGER_FUNCTIONS.iter().any(known) {
                    wrong.push(format!(
                        "{file}: `{function}` has {count} lines; {MOST_LINES_OF_FUNCTION} are the most"
                    ));
                }
            }
        }
        if !TESTING.contains(&package.name.as_str()) {
            of_package.push((&package.name, lines));
        }
    }
    let all: usize = of_package.iter().map(|(_, count)| count).sum();
    for (name, count) in of_package {
        if count * 100 > all * MOST_PERCENT {
            wrong.push(format!(
                "{name} has {count} of {all} lines of source; {MOST_PERCENT} % are the most"
            ));
        }
    }
    Ok(wrong)
}

/// Crates that import what they must not.
fn apart(packages: &[Package]) -> Vec<String> {
    let mut wrong = vec![];
    for (name, forbidden, why) in APART {
        let of = packages.iter().filter(|package| package.name == name);
        for depends in of.map(|package| &package.depends) {
            let found = forbidden.iter().filter(|other| depends.contains(**other));
            wrong.extend(found.map(|other| format!("{name} imports {other}: {why}")));
        }
    }
    wrong
}

/// Crates of an image that the script of the revision does not watch: a change there would leave the old revision in the
/// image.
fn unwatched(script: &str, packages: &[Package]) -> Vec<String> {
    let edges = edges(packages);
    let is_inside = |name: &str| {
        IMAGES
            .iter()
            .any(|image| *image == name || reach(image, &edges).contains(name))
    };
    packages
        .iter()
        .filter(|package| is_inside(&package.name))
        .map(|package| shown(&package.folder))
        .filter(|folder| !script.contains(&format!("\"{folder}\",")))
        .map(|folder| format!("{REVISION} does not watch {folder}/src"))
        .collect()
}

fn edges(packages: &[Package]) -> BTreeMap<String, BTreeSet<String>> {
    packages
        .iter()
        .map(|package| (package.name.clone(), package.depends.clone()))
        .collect()
}

/// The differences between the figure and the manifests. It draws every dependency that does not follow from others.
fn figure(text: &str, packages: &[Package]) -> Vec<String> {
    let drawn: BTreeSet<_> = text
        .lines()
        .filter_map(|line| line.trim().split_once(" --> "))
        .map(|(from, to)| (from.to_owned(), to.to_owned()))
        .collect();
    let edges = edges(packages);
    let direct: BTreeSet<_> = packages
        .iter()
        .flat_map(|package| {
            let others = package.depends.iter().filter(|to| {
                let by = package.depends.iter().filter(|by| by != to);
                !by.into_iter().any(|by| reach(by, &edges).contains(*to))
            });
            others.map(|to| (package.name.clone(), to.clone()))
        })
        .collect();
    let missing = direct.difference(&drawn);
    let wrong = drawn.difference(&direct);
    missing
        .map(|(from, to)| format!("{FIGURE} lacks the line `{from} --> {to}`"))
        .chain(wrong.map(|(from, to)| {
            format!(
                "{FIGURE} has the line `{from} --> {to}`, which is not so, or follows from others"
            )
        }))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(paths: &[&str]) -> Vec<Vec<String>> {
        let split = |path: &&str| path.split("::").map(str::to_owned).collect();
        paths.iter().map(split).collect()
    }

    #[test]
    fn imports_are_read_as_trees_and_as_paths() {
        let text = r##"
            use crate::a::{self, B, c::{D, E}};
            use super::x::Y; // crate::comment
            const T: &str = "crate::string \" crate::still";
            const R: &str = r#"crate::raw""#;
            fn f(c: char) -> bool { crate::z::g(c == '"') }
            mod tests { use super::*; use super::super::w::V; }
        "##;
        let mut found = paths(text, &["m".to_owned(), "n".to_owned()]);
        found.sort();
        let mut expected = words(&[
            "a", "a::B", "a::c", "a::c::D", "a::c::E", "m::x::Y", "m::n::*", "m::w::V", "z::g",
        ]);
        expected.sort();
        assert_eq!(found, expected);
    }

    #[test]
    fn functions_are_measured_from_head_to_brace() {
        let text = "impl A {\n    pub(crate) fn a<T>(\n        b: u8,\n    ) -> T {\n        loop {\n        }\n    }\n    fn c();\n}\n\
            fn d() {}\nconst fn e() {\n    let f: fn (u8);\n}\n";
        assert_eq!(functions(text), [("a", 6), ("e", 3)]);
    }

    #[test]
    fn a_circle_is_found_through_others() {
        let edge = |from: &str, to: &[&str]| {
            (
                from.to_owned(),
                to.iter().map(|to| (*to).to_owned()).collect(),
            )
        };
        let edges = [
            edge("a", &["b"]),
            edge("b", &["c"]),
            edge("c", &["a"]),
            edge("d", &["a"]),
        ]
        .into();
        assert_eq!(circles(&edges), [["a", "b", "c"]]);
    }

    #[test]
    fn the_revision_watches_whatever_is_in_an_image() {
        let package = |name: &str, depends: &[&str]| Package {
            name: name.to_owned(),
            folder: root().join(name),
            depends: depends.iter().map(|name| (*name).to_owned()).collect(),
        };
        let packages = [
            package("firmware-rig", &["device"]),
            package("device", &["wiring"]),
            package("wiring", &[]),
            package("serve", &["wiring"]),
        ];
        let found = unwatched("\"firmware-rig\",\n\"device\",", &packages);
        assert_eq!(found, ["device/build.rs does not watch wiring/src"]);
        let found = unwatched("\"firmware-rig\", \"device\", \"wiring\",", &packages);
        assert_eq!(found, Vec::<String>::new());
    }

    #[test]
    fn the_figure_needs_only_what_does_not_follow() {
        let package = |name: &str, depends: &[&str]| Package {
            name: name.to_owned(),
            folder: PathBuf::new(),
            depends: depends.iter().map(|name| (*name).to_owned()).collect(),
        };
        let packages = [
            package("a", &["b", "c"]),
            package("b", &["c"]),
            package("c", &[]),
        ];
        assert!(figure("  a --> b\n  b --> c\n", &packages).is_empty());
        assert_eq!(figure("  a --> b\n", &packages).len(), 1);
        assert_eq!(
            figure("  a --> b\n  b --> c\n  a --> c\n", &packages).len(),
            1
        );
    }
}
