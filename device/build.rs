//! Source revision of the images, for [`Identity`](../protocol/src/system.rs).
use std::path::Path;
use std::process::Command;

fn main() {
    // Outside a repository, or within another one, the image reports revision 0.
    let root = Path::new("..").canonicalize().ok();
    let top = git(&["rev-parse", "--show-toplevel"]);
    let is_ours = root.is_some() && top.and_then(|top| Path::new(&top).canonicalize().ok()) == root;
    let ask = |arguments: &[&str]| is_ours.then(|| git(arguments)).flatten();
    let commit = ask(&["rev-parse", "HEAD"]);
    let commit = commit.as_ref().and_then(|hash| hash.get(..8));
    let changes = ask(&["status", "--porcelain", "--untracked-files=no"]);
    let dirty = changes.is_some_and(|changes| !changes.is_empty());
    println!(
        "cargo:rustc-env=RETROGRADE_COMMIT={}",
        commit.unwrap_or("0")
    );
    println!("cargo:rustc-env=RETROGRADE_DIRTY={}", u8::from(dirty));
    // Every commit and checkout writes this log; cargo watches the images' sources directly.
    if let Some(log) = ask(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo:rerun-if-changed={log}");
    } else if Path::new("../.git").exists() {
        println!("cargo:warning=git reports no revision, so the image reports 0: see `git status`");
    }
    for file in ["Cargo.lock", "Cargo.toml", "memory.x"] {
        println!("cargo:rerun-if-changed=../{file}");
    }
    // Every crate of ours that an image is built from.
    for part in [
        "device",
        "firmware-rig",
        "firmware-rig/measurements",
        "firmware-capsule",
        "motion",
        "planning",
        "protocol",
        "wiring",
    ] {
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
