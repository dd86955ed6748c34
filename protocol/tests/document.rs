//! docs/protocol.md agrees with the code. This file makes its tables and examples from the schema of the messages,
//! their doc comments and the exemplars: `BLESS=1 cargo test -p protocol --test all document` writes them. The parts
//! written by hand (ranges, refusals, effects of a request) are compared name by name, and the failure names the
//! missing row.

use postcard_schema::{
    Schema,
    schema::{DataModelType, DataModelVariant, NamedType, NamedValue},
};
use protocol::{
    VERSION,
    client::{ATTEMPTS, FLASH_ATTEMPTS, RETRY_AFTER_US},
    events::RING,
    frame::{Encoded, Frame, Header, Kind, MAX_BODY, MAX_FRAME, encode},
    session::CACHED_REPLIES,
    settings::{MAX_NAME, SettingKey, SettingRule},
    system::{EVENTS_PER_REPLY, Event, GetEvents, Hello, KeepAlive, Urgent},
    table::{Impact, Reply, Request, SCHEMA_KEY, Telemetry},
};
use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::{Debug, Write},
    fs,
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

/// Source files of the messages: name, heading in the document, text.
const SOURCES: [(&str, &str, &str); 6] = [
    (
        "table",
        "What a frame carries",
        include_str!("../src/table.rs"),
    ),
    (
        "system",
        "Both machines",
        concat!(
            include_str!("../src/kind.rs"),
            include_str!("../src/system.rs")
        ),
    ),
    ("rig", "The rig", include_str!("../src/rig.rs")),
    (
        "settings",
        "Settings of the rig",
        include_str!("../src/settings.rs"),
    ),
    ("capsule", "The capsule", include_str!("../src/capsule.rs")),
    (
        "error",
        "Refusals and errors",
        include_str!("../src/error.rs"),
    ),
];

const BLESS: &str = "`BLESS=1 cargo test -p protocol --test all document` writes what is generated";
const HOW: &str = "docs/protocol.md must be enough to write a client without reading Rust";

// ---- The document ----

fn path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/protocol.md")
}

fn document() -> String {
    let text = fs::read_to_string(path()).expect("docs/protocol.md is part of the sources");
    text.replace("\r\n", "\n")
}

/// A generated part of the document, between its marks.
fn part<'a>(document: &'a str, name: &str) -> &'a str {
    let begin = format!("<!-- generated: {name} -->\n");
    let at = document
        .find(&begin)
        .unwrap_or_else(|| panic!("docs/protocol.md lacks the mark {begin}"))
        + begin.len();
    let length = document[at..]
        .find("<!-- end -->")
        .unwrap_or_else(|| panic!("docs/protocol.md: the part {name} has no `<!-- end -->`"));
    &document[at..at + length]
}

/// Compares a generated part, or writes it.
fn check(name: &str, wanted: &str) {
    // The tests of this file run in parallel, and each writes its part.
    static WRITING: Mutex<()> = Mutex::new(());
    let _writing = WRITING.lock().unwrap_or_else(PoisonError::into_inner);
    let wanted = format!("\n{}\n", wanted.trim_matches('\n')) + "\n";
    let document = document();
    let found = part(&document, name);
    if found == wanted {
        return;
    }
    if std::env::var_os("BLESS").is_some() {
        let at = found.as_ptr() as usize - document.as_ptr() as usize;
        let text = [&document[..at], &wanted, &document[at + found.len()..]].concat();
        fs::write(path(), text).expect("docs/protocol.md can be written");
        return;
    }
    let lines = |text: &str| text.lines().map(str::to_owned).collect::<BTreeSet<_>>();
    let (is, should) = (lines(found), lines(&wanted));
    let list = |lines: Vec<&String>| lines.iter().fold(String::new(), |all, l| all + l + "\n");
    panic!(
        "docs/protocol.md, part `{name}`, is not what the code says.\n\nadd these lines:\n{}\nremove these lines:\n{}\n\
         `BLESS=1 cargo test -p protocol --test all document` does both.",
        list(should.difference(&is).collect()),
        list(is.difference(&should).collect()),
    );
}

// ---- The sources: doc comments and types as they are written ----

/// A type, field or variant with its doc comment.
#[derive(Clone, Debug, Default)]
struct Written {
    /// The doc comment, without Rust's links.
    meaning: String,
    /// Type of a field, as written.
    kind: String,
}

/// Removes from a doc comment what only rustdoc understands.
fn plain(doc: &str) -> String {
    let mut text = String::new();
    let mut rest = doc;
    while let Some(at) = rest.find("[`") {
        let Some(length) = rest[at..].find("`]") else {
            break;
        };
        let name = &rest[at + 2..at + length];
        text += &rest[..at];
        let _ = write!(text, "`{}`", name.rsplit("::").next().unwrap_or(name));
        rest = &rest[at + length + 2..];
    }
    text += rest;
    text.replace("..= ", " to ")
        .replace("..=", " to ")
        .replace("..", " to ")
        .replace("`SCHEMA_KEY`", "The schema key")
        .replace("`u64::MAX`", "18446744073709551615")
        .replace("`u32::MAX`", "4294967295")
}

/// Finds `Type`, `Type.field`, `Type.Variant`, `Type.Variant.field` in a file by the layout that rustfmt gives it.
fn read(source: &str) -> BTreeMap<String, Written> {
    let mut found = BTreeMap::new();
    let (mut doc, mut of_type, mut of_variant) = (Vec::new(), String::new(), String::new());
    let mut in_attribute = false;
    for line in source.lines() {
        let text = line.trim_start();
        let depth = (line.len() - text.len()) / 4;
        if let Some(comment) = text.strip_prefix("///") {
            doc.push(comment.trim());
            continue;
        }
        // A long list of derives takes several lines.
        in_attribute |= text.starts_with("#[");
        if in_attribute || text.starts_with("//") {
            in_attribute &= !text.ends_with(']');
            continue;
        }
        let written = |kind: &str| Written {
            meaning: plain(&doc.join(" ")),
            kind: kind.to_owned(),
        };
        let text = text.strip_prefix("pub ").unwrap_or(text);
        let word = |text: &str| -> String {
            text.chars()
                .take_while(|c| c.is_alphanumeric() || *c == '_')
                .collect()
        };
        if depth == 0 {
            of_type.clear();
            for keyword in ["struct ", "enum "] {
                if let Some(rest) = text.strip_prefix(keyword) {
                    of_type = word(rest);
                    found.insert(of_type.clone(), written(""));
                }
            }
        } else if !of_type.is_empty() && !doc.is_empty() {
            let name = word(text);
            let kind = text[name.len()..]
                .strip_prefix(": ")
                .map(|kind| kind.trim_end_matches(','));
            let place = match (depth, kind) {
                (1, Some(_)) => format!("{of_type}.{name}"),
                (1, None) => {
                    of_variant.clone_from(&name);
                    format!("{of_type}.{name}")
                }
                _ => format!("{of_type}.{of_variant}.{name}"),
            };
            found.insert(place, written(kind.unwrap_or("")));
        }
        doc.clear();
    }
    found
}

/// The entries of all files, and the file of each type.
struct Sources {
    written: BTreeMap<String, Written>,
    file: BTreeMap<String, &'static str>,
}

impl Sources {
    fn new() -> Self {
        let (mut written, mut file) = (BTreeMap::new(), BTreeMap::new());
        for (name, _, text) in SOURCES {
            for (place, what) in read(text) {
                if !place.contains('.') {
                    file.insert(place.clone(), name);
                }
                written.insert(place, what);
            }
        }
        Self { written, file }
    }

    fn get(&self, place: &str) -> &Written {
        let written = self.written.get(place);
        written.unwrap_or_else(|| panic!("{place} has no doc comment in protocol/src: {HOW}"))
    }

    /// The text of a table cell.
    fn meaning(&self, place: &str) -> String {
        let meaning = &self.get(place).meaning;
        assert!(meaning.len() > 3, "{place}: say what it is: {HOW}");
        meaning.replace('|', "\\|")
    }
}

// ---- Types ----

/// The type's name in our sources; none for integers, lists and the like.
fn own_name(ty: &'static NamedType) -> Option<&'static str> {
    matches!(
        ty.ty,
        DataModelType::Struct(_)
            | DataModelType::Enum(_)
            | DataModelType::UnitStruct
            | DataModelType::NewtypeStruct(_)
    )
    .then_some(ty.name)
}

/// A type in the document's words. `written` is its Rust type, which has the capacities of lists and texts.
fn words(ty: &'static NamedType, written: &str) -> String {
    let bound = || -> usize {
        let inner = written
            .rsplit_once(['<', ' '])
            .map_or("", |(_, bound)| bound);
        match inner.trim_end_matches('>') {
            "EVENTS_PER_REPLY" => EVENTS_PER_REPLY,
            "MAX_TRACE_POINTS" => protocol::capsule::MAX_TRACE_POINTS,
            "MAX_NAME" => MAX_NAME,
            number => number.parse().unwrap_or_else(|_| {
                panic!("name the constant of `{written}` in tests/document.rs")
            }),
        }
    };
    match ty.ty {
        DataModelType::Bool => "bool".into(),
        DataModelType::U8 => "u8".into(),
        DataModelType::U16 => "u16".into(),
        DataModelType::U32 => "u32".into(),
        DataModelType::U64 => "u64".into(),
        DataModelType::I16 => "i16".into(),
        DataModelType::I32 => "i32".into(),
        DataModelType::I64 => "i64".into(),
        DataModelType::String => format!("text of at most {} bytes", bound()),
        DataModelType::Seq(item) => {
            format!("list of at most {} `{}`", bound(), item.name)
        }
        DataModelType::Tuple(items) => format!("{} times {}", items.len(), words(items[0], "")),
        DataModelType::Option(item) => format!("optional {}", words(item, "")),
        _ => match own_name(ty) {
            Some(name) => format!("`{name}`"),
            None => panic!("say in tests/document.rs what `{}` is called", ty.name),
        },
    }
}

/// The unit in the suffix of a field's name.
fn unit(name: &str) -> &'static str {
    let units = [
        ("_um_s2", "um/s2"),
        ("_um_s", "um/s"),
        ("_um", "um"),
        ("_us", "us"),
        ("_ms", "ms"),
        ("_ma", "mA"),
        ("_mv", "mV"),
        ("_mj", "mJ"),
        ("_hz", "Hz"),
        ("_ticks", "10 ns"),
        ("_steps", "steps"),
    ];
    let found = units.iter().find(|(end, _)| name.ends_with(end));
    match (found, name) {
        (Some((_, unit)), _) => unit,
        (None, "ticks") => "10 ns",
        (None, "steps" | "edges" | "commanded" | "counted") => "steps",
        (None, _) => "",
    }
}

/// All types reachable from these, each once.
fn types(roots: &[&'static NamedType]) -> BTreeMap<&'static str, &'static NamedType> {
    fn visit(ty: &'static NamedType, all: &mut BTreeMap<&'static str, &'static NamedType>) {
        if own_name(ty).is_some_and(|name| all.insert(name, ty).is_some()) {
            return;
        }
        let fields = |fields: &'static [&'static NamedValue], all: &mut _| {
            for field in fields {
                visit(field.ty, all);
            }
        };
        match ty.ty {
            DataModelType::Option(item)
            | DataModelType::Seq(item)
            | DataModelType::NewtypeStruct(item) => visit(item, all),
            DataModelType::Tuple(items) | DataModelType::TupleStruct(items) => {
                items.iter().for_each(|item| visit(item, all));
            }
            DataModelType::Struct(of) => fields(of, all),
            DataModelType::Enum(variants) => {
                for variant in *variants {
                    match variant.ty {
                        DataModelVariant::NewtypeVariant(item) => visit(item, all),
                        DataModelVariant::StructVariant(of) => fields(of, all),
                        DataModelVariant::UnitVariant => {}
                        DataModelVariant::TupleVariant(_) => {
                            panic!("{}: the document knows no tuples", variant.name)
                        }
                    }
                }
            }
            _ => {}
        }
    }
    let mut all = BTreeMap::new();
    roots.iter().for_each(|root| visit(root, &mut all));
    all
}

fn all_types() -> BTreeMap<&'static str, &'static NamedType> {
    types(&[
        Request::SCHEMA,
        Reply::SCHEMA,
        Telemetry::SCHEMA,
        Event::SCHEMA,
        Urgent::SCHEMA,
    ])
}

fn row(cells: &[&str]) -> String {
    let cells: Vec<_> = cells.iter().map(|cell| format!(" {cell} |")).collect();
    format!("|{}\n", cells.concat())
}

fn field_row(first: &[&str], place: &str, field: &NamedValue, sources: &Sources) -> String {
    let place = format!("{place}.{}", field.name);
    let kind = words(field.ty, &sources.get(&place).kind);
    let name = format!("`{}`", field.name);
    let rest = [
        name.as_str(),
        &kind,
        unit(field.name),
        &sources.meaning(&place),
    ];
    row(&[first, &rest].concat())
}

fn section(name: &str, ty: &'static NamedType, sources: &Sources) -> String {
    let mut text = format!("#### {name}\n\n{}\n\n", sources.meaning(name));
    match ty.ty {
        DataModelType::UnitStruct => {
            text.truncate(text.trim_end().len());
            text += " No bytes.\n";
        }
        DataModelType::Struct(fields) => {
            text += "| field | type | unit | meaning |\n|---|---|---|---|\n";
            for field in *fields {
                text += &field_row(&[], name, field, sources);
            }
        }
        DataModelType::Enum(variants) if name == "SettingKey" => {
            text += "| number | variant | name | unit | range | default | meaning |\n|---|---|---|---|---|---|---|\n";
            for (key, variant) in SettingKey::ALL.iter().zip(*variants) {
                let (number, range) = ((*key as u8).to_string(), key.range());
                text += &row(&[
                    &number,
                    &format!("`{}`", variant.name),
                    &format!("`{}`", key.name()),
                    &key.unit().replace('1', ""),
                    &format!("{} to {}", range.min, range.max),
                    &range.default.to_string(),
                    &plain(key.doc()),
                ]);
            }
        }
        DataModelType::Enum(variants) => {
            text += "| number | variant | content | type | unit | meaning |\n|---|---|---|---|---|---|\n";
            for (number, variant) in variants.iter().enumerate() {
                let place = format!("{name}.{}", variant.name);
                let (number, shown) = (number.to_string(), format!("`{}`", variant.name));
                let meaning = match name {
                    // The devices' texts also have the rule in words.
                    "SettingRule" => rule_text(variant.name),
                    _ => sources.meaning(&place),
                };
                match variant.ty {
                    DataModelVariant::NewtypeVariant(of) => {
                        text += &row(&[&number, &shown, "", &words(of, ""), "", &meaning]);
                    }
                    DataModelVariant::StructVariant(fields) => {
                        text += &row(&[&number, &shown, "", "", "", &meaning]);
                        for field in *fields {
                            text += &field_row(&["", ""], &place, field, sources);
                        }
                    }
                    _ => text += &row(&[&number, &shown, "", "", "", &meaning]),
                }
            }
        }
        _ => panic!("{name}: the document knows structs and enums"),
    }
    text + "\n"
}

fn rule_text(name: &str) -> String {
    let mut rules = SettingRule::ALL.into_iter();
    let rule = rules.find(|rule| format!("{rule:?}") == name);
    rule.expect("a variant of the schema is one of the table")
        .text()
        .to_owned()
}

/// Meaning of a type that a macro in `settings.rs` generates.
fn made_by_a_macro(name: &str) -> Option<&'static str> {
    match name {
        "SettingKey" => Some("Key of a setting, also the number of its record in flash."),
        "SettingRule" => Some(
            "Rules between settings; each variant lists the settings that it is about. Append only.",
        ),
        _ => None,
    }
}

#[test]
fn the_types_are_those_of_the_code() {
    let (sources, all) = (Sources::new(), all_types());
    let mut text = String::new();
    for (file, title, _) in SOURCES {
        let _ = write!(text, "### {title}\n\n");
        for (name, ty) in &all {
            // `Request` and `Response` have their own table.
            if ["Request", "Response"].contains(name) {
                continue;
            }
            let home = sources.file.get(*name).copied();
            let meaning = made_by_a_macro(name);
            let home = home.or(meaning.map(|_| "settings"));
            let home = home.unwrap_or_else(|| panic!("where in protocol/src is {name}?"));
            if home == file {
                let mut sources = Sources::new();
                if let Some(meaning) = meaning {
                    let written = Written {
                        meaning: meaning.into(),
                        ..Written::default()
                    };
                    sources.written.insert((*name).into(), written);
                }
                text += &section(name, ty, &sources);
            }
        }
    }
    check("types", &text);
}

// ---- Requests ----

/// Rows of the table in `table.rs`: number, name, module and type of the request, type of the response.
fn requests() -> Vec<(
    usize,
    &'static str,
    &'static str,
    &'static str,
    &'static str,
)> {
    let table = SOURCES[0].2;
    let table = &table[table.find("\ntable! {").expect("the table")..];
    let rows = table.lines().filter(|line| line.contains(" => "));
    let rows: Vec<_> = rows
        .enumerate()
        .map(|(number, line)| {
            let parts: Vec<_> = line.trim().split([':', ' ', ',']).collect();
            // `Home: rig::Home => rig::HomeAccepted, match ...`
            let parts: Vec<_> = parts.into_iter().filter(|part| !part.is_empty()).collect();
            (number, parts[0], parts[1], parts[2], parts[5])
        })
        .collect();
    let names: Vec<_> = rows.iter().map(|row| row.1).collect();
    assert_eq!(names, Request::NAMES, "the table was read wrongly");
    rows
}

#[test]
fn the_requests_are_those_of_the_code() {
    let exemplars = exemplars::requests();
    let mut text = String::from(
        "| number | request | its type | response | served by | changes | needs the same protocol |\n|---|---|---|---|---|---|---|\n",
    );
    for (number, name, module, request, response) in requests() {
        let exemplar = exemplars.iter().find(|request| request.name() == name);
        let exemplar = exemplar.unwrap_or_else(|| panic!("{name} has no exemplar"));
        let changes = match exemplar.impact() {
            Impact::None => "nothing",
            Impact::Fault => "the fault",
            Impact::Flash => "flash",
            Impact::Pace => "the run",
            Impact::Motion => "moves",
        };
        let machine = match module {
            "system" => "both",
            "rig" => "rig",
            "settings" => "both",
            module => module,
        };
        let matched = if exemplar.needs_match() { "yes" } else { "no" };
        text += &row(&[
            &number.to_string(),
            &format!("`{name}`"),
            &format!("`{request}`"),
            &format!("`{response}`"),
            machine,
            changes,
            matched,
        ]);
    }
    check("requests", &text);
}

/// Names in backquotes that begin the rows of a table written by hand.
fn rows_by_hand(heading: &str) -> BTreeSet<String> {
    let document = document();
    let at = document.find(heading);
    let at = at.unwrap_or_else(|| panic!("docs/protocol.md lacks the table below `{heading}`"));
    let lines = document[at..].lines().skip(1);
    let lines = lines.take_while(|line| !line.starts_with('#'));
    lines
        .filter_map(|line| line.strip_prefix("| `")?.split('`').next())
        .map(str::to_owned)
        .collect()
}

fn check_by_hand(heading: &str, wanted: BTreeSet<String>, cells: &str) {
    let found = rows_by_hand(heading);
    let missing: Vec<_> = wanted.difference(&found).collect();
    let surplus: Vec<_> = found.difference(&wanted).collect();
    let rows = missing.iter().fold(String::new(), |rows, name| {
        rows + &format!("| `{name}` | {cells} |\n")
    });
    assert!(
        missing.is_empty() && surplus.is_empty(),
        "docs/protocol.md, table below `{heading}`:\nadd a row for each of these, written by hand from what the firmware does:\n{rows}\n\
         remove the rows of {surplus:?}"
    );
}

#[test]
fn what_each_request_does_and_is_refused_for_is_written_down() {
    let wanted = Request::NAMES.iter().map(|name| (*name).to_owned());
    check_by_hand(
        "### What each request does",
        wanted.collect(),
        "what it does, when it is over | refused with",
    );
}

#[test]
fn every_field_of_a_request_has_its_range_written_down() {
    let all = all_types();
    let mut wanted = BTreeSet::new();
    let mut add = |of: &str, fields: &[&NamedValue]| {
        for field in fields {
            wanted.insert(format!("{of}.{}", field.name));
        }
    };
    for (_, _, _, request, _) in requests() {
        if let DataModelType::Struct(fields) = all[request].ty {
            add(request, fields);
            // An enum in a field has fields of its own.
            for field in *fields {
                if let DataModelType::Enum(variants) = field.ty.ty {
                    for variant in *variants {
                        if let DataModelVariant::StructVariant(fields) = variant.ty {
                            add(variant.name, fields);
                        }
                    }
                }
            }
        }
    }
    check_by_hand(
        "### Ranges",
        wanted,
        "smallest and largest value | refused with, and rounding",
    );
}

// ---- Numbers ----

#[test]
fn the_constants_are_those_of_the_code() {
    let key = SCHEMA_KEY;
    let constants: [(&str, String, &str); 13] = [
        (
            "version",
            format!("{}.{}", VERSION.major, VERSION.minor),
            "of the protocol that this page describes",
        ),
        (
            "schema key",
            format!("0x{key:016x} = {key}"),
            "fingerprint of all message types; take it as a number, it need not be computed",
        ),
        (
            "longest body",
            format!("{MAX_BODY} bytes"),
            "between header and CRC",
        ),
        (
            "longest frame",
            format!("{MAX_FRAME} bytes"),
            "on the wire, with both delimiters",
        ),
        (
            "kept replies",
            CACHED_REPLIES.to_string(),
            "per session, for requests that are sent again",
        ),
        (
            "kept events",
            RING.to_string(),
            "in the device, the newest ones since its start",
        ),
        (
            "events per reply",
            EVENTS_PER_REPLY.to_string(),
            "of `GetEvents`, at most",
        ),
        (
            "readings per reply",
            protocol::capsule::MAX_TRACE_POINTS.to_string(),
            "of `GetTrace`, at most",
        ),
        (
            "readings kept",
            protocol::capsule::KEPT_TRACE_POINTS.to_string(),
            "of an actuation (`KEPT_TRACE_POINTS`), 1 ms apart; of a longer one the last",
        ),
        ("longest name", format!("{MAX_NAME} bytes"), "of a rig"),
        (
            "retry after",
            format!("{} ms", RETRY_AFTER_US / 1_000),
            "what this project's host waits before it sends a request or a stop again",
        ),
        (
            "attempts",
            ATTEMPTS.to_string(),
            "how often this project's host sends a request or a stop before it gives up",
        ),
        (
            "attempts with flash",
            FLASH_ATTEMPTS.to_string(),
            "the same for requests that write to flash",
        ),
    ];
    let mut text = String::from("| number | value | of what |\n|---|---|---|\n");
    for (name, value, what) in constants {
        text += &row(&[name, &value, what]);
    }
    check("constants", &text);
}

/// Numbers in the text.
#[test]
fn the_numbers_in_the_text_are_those_of_the_code() {
    let (retry_ms, raw) = (RETRY_AFTER_US / 1_000, MAX_BODY + 8);
    let mut wanted = vec![
        format!("exactly one message, 0 to {MAX_BODY} bytes"),
        format!("a frame has {raw} bytes at most"),
        format!("one of the last {CACHED_REPLIES} answered"),
        format!("keeps the newest {RING}"),
        format!("{EVENTS_PER_REPLY} at a time"),
        format!("waits {retry_ms} ms between two tries"),
        format!("gives up after {ATTEMPTS}, or after {FLASH_ATTEMPTS}"),
        format!("at most {MAX_NAME} bytes of UTF-8"),
    ];
    for (kind, name) in [
        (Kind::Request, "request"),
        (Kind::Reply, "reply"),
        (Kind::Urgent, "urgent"),
        (Kind::Telemetry, "telemetry"),
        (Kind::Event, "event"),
    ] {
        wanted.push(format!("| {} | {name} |", kind as u8));
    }
    let document = document().split_whitespace().collect::<Vec<_>>().join(" ");
    wanted.retain(|text| !document.contains(text));
    assert!(
        wanted.is_empty(),
        "docs/protocol.md does not say {wanted:?}; correct the sentence that has the number, here or there"
    );
}

// ---- Examples ----

/// The bytes of a value, one group per number, text or variant, split by the schema alone.
fn groups(ty: &'static NamedType, bytes: &mut &[u8], into: &mut Vec<String>) {
    fn take(bytes: &mut &[u8], count: usize) -> String {
        let (taken, rest) = bytes.split_at(count);
        *bytes = rest;
        hex(taken)
    }
    fn varint(bytes: &mut &[u8]) -> (u64, String) {
        let length = 1 + bytes.iter().take_while(|byte| **byte >= 0x80).count();
        let number = bytes[..length].iter().rev();
        let number = number.fold(0, |number, byte| number << 7 | u64::from(byte & 0x7f));
        (number, take(bytes, length))
    }
    match ty.ty {
        DataModelType::Bool | DataModelType::U8 | DataModelType::I8 => into.push(take(bytes, 1)),
        DataModelType::U16
        | DataModelType::U32
        | DataModelType::U64
        | DataModelType::I16
        | DataModelType::I32
        | DataModelType::I64 => into.push(varint(bytes).1),
        DataModelType::String => {
            let (length, prefix) = varint(bytes);
            into.push(prefix);
            if length > 0 {
                into.push(take(bytes, length as usize));
            }
        }
        DataModelType::Option(item) => {
            let is_there = bytes[0] == 1;
            into.push(take(bytes, 1));
            if is_there {
                groups(item, bytes, into);
            }
        }
        DataModelType::Seq(item) => {
            let (count, prefix) = varint(bytes);
            into.push(prefix);
            (0..count).for_each(|_| groups(item, bytes, into));
        }
        DataModelType::Tuple(items) => {
            // A byte array stays in one group.
            into.push(take(bytes, items.len()));
        }
        DataModelType::NewtypeStruct(item) => groups(item, bytes, into),
        DataModelType::Struct(fields) => fields
            .iter()
            .for_each(|field| groups(field.ty, bytes, into)),
        DataModelType::Enum(variants) => {
            let (number, prefix) = varint(bytes);
            into.push(prefix);
            match variants[number as usize].ty {
                DataModelVariant::NewtypeVariant(item) => groups(item, bytes, into),
                DataModelVariant::StructVariant(fields) => fields
                    .iter()
                    .for_each(|field| groups(field.ty, bytes, into)),
                _ => {}
            }
        }
        DataModelType::Unit | DataModelType::UnitStruct => {}
        _ => panic!("say in tests/document.rs how a {} is encoded", ty.name),
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Value, body and frame of an example.
fn example<T: serde::Serialize + Schema + Debug>(header: Header, value: &T) -> String {
    let body = postcard::to_stdvec(value).expect("it can be encoded");
    let (mut rest, mut split) = (&body[..], Vec::new());
    groups(T::SCHEMA, &mut rest, &mut split);
    assert!(rest.is_empty(), "the schema does not cover {value:?}");
    let frame = encode(header, value).expect("every message fits");
    format!(
        "{value:?}\n  body  {}\n  frame {}\n",
        split.join(" "),
        hex(&frame)
    )
}

#[test]
fn the_examples_are_those_of_the_code() {
    let header = |kind| Header {
        kind,
        session: 0x5a,
        seq: 0x1234,
    };
    let mut text = String::new();
    let mut list = |title: &str, examples: Vec<String>| {
        let _ = write!(text, "### {title}\n\n```text\n{}```\n\n", examples.concat());
    };
    let of = |kind| header(kind);
    list(
        "Requests",
        exemplars::requests()
            .iter()
            .map(|message| example(of(Kind::Request), message))
            .collect(),
    );
    list(
        "Replies",
        exemplars::replies()
            .iter()
            .map(|message| example(of(Kind::Reply), message))
            .collect(),
    );
    list(
        "Urgent",
        [Urgent::Stop, Urgent::EStop]
            .iter()
            .map(|message| example(of(Kind::Urgent), message))
            .collect(),
    );
    list(
        "Telemetry",
        exemplars::telemetry()
            .iter()
            .map(|message| example(of(Kind::Telemetry), message))
            .collect(),
    );
    list(
        "Events",
        exemplars::events()
            .iter()
            .map(|message| example(of(Kind::Event), message))
            .collect(),
    );
    check("examples", &text);
}

/// The first frames of every client, with the present version and schema key.
#[test]
fn the_first_frames_are_those_of_the_code() {
    let request = |session, seq, request: &Request| {
        let header = Header {
            kind: Kind::Request,
            session,
            seq,
        };
        example(header, request)
    };
    let text = [
        "```text\n".to_owned(),
        "session 0, sequence 0\n".to_owned(),
        request(
            0,
            0,
            &Request::Hello(Hello {
                protocol: VERSION,
                schema_key: SCHEMA_KEY,
                nonce: 1,
            }),
        ),
        "\nthen in session 7, which the answer has named, sequence 1\n".to_owned(),
        request(7, 1, &Request::KeepAlive(KeepAlive)),
        "\nsequence 2\n".to_owned(),
        request(7, 2, &Request::GetEvents(GetEvents { from: u32::MAX })),
        "```\n".to_owned(),
    ];
    check("first frames", &text.concat());
}

/// A frame at every layer of its encoding.
#[test]
fn the_layers_of_a_frame_are_those_of_the_code() {
    let header = Header {
        kind: Kind::Request,
        session: 7,
        seq: 0x0201,
    };
    let requests = exemplars::requests();
    let request = requests.iter().find(|request| request.name() == "MoveTo");
    let request = request.expect("an exemplar");
    let body = postcard::to_stdvec(request).expect("it can be encoded");
    let frame: Encoded = encode(header, request).expect("it fits");
    let raw = [&[1, 7, 1, 2][..], &body].concat();
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISCSI);
    let checked = [&raw[..], &crc.checksum(&raw).to_le_bytes()].concat();
    let mut coded = vec![0; cobs::max_encoding_length(checked.len())];
    let length = cobs::encode(&checked, &mut coded);
    coded.truncate(length);
    assert_eq!(hex(&frame), format!("00{}00", hex(&coded)));
    let cobs_of = |bytes: &[u8]| {
        let mut coded = vec![0; cobs::max_encoding_length(bytes.len())];
        let length = cobs::encode(bytes, &mut coded);
        hex(&coded[..length])
    };
    let text = format!(
        "```text\n{request:?}\nheader  01 07 0102        kind, session, sequence 0x0201\nbody    {}\nCRC     {}                of header and body, 0x{:08x}\nCOBS    {}\nframe   {}\n```\n\n\
         | to try a CRC or a COBS with | gives |\n|---|---|\n\
         | CRC-32C of the nine characters `123456789` | 0x{:08x} |\n| CRC-32C of nothing | 0x{:08x} |\n\
         | COBS of `00` | `{}` |\n| COBS of `11 22 00 33` | `{}` |\n",
        {
            let (mut rest, mut split) = (&body[..], Vec::new());
            groups(Request::SCHEMA, &mut rest, &mut split);
            split.join(" ")
        },
        hex(&crc.checksum(&raw).to_le_bytes()),
        crc.checksum(&raw),
        hex(&coded),
        hex(&frame),
        crc.checksum(b"123456789"),
        crc.checksum(b""),
        cobs_of(&[0]),
        cobs_of(&[0x11, 0x22, 0, 0x33]),
    );
    check("layers", &text);
}

/// The bytes in the document equal those of device and host: each frame is decoded and encoded again.
#[test]
fn every_frame_of_the_page_comes_back() {
    fn again<T: serde::de::DeserializeOwned + serde::Serialize + Debug>(
        frame: &Frame<'_>,
    ) -> (String, Encoded) {
        let value: T = frame
            .decode()
            .unwrap_or_else(|| panic!("{frame:?} of docs/protocol.md is no message; {BLESS}"));
        let encoded = encode(frame.header, &value).expect("it fits");
        (format!("{value:?}"), encoded)
    }
    let (document, mut said, mut frames) = (document(), "", 0);
    for line in document.lines() {
        let Some(text) = line.strip_prefix("  frame ") else {
            if !line.starts_with("  ") {
                said = line;
            }
            continue;
        };
        let bytes: Vec<_> = (0..text.len() / 2)
            .map(|at| u8::from_str_radix(&text[2 * at..2 * at + 2], 16).expect("hexadecimal"))
            .collect();
        let mut deframer = protocol::frame::Deframer::new();
        let (last, before) = bytes.split_last().expect("bytes");
        for byte in before {
            assert!(deframer.push(*byte).is_none(), "{said}");
        }
        let frame = deframer.push(*last).expect(said);
        let (value, encoded) = match frame.header.kind {
            Kind::Request => again::<Request>(&frame),
            Kind::Reply => again::<Reply>(&frame),
            Kind::Urgent => again::<Urgent>(&frame),
            Kind::Telemetry => again::<Telemetry>(&frame),
            Kind::Event => again::<Event>(&frame),
        };
        assert_eq!((value.as_str(), &encoded[..]), (said, &bytes[..]));
        frames += 1;
    }
    let exemplars = exemplars::frames::all().len();
    assert!(frames >= exemplars, "{frames} of {exemplars}");
}

/// The client in Python is written by hand from the document, so it has to agree with the document.
#[test]
fn the_serial_client_knows_this_protocol() {
    let client = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/examples/serial_client.py");
    let client = fs::read_to_string(client).expect("it is part of the sources");
    let mut missing = String::new();
    let (high, low) = (SCHEMA_KEY >> 32, SCHEMA_KEY & 0xffff_ffff);
    for line in [
        format!("VERSION = ({}, {})", VERSION.major, VERSION.minor),
        format!("SCHEMA_KEY = 0x{high:08X}{low:08X}"),
    ] {
        if !client.lines().any(|has| has == line) {
            let _ = writeln!(missing, "  {line}");
        }
    }
    // Its lists of variants are strings, some of which continue on the next line.
    let pieces = client.split('"').filter(|piece| !piece.trim().is_empty());
    let joined = pieces.collect::<String>();
    // Types that it neither requests nor reads by name.
    let unused = [
        "Request",
        "Response",
        "SettingRule",
        "Clock",
        "BrownOut",
        "Direction",
        "Urgent",
    ];
    let all = all_types();
    for (name, ty) in &all {
        let DataModelType::Enum(variants) = ty.ty else {
            continue;
        };
        let names: Vec<_> = variants.iter().map(|variant| variant.name).collect();
        let names = names.join(" ");
        if !unused.contains(name) && !joined.contains(&names) {
            let _ = writeln!(missing, "  {name}: enum(\"{names}\")");
        }
    }
    // Types that it reads: every field, in order.
    for name in [
        "ActuationAccepted",
        "ActuationRecord",
        "CapsuleStatus",
        "CapsuleTelemetry",
        "Event",
        "Events",
        "HomeAccepted",
        "Identity",
        "Revision",
        "RigInputs",
        "RigStatus",
        "RigTelemetry",
        "Run",
        "RunAccepted",
        "RunRecord",
        "Stroke",
        "Version",
    ] {
        let DataModelType::Struct(fields) = all[name].ty else {
            panic!("{name} has fields")
        };
        let names: Vec<_> = fields.iter().map(|field| field.name).collect();
        if !has_struct(&client, &names) {
            let _ = writeln!(missing, "  {name}: struct({}=...)", names.join("=..., "));
        }
    }
    assert!(
        missing.is_empty(),
        "docs/examples/serial_client.py lacks this, or has it in another order; write it there as docs/protocol.md has it:\n{missing}"
    );
}

/// Whether some `struct(...)` has exactly these fields.
fn has_struct(client: &str, names: &[&str]) -> bool {
    let begins = client.match_indices("struct(");
    begins
        .map(|(at, word)| &client[at + word.len()..])
        .any(|inside| {
            // Take the fields of this struct only, not those of a nested one or of one that follows.
            let (mut depth, mut own) = (0, String::new());
            for c in inside.chars() {
                match c {
                    '(' => depth += 1,
                    ')' if depth == 0 => break,
                    ')' => depth -= 1,
                    c if depth == 0 => own.push(c),
                    _ => {}
                }
            }
            let fields = own.split(',').filter_map(|field| field.split_once('='));
            fields
                .map(|(name, _)| name.trim())
                .eq(names.iter().copied())
        })
}
