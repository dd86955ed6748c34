//! Feeds the watchdog only when motion, link and control have all checked in.

use crate::channels::CHECK_INS;
use core::sync::atomic::Ordering;
use embassy_stm32::{gpio::Output, peripherals, wdg::IndependentWatchdog};
use embassy_time::{Duration, Ticker};
use protocol::rig::RigState;

/// Who has to check in.
#[derive(Clone, Copy)]
#[repr(u8)]
pub enum Client {
    /// Fills the step ring.
    Motion = 1,
    /// Reads the serial port.
    Link = 2,
    /// Runs the state machine.
    Control = 4,
}

/// How often each client checks in at least.
pub const CHECK_IN: Duration = Duration::from_millis(100);

/// To be called in every round of a client's loop.
pub fn check_in(client: Client) {
    CHECK_INS.fetch_or(client as u8, Ordering::Relaxed);
}

/// Every 150 ms: three rounds fit into the watchdog's 500 ms. Also shows the state on the LED: on = ready or
/// moving, slow blinking = not homed, fast blinking = fault.
#[embassy_executor::task]
pub async fn watchdog(
    mut watchdog: IndependentWatchdog<'static, peripherals::IWDG>,
    mut led: Output<'static>,
) -> ! {
    watchdog.unleash();
    let mut ticker = Ticker::every(Duration::from_millis(150));
    let mut round = 0_u8;
    loop {
        ticker.next().await;
        let all = Client::Motion as u8 | Client::Link as u8 | Client::Control as u8;
        if CHECK_INS.load(Ordering::Relaxed) == all {
            CHECK_INS.store(0, Ordering::Relaxed);
            watchdog.pet();
        }
        round = round.wrapping_add(1);
        match crate::channels::SNAPSHOT.lock(|snapshot| snapshot.get().state) {
            RigState::Faulted => led.set_level(round.is_multiple_of(2).into()),
            RigState::Unhomed => led.set_level((round % 8 < 4).into()),
            _ => led.set_high(),
        }
    }
}
