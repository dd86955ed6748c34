//! Source revision of the images, for [`Identity`](../protocol/src/system.rs), and of the tool.
use std::path::Path;
use std::process::Command;

/// Every crate of ours that an image is built from.
const IMAGES: [&str; 8] = [
    "device",
    "firmware-rig",
    "firmware-rig/measurements",
    "firmware-capsule",
    "motion",
    "planning",
    "protocol",
    "wiring",
];
/// What the tool is built from besides.
const TOOL: [&str; 6] = [
    "host-tool",
    "host-tool/client",
    "host-tool/lab",
    "host-tool/report",
    "host-tool/serve",
    "models/locomotion",
];

fn main() {
    // Within another repository the revision is not ours.
    let root = Path::new("..").canonicalize().ok();
    let top = git(&["rev-parse", "--show-toplevel"]);
    let is_ours = root.is_some() && top.and_then(|top| Path::new(&top).canonicalize().ok()) == root;
    let ask = |arguments: &[&str]| is_ours.then(|| git(arguments)).flatten();
    // Outside of a repository the builder may name the commit: an archive of the sources does.
    let given = std::env::var("RETROGRADE_COMMIT").ok();
    let commit = ask(&["rev-parse", "HEAD"]).or(given);
    let digits = commit.as_ref().and_then(|hash| hash.get(..8));
    let is_hex = |digits: &&str| u32::from_str_radix(digits, 16).is_ok();
    let digits = digits.filter(is_hex).unwrap_or("0");
    assert!(
        commit.is_none() || digits != "0",
        "RETROGRADE_COMMIT is no commit: give its first 8 hex digits or more"
    );
    let changes = ask(&["status", "--porcelain", "--untracked-files=no"]);
    let dirty = changes.is_some_and(|changes| !changes.is_empty());
    println!("cargo:rustc-env=RETROGRADE_COMMIT={digits}");
    println!("cargo:rustc-env=RETROGRADE_DIRTY={}", u8::from(dirty));
    let shown = if digits == "0" { "unknown" } else { digits };
    let mark = if dirty { "-dirty" } else { "" };
    println!("cargo:rustc-env=RETROGRADE_REVISION={shown}{mark}");
    println!("cargo:rerun-if-env-changed=RETROGRADE_COMMIT");
    // Every commit and checkout writes this log; cargo watches the sources directly.
    if let Some(log) = ask(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo:rerun-if-changed={log}");
    } else if Path::new("../.git").exists() {
        println!("cargo:warning=git reports no revision, so it is unknown: see `git status`");
    }
    for file in ["Cargo.lock", "Cargo.toml", "memory.x"] {
        println!("cargo:rerun-if-changed=../{file}");
    }
    let is_tool = std::env::var("CARGO_PKG_NAME").is_ok_and(|name| name == "host-tool");
    let more = TOOL.iter().filter(|_| is_tool);
    for part in IMAGES.iter().chain(more) {
        println!("cargo:rerun-if-changed=../{part}/src");
        println!("cargo:rerun-if-changed=../{part}/Cargo.toml");
    }
}

fn git(arguments: &[&str]) -> Option<String> {
    let mut command = Command::new("git");
    // A git hook sets these variables, perhaps for another folder.
    for variable in ["GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"] {
        command.env_remove(variable);
    }
    let output = command.args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
