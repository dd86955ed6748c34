//! The text that a panic or a processor fault leaves. Built without `core::fmt`, which would take 9.5 KB of flash.

use heapless::{String, Vec};

/// Longest text, bytes; as in [`protocol::system::LastWords`].
pub const LONGEST: usize = 120;

/// Text of the last panic or processor fault.
pub type LastWords = String<LONGEST>;

/// Builds the last words. Text that does not fit is cut off.
#[derive(Debug, Default)]
pub struct Draft(Vec<u8, LONGEST>);

impl Draft {
    /// Begins with `text`.
    #[must_use]
    pub fn new(text: &str) -> Self {
        let mut draft = Self(Vec::new());
        draft.push(text);
        draft
    }

    /// Appends a text.
    pub fn push(&mut self, text: &str) {
        for byte in text.bytes() {
            let _ = self.0.push(byte);
        }
    }

    /// Appends an address as `0x...`.
    pub fn push_address(&mut self, address: u32) {
        self.push("0x");
        self.push_hex(address);
    }

    fn push_hex(&mut self, number: u32) {
        if number >= 16 {
            self.push_hex(number / 16);
        }
        let _ = self.0.push(b"0123456789abcdef"[number as usize % 16]);
    }

    /// The text so far.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }
}
