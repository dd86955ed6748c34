//! The capsule's image for the STM32L412TB: `main.rs` for another board. A name of its own keeps it away from where the F411's image lies.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![deny(unsafe_code)]

#[cfg(target_os = "none")]
mod board;

#[cfg(not(target_os = "none"))]
#[allow(clippy::print_stdout)]
fn main() {
    println!("This is firmware: build it with `cargo xtask images`.");
}
