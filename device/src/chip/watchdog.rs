//! Feeds the watchdog only when motion, link and control have all checked in.

use super::channels::CHECK_INS;
use crate::supervision::{CHECK_IN_MS, Client};
use embassy_stm32::{pac, peripherals, wdg::IndependentWatchdog};
use embassy_time::{Duration, Ticker};

/// Longest time between two check-ins of a client.
pub const CHECK_IN: Duration = Duration::from_millis(CHECK_IN_MS);

/// Interval of the watchdog's task: five rounds fit into the watchdog's 800 ms.
const ROUND: Duration = Duration::from_millis(150);

/// Call it in every round of a client's loop. Not inlined: the virtual bench injects hanging tasks here.
#[inline(never)]
pub fn check_in(client: Client) {
    CHECK_INS.note(client);
}

/// Lets the watchdog count while a debugger halts the processor: otherwise a halt would leave a motor driven. OpenOCD
/// freezes the watchdog at each attach (DBG_IWDG_STOP), and only a power cut clears that bit.
fn count_while_halted() {
    pac::DBGMCU.apb1fzr().modify(|w| w.set_iwdg(false));
}

/// Starts the watchdog and feeds it for ever; calls `each_round` every 150 ms.
pub async fn run(
    mut watchdog: IndependentWatchdog<'static, peripherals::IWDG>,
    mut each_round: impl FnMut(),
) -> ! {
    watchdog.unleash();
    let mut ticker = Ticker::every(ROUND);
    loop {
        ticker.next().await;
        count_while_halted();
        if CHECK_INS.complete() {
            watchdog.pet();
        }
        each_round();
    }
}
