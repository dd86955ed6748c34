//! The capsule's image. The library makes the decisions; `board` wires it to the chip.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![deny(unsafe_code)]

#[cfg(target_os = "none")]
mod board;

#[cfg(not(target_os = "none"))]
#[allow(clippy::print_stdout)]
fn main() {
    println!(
        "This is firmware: flash it with `cargo capsule`, or run it on the virtual bench with `cargo xtask demo`."
    );
}
