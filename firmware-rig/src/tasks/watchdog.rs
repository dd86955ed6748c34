//! Feeds the watchdog only when motion, link and control have all checked in.

use crate::channels::{CHECK_INS, SNAPSHOT};
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

/// To be called in every round of a client's loop. Not inlined: the virtual bench lets tasks hang here.
#[inline(never)]
pub fn check_in(client: Client) {
    CHECK_INS.fetch_or(client as u8, Ordering::Relaxed);
}

/// Every 150 ms: five rounds fit into the watchdog's 800 ms. Also shows the state on the LED.
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
        round = (round + 1) % 8;
        let state = SNAPSHOT.lock(|snapshot| snapshot.get().state);
        led.set_level((pattern(state) >> round & 1 == 1).into());
    }
}

/// One bit per round, 1 = lit; eight rounds are 1.2 s.
fn pattern(state: RigState) -> u8 {
    match state {
        RigState::Ready => 0b1111_1111,
        RigState::Unhomed => 0b0000_1111,
        RigState::Held => 0b0000_0101,
        RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping => 0b0111_1111,
        RigState::Faulted => 0b0101_0101,
    }
}
