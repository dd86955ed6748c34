//! The rig's image. The library has the logic; `board` wires it to the chip.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![cfg_attr(target_os = "none", deny(unsafe_code))]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod start;

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!(
        "This is firmware: flash it with `cargo rig`, or run it on the virtual bench with `cargo xtask demo`."
    );
}
