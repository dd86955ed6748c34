//! Prints the comparison table of `docs/science.md`.
#![allow(clippy::print_stdout)]

use locomotion::comparison::{Table, rows};
use locomotion::range::OutOfRange;

fn main() -> Result<(), OutOfRange> {
    print!("{}", Table(&rows()?));
    Ok(())
}
