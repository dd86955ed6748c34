//! A link over which another process asks something.

use client::link::owner::Question;
use client::link::{Link, LinkError};

pub struct Asked {
    link: Box<dyn Link>,
    at_us: u64,
    question: Option<Question>,
}

impl Asked {
    /// The question comes at this time of the link.
    pub fn at(at_us: u64, link: Box<dyn Link>, question: Question) -> Self {
        Self {
            link,
            at_us,
            question: Some(question),
        }
    }
}

impl Link for Asked {
    fn place(&self) -> String {
        self.link.place()
    }

    fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.link.send(bytes)
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.link.receive(buffer, deadline_us)
    }

    fn question(&mut self) -> Option<Question> {
        let is_due = self.link.now_us() >= self.at_us;
        self.question.take_if(|_| is_due)
    }
}
