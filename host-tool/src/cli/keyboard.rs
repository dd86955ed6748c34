//! The person at the keyboard.

use std::io::{self, BufReader, IsTerminal};

use crate::cli::Keyboard;

/// Standard input, if a person sits at it.
pub(crate) fn standard() -> Option<Keyboard> {
    let input = io::stdin();
    input
        .is_terminal()
        .then(|| Box::new(BufReader::new(input)) as Keyboard)
}
