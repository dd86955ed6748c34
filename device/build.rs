//! Source revision of the images, for [`Identity`](../protocol/src/system.rs).
use std::process::Command;

fn main() {
    // Without a repository the image says 0: "built outside a repository".
    let commit = git(&["rev-parse", "HEAD"]);
    let commit = commit.as_ref().and_then(|hash| hash.get(..8));
    let changes = git(&["status", "--porcelain", "--untracked-files=no"]);
    let dirty = changes.is_some_and(|changes| !changes.is_empty());
    println!(
        "cargo:rustc-env=RETROGRADE_COMMIT={}",
        commit.unwrap_or("0")
    );
    println!("cargo:rustc-env=RETROGRADE_DIRTY={}", u8::from(dirty));
    // Every commit and checkout writes this log; edits of the images' sources are watched directly.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo:rerun-if-changed={log}");
    }
    for part in [
        "device",
        "firmware-rig",
        "firmware-capsule",
        "motion",
        "planning",
        "protocol",
    ] {
        println!("cargo:rerun-if-changed=../{part}/src");
    }
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
