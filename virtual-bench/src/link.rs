//! The host tool's link to a machine on the bench, in virtual time.

use client::link::{Link, LinkError};

use crate::bench::{Bench, BenchError};
use crate::emulator::Wiring;
use crate::fixture::Plug;

/// A serial cable to a machine on the bench. Its clock is the machine's, which runs only during `receive`.
pub struct VirtualLink<W: Wiring> {
    bench: Bench<W>,
    place: &'static str,
    plug: Plug,
}

impl<W: Wiring> VirtualLink<W> {
    /// The link to `bench`, called `place` in messages.
    #[must_use]
    pub fn new(bench: &Bench<W>, place: &'static str) -> Self {
        Self {
            bench: bench.clone(),
            place,
            plug: Plug::default(),
        }
    }

    /// The same with a plug that the fixture can pull.
    #[must_use]
    pub fn with_plug(self, plug: Plug) -> Self {
        Self { plug, ..self }
    }

    /// Fails while the plug is out, as a port does when its board is gone.
    fn unless_pulled(&self) -> Result<(), LinkError> {
        if self.plug.is_in() {
            return Ok(());
        }
        Err(LinkError::Lost {
            place: self.place.into(),
            why: "the cable is pulled".into(),
        })
    }

    fn lost(&self, why: &BenchError) -> LinkError {
        LinkError::Lost {
            place: self.place.into(),
            why: why.to_string(),
        }
    }
}

impl<W: Wiring> Link for VirtualLink<W> {
    fn place(&self) -> String {
        self.place.into()
    }

    fn now_us(&self) -> u64 {
        self.bench.now_ns() / 1_000
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.unless_pulled()?;
        self.bench.cable().send(bytes);
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        self.unless_pulled()?;
        let mut cable = self.bench.cable();
        loop {
            let count = cable.take_received(buffer);
            if count > 0 || cable.now_ns() / 1_000 >= deadline_us {
                return Ok(count);
            }
            let ran = cable.run(deadline_us * 1_000, true);
            ran.map_err(|why| self.lost(&why))?;
        }
    }
}
