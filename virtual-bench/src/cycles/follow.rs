//! Runs an image on an emulator of its own whose instructions are followed one by one.

use std::fmt::Display;
use std::sync::{Arc, Mutex};

use rigless::emulator::{self, Driver, Start};
use rigless::image::Image;
use rigless::session::Session;
use rigless::time::VirtualNanos;

use crate::bench::BenchError;
use crate::emulator::{ChipOptions, Emulator, Program, Wiring};
use crate::serial::Serial;

/// Runs `image` until `driver` ends the run, and returns the driver.
///
/// # Errors
/// The emulator failed.
pub(crate) fn follow<W: Wiring, D: Driver<Emulator<W>> + 'static>(
    wiring: W,
    chip: ChipOptions,
    image: Image,
    serial: Arc<Mutex<Serial>>,
    driver: D,
) -> Result<D, BenchError> {
    fn ended(why: impl Display) -> BenchError {
        BenchError::Ended(why.to_string())
    }
    let images = [image];
    let program = Program::of(&images, chip.core_hz);
    // Every instruction is followed, so disable the shortcuts that skip events.
    let chip = ChipOptions {
        every_event: true,
        ..chip
    };
    let emulator = Emulator::new(wiring, chip, serial, 0, program).map_err(ended)?;
    let session = Session::new(Box::new(emulator), 0, VirtualNanos(0)).map_err(ended)?;
    let mut finished = emulator::run(session, &Start::new(&images), driver).map_err(ended)?;
    match finished.session.take_error() {
        Some(error) => Err(ended(error)),
        None => Ok(finished.driver),
    }
}
