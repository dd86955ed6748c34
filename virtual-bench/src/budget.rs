//! Battery budget of a study on a 40 mAh cell: the activity of the capsule's image, measured, times the consumption by
//! data sheet.

use client::{Device, Unobserved};
use protocol::capsule::Calibrate;
use protocol::system::DeviceKind;

use crate::bench::Bench;
use crate::boards::capsule::{self, CapsuleBoard};
use crate::link::VirtualLink;
use crate::plants::capsule::Parameters;
use crate::unmeasured::FigureError;

/// A lithium cell's charge, and the usable share of it [assumed].
const CELL_MAH: f64 = 40.0;
const USABLE: f64 = 0.8;
/// Folds, each with its unfolding, of a study.
const PAIRS: f64 = 500.0;
/// The chip at 16 MHz (HSI), mA: typical and maximum at 25 degrees C, the maximum with its peripherals on (DS10314, run
/// and sleep).
const RUN_MA: [f64; 2] = [1.9, 3.0];
const SLEEP_MA: [f64; 2] = [0.4, 1.3];
/// Encoder and amplifier, mA [assumed; the parts decide].
const SENSORS_MA: f64 = 8.3;
/// Constant load, mA: the battery's divider of 200 kohm, the regulator, a sleeping bridge [assumed].
const ALWAYS_MA: f64 = 0.03;
/// TIM3's compare register of the second input: it sets the pauses while the motor winds.
const WINDING_DUTY: u32 = 0x4000_0438;
/// Readings of a fold whose control latency is measured.
const READINGS: u64 = 200;
/// Interval at which the processor is sampled.
const LOOK_US: u64 = 20;

/// The measured activity of the image.
struct Measured {
    /// Share of the time that the processor is awake at rest.
    awake: f64,
    wake_ups_per_s: f64,
    /// Share of the time at rest that encoder and amplifier are powered.
    sensors: f64,
    /// Charge that the motor takes for a fold and an unfolding, mAh.
    pair_mah: f64,
    /// Time for which sensors and processor are on for that, s.
    pair_s: f64,
    order: Order,
}

/// Latency from a reading of a moving capsule to the duty that follows from it.
#[derive(Clone, Copy, Debug)]
pub struct Order {
    /// Mean.
    pub mean_us: f64,
    /// Longest of all.
    pub latest_us: f64,
    /// Share of the time that the processor is awake.
    pub awake: f64,
}

struct Resting {
    bench: Bench<CapsuleBoard>,
}

impl Resting {
    fn instructions(&self) -> Result<u64, FigureError> {
        Ok(self.bench.visit(|visit| visit.instructions())?)
    }

    fn sensors_ns(&self) -> Result<u64, FigureError> {
        Ok(self.bench.visit(|visit| {
            let now_ns = visit.now_ns();
            visit.board().sensors_powered_ns(now_ns)
        })?)
    }

    /// Shares of processor and sensors over ten seconds without a host.
    fn shares(&self) -> Result<(f64, f64), FigureError> {
        const SECONDS: f64 = 10.0;
        let (before, powered) = (self.instructions()?, self.sensors_ns()?);
        self.bench.advance_us((SECONDS * 1e6) as u64)?;
        let executed = (self.instructions()? - before) as f64;
        let sensors = (self.sensors_ns()? - powered) as f64 * 1e-9 / SECONDS;
        let possible = SECONDS * capsule::INSTRUCTIONS_PER_SECOND as f64;
        Ok((executed / possible, sensors))
    }

    fn wake_ups_in_a_second(&self) -> Result<f64, FigureError> {
        let (mut wake_ups, mut was_awake) = (0_u32, false);
        let mut before = self.instructions()?;
        for _ in 0..1_000_000 / LOOK_US {
            self.bench.advance_us(LOOK_US)?;
            let now = self.instructions()?;
            let awake = now > before;
            wake_ups += u32::from(awake && !was_awake);
            (was_awake, before) = (awake, now);
        }
        Ok(f64::from(wake_ups))
    }
}

/// Follows a fold under way for 0.2 s: the processor wakes up for each reading, and changes the duty.
///
/// # Errors
/// The emulator failed.
pub fn order(bench: &Bench<CapsuleBoard>) -> Result<Order, FigureError> {
    let look = || bench.visit(|visit| (visit.instructions(), visit.register(WINDING_DUTY)));
    let (mut before, mut duty) = look()?;
    let (mut began_us, mut taken_us) = (None, Vec::new());
    let (mut awake_looks, looks) = (0_u64, READINGS * 1_000 / LOOK_US);
    for at_us in (0..looks).map(|look| look * LOOK_US) {
        bench.advance_us(LOOK_US)?;
        let (now, ordered) = look()?;
        let awake = now > before;
        awake_looks += u64::from(awake);
        began_us = began_us.or((awake && at_us > 0).then_some(at_us));
        if ordered != duty
            && let Some(began_us) = began_us
        {
            taken_us.push((at_us + LOOK_US - began_us) as f64);
        }
        if !awake {
            began_us = None;
        }
        (before, duty) = (now, ordered);
    }
    Ok(Order {
        mean_us: taken_us.iter().sum::<f64>() / taken_us.len().max(1) as f64,
        latest_us: taken_us.into_iter().fold(0.0, f64::max),
        awake: awake_looks as f64 / looks as f64,
    })
}

fn measure() -> Result<Measured, FigureError> {
    let bench = capsule::start(Parameters::nominal())?;
    let link = Box::new(VirtualLink::new(&bench, "virtual capsule"));
    let mut device = Device::connect(link, DeviceKind::Capsule, 1)?;
    let accepted = device.call(Calibrate)?;
    device.wait_actuation(&accepted, &mut Unobserved)?;
    device.idle(1_500_000, &mut Unobserved)?;
    let resting = Resting { bench };
    let charge_c = |resting: &Resting| {
        resting
            .bench
            .visit(|visit| visit.board().capsule.plant().charge_c())
    };
    let (before_c, powered_ns) = (charge_c(&resting)?, resting.sensors_ns()?);
    let folding = device.fold()?;
    device.idle(400_000, &mut Unobserved)?;
    let order = order(&resting.bench)?;
    device.wait_actuation(&folding, &mut Unobserved)?;
    device.idle(500_000, &mut Unobserved)?;
    let unfolding = device.unfold()?;
    device.wait_actuation(&unfolding, &mut Unobserved)?;
    device.idle(500_000, &mut Unobserved)?;
    let pair_mah = (charge_c(&resting)? - before_c) / 3.6;
    let pair_s = (resting.sensors_ns()? - powered_ns) as f64 * 1e-9;
    drop(device);
    // Let the session time out and the last flash writes finish.
    resting.bench.advance_us(5_000_000)?;
    let (awake, sensors) = resting.shares()?;
    Ok(Measured {
        awake,
        wake_ups_per_s: resting.wake_ups_in_a_second()?,
        sensors,
        pair_mah,
        pair_s,
        order,
    })
}

/// Measures, and writes each line of the budget: the item, its value, its source.
///
/// # Errors
/// The emulator or the link failed.
pub fn run(line: &mut impl FnMut(&str, String, &str)) -> Result<(), FigureError> {
    let measured = measure()?;
    let percent = |share: f64| format!("{:.2} %", share * 1e2);
    line(
        "capsule at rest, no host: awake (10.4 M instructions/s)",
        percent(measured.awake),
        "",
    );
    line(
        "    wake-ups a second",
        format!("{:.0}", measured.wake_ups_per_s),
        "",
    );
    line(
        "    encoder and amplifier powered",
        percent(measured.sensors),
        "",
    );
    let Order {
        mean_us,
        latest_us,
        awake,
    } = measured.order;
    line(
        "capsule folding: from a reading to its duty",
        format!("{mean_us:.0} us, at most {latest_us:.0} us"),
        "< 1 ms",
    );
    line("    awake", percent(awake), "");
    line(
        "a fold and an unfolding: motor's charge, time awake",
        format!("{:.4} mAh, {:.2} s", measured.pair_mah, measured.pair_s),
        "",
    );
    let sensors_ma = SENSORS_MA * measured.sensors;
    line(
        "    of the cell at rest: encoder and amplifier",
        format!("{sensors_ma:.2} mA"),
        "8.3 mA when on, assumed",
    );
    let mut hours = [0.0; 2];
    for ((hours, run_ma), sleep_ma) in hours.iter_mut().zip(RUN_MA).zip(SLEEP_MA) {
        let chip_ma = run_ma * measured.awake + sleep_ma * (1.0 - measured.awake);
        let rest_ma = chip_ma + sensors_ma + ALWAYS_MA;
        let pair_mah = measured.pair_mah + measured.pair_s / 3_600.0 * (run_ma + SENSORS_MA);
        *hours = (CELL_MAH * USABLE - PAIRS * pair_mah).max(0.0) / rest_ma;
        line(
            "    the chip, and all together",
            format!("{chip_ma:.2} mA, {rest_ma:.2} mA"),
            "data sheet: typical, then most",
        );
    }
    line(
        "hours from 40 mAh, 80 % of it, with 500 such pairs",
        format!("{:.1} h, at least {:.1} h", hours[0], hours[1]),
        ">= 12 h",
    );
    Ok(())
}
