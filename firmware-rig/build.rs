//! Link arguments and source revision of the image.
use std::process::Command;

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=../memory.x");
    // Link arguments live here and not in `rustflags`, which vanish when RUSTFLAGS is set: the link would then
    // succeed without a vector table. Equal functions are kept once.
    if std::env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("none") {
        for argument in ["--nmagic", "-Tlink.x", "-Tdefmt.x", "--icf=all"] {
            println!("cargo:rustc-link-arg-bins={argument}");
        }
    }
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok()?;
        output
            .status
            .success()
            .then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    // Without a repository the image says 0: "built outside a repository".
    let commit = git(&["rev-parse", "HEAD"]).and_then(|hash| hash.get(..8).map(str::to_owned));
    let dirty = git(&["status", "--porcelain", "--untracked-files=no"])
        .is_some_and(|changes| !changes.is_empty());
    println!(
        "cargo:rustc-env=RETROGRADE_COMMIT={}",
        commit.unwrap_or_else(|| "0".to_owned())
    );
    println!(
        "cargo:rustc-env=RETROGRADE_DIRTY={}",
        if dirty { "1" } else { "" }
    );
    if let Some(head) = git(&["rev-parse", "--git-path", "logs/HEAD"]) {
        println!("cargo:rerun-if-changed={head}");
    }
    println!("cargo:rerun-if-changed=src");
    println!("cargo:rerun-if-changed=../motion/src");
    println!("cargo:rerun-if-changed=../protocol/src");
}
