//! Feeds the watchdog only when motor, link and control have all checked in.

use crate::channels::CHECK_INS;
use core::sync::atomic::Ordering;
use embassy_stm32::{peripherals, wdg::IndependentWatchdog};
use embassy_time::{Duration, Ticker};

/// Who has to check in.
#[derive(Clone, Copy)]
#[repr(u8)]
pub(crate) enum Client {
    /// Reads the sensors and sets the bridge.
    Motor = 1,
    /// Reads the serial port.
    Link = 2,
    /// Runs the state machine.
    Control = 4,
}

const ALL: u8 = Client::Motor as u8 | Client::Link as u8 | Client::Control as u8;

/// Each client checks in at least this often.
pub(crate) const CHECK_IN: Duration = Duration::from_millis(100);

/// To be called in every round of a client's loop.
pub(crate) fn check_in(client: Client) {
    CHECK_INS.fetch_or(client as u8, Ordering::Relaxed);
}

/// Every 150 ms: three rounds fit into the watchdog's 500 ms.
#[embassy_executor::task]
pub(crate) async fn watchdog(mut watchdog: IndependentWatchdog<'static, peripherals::IWDG>) -> ! {
    watchdog.unleash();
    let mut ticker = Ticker::every(Duration::from_millis(150));
    loop {
        ticker.next().await;
        if CHECK_INS.load(Ordering::Relaxed) == ALL {
            CHECK_INS.store(0, Ordering::Relaxed);
            watchdog.pet();
        }
    }
}
