//! The tasks; the table in this package's README says how often each runs and why.

use super::{
    channels::{ORDER, ORDER_CHANGED, Order, READINGS, SNAPSHOT},
    drive_train::DriveTrain,
    pins, timers,
};
use device::chip::watchdog::{self, CHECK_IN, check_in};
use device::{
    chip::{
        channels::{REPLIES, REQUESTS},
        flash::Sectors,
        link,
        surroundings::OnChip,
        telemetry,
    },
    retained::Retained,
    service::Answers,
    supervision::Client,
};
use embassy_futures::select::{Either, Either3, select, select3};
use embassy_stm32::{
    mode::Async,
    peripherals,
    usart::{RingBufferedUartRx, UartTx},
    wdg::IndependentWatchdog,
};
use embassy_time::{Duration, Instant, Timer};
use firmware_capsule::{
    control::{self, Control},
    sense::SETTLED_US,
    speed::Drive,
};
use protocol::{
    capsule::CapsuleTelemetry,
    system::{Identity, ResetCause},
    table::Telemetry,
};

/// Interval of readings while the bridge is awake.
const PERIOD: Duration = Duration::from_millis(1);
/// Age at which control's order is stale, us: twenty readings. The motor is then braked.
const STALE_US: u64 = 20_000;
/// Time from power-up of encoder and amplifier to valid levels: 0.5 ms for both, assumed, so check their data sheets; then
/// the filter behind the amplifier charges, 1 kohm and 160 nF, to 0.2 mA within nine of its time constants.
const SENSORS_START: Duration = Duration::from_millis(2);

/// Sets the bridge and reads the sensors: every 1 ms while the bridge is awake, else every 100 ms; at once after a new
/// order. Runs in an interrupt, above everything but the time base, because the current limits count on its period.
/// Decides two things by itself: it brakes if control stops confirming the order, and at rest it powers the sensors for
/// the readings only, once two of them have shown that the motor stands.
#[embassy_executor::task]
pub(crate) async fn motor(mut drive_train: DriveTrain) -> ! {
    // The first reading has to measure the amplifier's zero: with a reading, motions may begin.
    let mut next = Instant::from_micros(SETTLED_US);
    Timer::at(next).await;
    let mut stale = false;
    let mut rested_at = None;
    loop {
        check_in(Client::Motion);
        if !timers::encoder_is_counted() {
            // The counter keeps its value: edges from switching the encoder are not counted, and the worm holds the motor.
            pins::power_sensors(true);
            Timer::after(SENSORS_START).await;
            timers::count_encoder(true);
        }
        let sample = drive_train.sample(Instant::now().as_micros());
        let now = Instant::now();
        READINGS.signal((now.as_micros(), sample));
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
        let rests_at = (drive == Drive::Off).then_some(sample.counts);
        if rests_at.is_some() && rests_at == rested_at {
            timers::count_encoder(false);
            pins::power_sensors(false);
        }
        rested_at = rests_at;
        next = if drive == Drive::Off {
            now + if drive_train.zero.is_doubted() {
                PERIOD
            } else {
                CHECK_IN
            }
        } else {
            // Keep to the grid of the period; after a rest, begin a new one.
            (next + PERIOD).clamp(now, now + PERIOD)
        };
        wait(&mut drive_train, next, stale, drive).await;
    }
}

/// Waits for the next reading and sets new orders meanwhile: the speed loop orders after each reading. Returns at once
/// if the bridge has to wake up: without sensors nothing may be driven, so a reading comes first.
async fn wait(drive_train: &mut DriveTrain, next: Instant, stale: bool, mut drive: Drive) {
    while let Either::Second(()) = select(Timer::at(next), ORDER_CHANGED.wait()).await {
        if stale {
            return; // control is back
        }
        let was = core::mem::replace(&mut drive, ORDER.lock(|order| order.get()).drive);
        if was == Drive::Off && drive != Drive::Off {
            return;
        }
        drive_train.set(drive);
    }
}

/// Runs at every reading (1 ms while moving, else 100 ms) and at every request.
#[embassy_executor::task]
pub(crate) async fn control(sectors: Sectors, previous: Retained, cause: ResetCause) -> ! {
    let mut control = Control::new(Capsule, sectors, previous, cause);
    loop {
        check_in(Client::Control);
        match select3(REQUESTS.wait(), READINGS.wait(), Timer::after(CHECK_IN)).await {
            Either3::First(inbound) => REPLIES.signal(control.answer(inbound)),
            Either3::Second((at_us, sample)) => control.read(at_us, sample),
            // The motor task is silent: the watchdog resets the chip.
            Either3::Third(()) => {}
        }
    }
}

struct Capsule;

impl OnChip for Capsule {}

impl control::Capsule for Capsule {
    fn drive(&mut self, drive: Drive) {
        let confirmed_us = Instant::now().as_micros();
        let before = ORDER.lock(|order| {
            order.replace(Order {
                drive,
                confirmed_us,
            })
        });
        if before.drive != drive {
            ORDER_CHANGED.signal(());
        }
    }

    fn show(&mut self, telemetry: CapsuleTelemetry) {
        SNAPSHOT.lock(|snapshot| snapshot.set(Some(telemetry)));
    }
}

#[embassy_executor::task]
pub(crate) async fn transmit(uart: UartTx<'static, Async>) -> ! {
    link::transmit(uart).await
}

/// Runs when bytes have come, and at least every 100 ms. An urgent stop has no shorter way than through control.
#[embassy_executor::task]
pub(crate) async fn receive(uart: RingBufferedUartRx<'static>, identity: Identity) -> ! {
    link::receive(uart, identity, |_| ()).await
}

#[embassy_executor::task]
pub(crate) async fn telemetry() -> ! {
    telemetry::run(|now| {
        let snapshot = SNAPSHOT.lock(|snapshot| snapshot.get())?;
        Some(Telemetry::Capsule(CapsuleTelemetry {
            time_us: now.as_micros(),
            ..snapshot
        }))
    })
    .await
}

#[embassy_executor::task]
pub(crate) async fn watchdog(watchdog: IndependentWatchdog<'static, peripherals::IWDG>) -> ! {
    watchdog::run(watchdog, || ()).await
}
