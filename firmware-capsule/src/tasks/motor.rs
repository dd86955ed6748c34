//! Sets the bridge and reads the sensors. Decides nothing but one thing: an order that control does not confirm any
//! more is not carried out.

use crate::{
    board::DriveTrain,
    channels::{ORDER, ORDER_CHANGED, READINGS, Reading},
    watchdog::{CHECK_IN, Client, check_in},
};
use embassy_futures::select::select;
use embassy_time::{Duration, Instant, Timer};
use firmware_capsule::fold::Drive;

/// Readings while the bridge is awake.
const PERIOD: Duration = Duration::from_millis(1);
/// Control confirms with every reading; twenty missed ones, and the motor is braked.
const STALE_US: u64 = 20_000;

/// Every 1 ms while the bridge is awake, else every 100 ms; at once after a new order. Runs in an interrupt, above
/// everything but the time base, because the current limits count on its period.
#[embassy_executor::task]
pub(crate) async fn motor(mut drive_train: DriveTrain) -> ! {
    let mut next = Instant::now();
    let mut stale = false;
    loop {
        check_in(Client::Motor);
        let sample = drive_train.sample();
        let now = Instant::now();
        READINGS.signal(Reading {
            at_us: now.as_micros(),
            sample,
        });
        let order = ORDER.lock(|order| order.get());
        let age_us = now.as_micros().saturating_sub(order.confirmed_us);
        let was_stale = core::mem::replace(
            &mut stale,
            age_us > STALE_US && matches!(order.drive, Drive::Millivolts(_)),
        );
        let drive = if stale { Drive::Brake } else { order.drive };
        drive_train.set(drive);
        if stale && !was_stale {
            defmt::error!("control is silent: motor braked");
        }
        next = if drive == Drive::Off {
            now + CHECK_IN
        } else {
            // On the grid of the period, but after a rest on a new one.
            (next + PERIOD).clamp(now, now + PERIOD)
        };
        // Either way there is something to do.
        let _ = select(Timer::at(next), ORDER_CHANGED.wait()).await;
        let order = ORDER.lock(|order| order.get());
        if !stale {
            drive_train.set(order.drive);
        }
    }
}
