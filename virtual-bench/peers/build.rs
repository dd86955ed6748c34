//! The build script of the peers' image: it is linked as the firmware is, but without a log.
#![allow(clippy::print_stdout, reason = "cargo reads it")]

fn main() {
    println!("cargo:rerun-if-changed=../../memory.x");
    if std::env::var("CARGO_CFG_TARGET_OS").as_deref() == Ok("none") {
        for argument in ["--nmagic", "-Tlink.x", "--icf=all"] {
            println!("cargo:rustc-link-arg-bins={argument}");
        }
    }
}
