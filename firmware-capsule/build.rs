//! Link arguments and source revision of the image.
use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=../memory.x");
    // Link arguments live here and not in `rustflags`, which vanish when RUSTFLAGS is set: the link would then
    // succeed without a vector table.
    if std::env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("none") {
        for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x"] {
            println!("cargo:rustc-link-arg-bins={argument}");
        }
    }
    // Without a repository the image says 0: "built outside a repository".
    let commit = git(&["rev-parse", "--short=8", "HEAD"]).unwrap_or_else(|| "0".to_owned());
    let commit = commit.get(..8).unwrap_or("0");
    let changes = git(&["status", "--porcelain", "--untracked-files=no"]).unwrap_or_default();
    println!("cargo:rustc-env=RETROGRADE_COMMIT={commit}");
    println!(
        "cargo:rustc-env=RETROGRADE_DIRTY={}",
        u8::from(!changes.is_empty())
    );
    // Best effort: every commit and checkout writes this log; edits of our own sources are watched directly.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo:rerun-if-changed={log}");
    }
    for sources in ["src", "../protocol/src"] {
        println!("cargo:rerun-if-changed={sources}");
    }
}

fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_owned())
}
