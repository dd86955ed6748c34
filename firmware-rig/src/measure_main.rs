//! The image that measures on a board what the emulator cannot prove: `cargo xtask board`. It never switches the
//! driver on.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![cfg_attr(target_os = "none", deny(unsafe_code))]

#[cfg(target_os = "none")]
#[allow(dead_code, reason = "the rig's hardware as it is, without its tasks")]
mod board;
#[cfg(target_os = "none")]
mod measure;

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("This is firmware: `cargo xtask board` runs it on a board.");
}
