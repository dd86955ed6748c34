//! Judges a capsule by its bridge, its counts and what was asked of it. Of its words it uses the kind of an answer,
//! what has ended, and the zero that it counts from, which has to be explained by thread that was wound.

use device::{retained::EStop, settings::Values};
use firmware_capsule::{fold::Drive, sample::Sample};
use protocol::{
    capsule::{
        ActuationKind, ActuationOutcome, CapsuleCalibration, CapsuleEvent, CapsuleFault,
        CapsuleState, CapsuleStatus,
    },
    error::Refusal,
    settings::SettingKey,
    system::{Urgent, What},
    table::Reply,
};
use simulated_machines::chip::Operation;

use super::world::{counts, um};

/// Time that the motor is shorted after a motion, us.
const BRAKE_US: u64 = 40_000;
/// Time limit of a motion that finds or confirms an end, ms.
const SEEK_MS: u32 = 16_000;
/// Thread that a check pays out at a folded end, um.
const CHECKED_UM: i32 = 2_000;
/// Thread that a reference run backs off at a time, um, and how often before it knows where it is.
const BACK_OFF_UM: i32 = 700;
const BACK_OFFS: u32 = 15;
/// Thread that is wound at most to feel whether it pulls, um.
const FELT_UM: i32 = 400;
/// Highest speed of the motor, counts per ms.
const FASTEST: u64 = 20;
/// Rounding of counts, um.
const ROUNDED_UM: i32 = 2;

/// An accepted motion.
#[derive(Clone, Copy, Debug)]
struct Order {
    kind: ActuationKind,
    since_us: u64,
    limit_ms: u32,
    /// Counts at its start, and the highest since.
    start: i32,
    top: i32,
    /// The counts have leapt: nobody knows any more how much is wound.
    leapt: bool,
    /// Counts when it last began to wind and to pay out, and how often it has begun to pay out.
    wind_from: i32,
    from: i32,
    back_offs: u32,
    winds: bool,
    pays_out: bool,
    /// Readings of a driven motor after its time limit, and in a row beyond the furthest end.
    overdue: u32,
    beyond: u32,
    /// The position was known at its start.
    placed: bool,
    /// Count at thread zero before it.
    zero: Option<i32>,
}

/// The judge of one capsule.
#[derive(Clone, Debug)]
pub struct Judge {
    order: Option<Order>,
    /// The last motion that has ended, and when.
    last: Option<Order>,
    ended_us: u64,
    /// An emergency stop, or a start after a crash, that nobody has acknowledged.
    stopped: bool,
    crashed: bool,
    /// Count at thread zero, once thread that was wound has explained it.
    zero: Option<i32>,
    /// Thread from zero to the folded end, um.
    folded_um: Option<i32>,
    /// The last motion has ended folded.
    folded: bool,
    /// The last four counts, newest first.
    counts: [i32; 4],
    pub sample: Sample,
    /// Settings that were accepted.
    pub values: Values,
}

/// All that a refused request must not change.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    pub status: CapsuleStatus,
    /// Record, totals and name.
    pub answers: [Reply; 3],
    pub flash: Vec<Operation>,
    pub latched: Option<EStop>,
    pub telemetry_ms: u16,
}

/// Voltage of a driven motor; none if it is shorted, as by a duty of 0.
pub fn driven(drive: Drive) -> Option<i16> {
    match drive {
        Drive::Millivolts(millivolts) => Some(millivolts).filter(|millivolts| *millivolts != 0),
        Drive::Brake | Drive::Off => None,
    }
}

impl Judge {
    /// A capsule that starts for the first time.
    pub fn new(calibration: Option<CapsuleCalibration>, folded: bool) -> Self {
        Self {
            order: None,
            last: None,
            ended_us: 0,
            stopped: false,
            crashed: false,
            zero: None,
            folded_um: calibration.map(|calibration| calibration.folded_um),
            folded,
            counts: [0; 4],
            sample: Sample::default(),
            values: Values::DEFAULT,
        }
    }

    /// The present or last motion.
    fn last(&self) -> Option<Order> {
        self.order.or(self.last)
    }

    pub fn moves(&self) -> bool {
        self.order.is_some()
    }

    fn value(&self, key: SettingKey) -> u32 {
        self.values.get(key)
    }

    /// The capsule was reset. `forgotten`: with the memory that outlives other resets.
    pub fn reset(&mut self, forgotten: bool, crashed: bool) {
        (self.order, self.last) = (None, None);
        self.ended_us = 0;
        self.stopped &= !forgotten;
        self.crashed = crashed;
        self.zero = None;
    }

    /// Its status after a reset.
    pub fn restarted(&mut self, status: &CapsuleStatus, calibration: Option<CapsuleCalibration>) {
        let faulted = status.state == CapsuleState::Faulted;
        assert!(
            !(self.stopped || self.crashed) || faulted,
            "a reset has undone an emergency stop or a crash"
        );
        let believed = status.state == CapsuleState::WasFolded;
        assert!(!believed || self.folded, "it believes that it is folded");
        self.folded &= believed || faulted;
        self.folded_um = calibration.map(|calibration| calibration.folded_um);
    }

    fn limit_ms(&self, kind: ActuationKind) -> u32 {
        match kind {
            ActuationKind::Reference | ActuationKind::Calibrate | ActuationKind::CheckFolded => {
                SEEK_MS
            }
            ActuationKind::Fold | ActuationKind::FoldTo => self.value(SettingKey::FoldTimeoutMs),
            ActuationKind::Unfold => self.value(SettingKey::UnfoldTimeoutMs),
        }
    }

    /// A motion was accepted, and will end within `limit_ms`.
    pub fn accepted(&mut self, now_us: u64, kind: ActuationKind, limit_ms: u32) {
        assert!(
            !self.stopped,
            "{kind:?} after an emergency stop: not acknowledged"
        );
        assert!(!self.crashed, "{kind:?} after a crash: not acknowledged");
        assert!(self.order.is_none(), "{kind:?} in {:?}", self.order);
        assert_eq!(limit_ms, self.limit_ms(kind), "{kind:?}");
        let least_mv = self.value(SettingKey::LoadedBatteryMv) + 100;
        let least_mv = match kind {
            ActuationKind::Unfold => least_mv,
            _ => least_mv.max(self.value(SettingKey::LeastBatteryMv)),
        };
        let battery_mv = u32::from(self.sample.battery_mv);
        assert!(
            battery_mv >= least_mv,
            "{kind:?} with {battery_mv} of {least_mv} mV"
        );
        let offset_ma = self.sample.offset_ma;
        assert!(
            offset_ma.unsigned_abs() <= 20,
            "{kind:?} with {offset_ma} mA at rest"
        );
        let calibrated = self.folded_um.is_some();
        let zero = self.zero;
        match kind {
            ActuationKind::Fold | ActuationKind::FoldTo => {
                assert!(self.zero.is_some() && calibrated, "{kind:?}, from where?");
            }
            ActuationKind::Unfold => assert!(self.zero.is_some(), "{kind:?}, from where?"),
            ActuationKind::CheckFolded => assert!(calibrated, "{kind:?}, with what?"),
            ActuationKind::Reference | ActuationKind::Calibrate => self.zero = None,
        }
        let count = self.sample.counts.0;
        self.folded = false;
        self.order = Some(Order {
            // A reference run that has no end to look for finds it.
            kind: match kind {
                ActuationKind::Reference if !calibrated => ActuationKind::Calibrate,
                kind => kind,
            },
            since_us: now_us,
            limit_ms,
            start: count,
            top: count,
            leapt: false,
            wind_from: count,
            from: count,
            back_offs: 0,
            winds: false,
            pays_out: false,
            overdue: 0,
            beyond: 0,
            placed: self.zero.is_some(),
            zero,
        });
    }

    /// A stop was answered.
    pub fn urgent(&mut self, now_us: u64, urgent: Urgent) {
        self.end(now_us);
        if urgent == Urgent::EStop {
            self.stopped = true;
            self.zero = None;
        }
    }

    /// A fault was acknowledged.
    pub fn acknowledged(&mut self) {
        (self.stopped, self.crashed) = (false, false);
    }

    /// An acknowledgement was refused.
    pub fn not_acknowledged(&self, fault: Option<CapsuleFault>, refusal: &Refusal) {
        let present = match fault {
            None => {
                assert_eq!(*refusal, Refusal::NothingToAcknowledge);
                return;
            }
            Some(CapsuleFault::LowBattery { .. }) => {
                u32::from(self.sample.battery_mv) < self.value(SettingKey::LoadedBatteryMv) + 100
            }
            Some(CapsuleFault::DriverFault) => self.sample.driver_fault,
            Some(CapsuleFault::OverCurrent { .. } | CapsuleFault::SenseLost) => {
                self.sample.offset_ma.unsigned_abs() > 20
            }
            Some(_) => false,
        };
        assert!(
            present && *refusal == Refusal::CauseStillPresent,
            "{fault:?} {refusal:?}"
        );
    }

    fn end(&mut self, now_us: u64) {
        if let Some(order) = self.order.take() {
            (self.last, self.ended_us) = (Some(order), now_us);
        }
    }

    /// Looks at the events of an input. `lost`: the host has been silent for too long.
    pub fn hear(&mut self, now_us: u64, told: &[What], lost: bool) {
        for what in told {
            match *what {
                What::LinkLost => assert!(lost, "the host was not silent"),
                What::Capsule(CapsuleEvent::Ended { outcome, .. }) => self.ended(now_us, outcome),
                What::Capsule(CapsuleEvent::Drifted { .. }) => self.zero = None,
                What::Capsule(CapsuleEvent::Faulted(fault)) => {
                    assert!(!self.moves(), "{fault:?} ends a motion");
                    let keeps = matches!(
                        fault,
                        CapsuleFault::Jam { .. } | CapsuleFault::LowBattery { .. }
                    );
                    self.zero = self.zero.filter(|_| keeps);
                }
                _ => {}
            }
        }
    }

    fn ended(&mut self, now_us: u64, outcome: ActuationOutcome) {
        if let (Some(order), ActuationOutcome::Complete) = (self.order, outcome) {
            match order.kind {
                ActuationKind::Fold | ActuationKind::CheckFolded => self.folded = true,
                // It pays out what it has wound.
                ActuationKind::Calibrate => self.zero = Some(order.start),
                _ => {}
            }
        }
        self.end(now_us);
    }

    /// A reading was judged. `silence_us`: how long the host has been silent.
    pub fn reading(&mut self, now_us: u64, silence_us: u32, drive: Drive) {
        let Some(order) = &mut self.order else {
            return;
        };
        // The brakes before the motion and between two of its legs do not count.
        let limit_us = u64::from(order.limit_ms) * 1_000 + 2 * BRAKE_US;
        order.overdue += u32::from(now_us - order.since_us > limit_us && drive != Drive::Brake);
        // The first reading may begin another leg, because here it may be late.
        if order.overdue > 1 || silence_us > self.values.get(SettingKey::LinkTimeoutMs) * 1_000 {
            self.end(now_us);
        }
    }

    /// A reading is taken, this long after the one before.
    pub fn take(&mut self, sample: Sample, elapsed_us: u64) {
        let way = sample.counts.0.wrapping_sub(self.sample.counts.0);
        let leapt = u64::from(way.unsigned_abs()) > 100 + elapsed_us / 1_000 * FASTEST;
        self.sample = sample;
        self.counts.copy_within(..3, 1);
        self.counts[0] = sample.counts.0;
        if let Some(order) = &mut self.order {
            order.leapt |= leapt;
            if sample.counts.0.wrapping_sub(order.top) > 0 {
                order.top = sample.counts.0;
            }
        }
    }

    /// The zero that the firmware counts from, and whether it trusts it, after a reading.
    pub fn place(&mut self, status: &CapsuleStatus) {
        if !status.referenced {
            self.zero = None;
            return;
        }
        let count = self.sample.counts.0;
        let thread_um = status.thread_um;
        if let Some(zero) = self.zero {
            let expected_um = um(count.wrapping_sub(zero));
            let same = expected_um.abs_diff(thread_um) <= ROUNDED_UM.unsigned_abs();
            let moves = self.last().is_some_and(|order| !order.placed);
            let far = expected_um.unsigned_abs() > 100_000;
            assert!(
                same || moves || far,
                "its zero has moved by {} um",
                thread_um - expected_um
            );
            return;
        }
        let order = self.last().expect("it knows where it is, after no motion");
        let wound_um = um(count.wrapping_sub(order.start));
        let known_um = match order.kind {
            // One that is cut short may go back to what was known before.
            ActuationKind::Calibrate => {
                let before_um = order.zero.map(|zero| um(count.wrapping_sub(zero)));
                wound_um.max(before_um.unwrap_or(wound_um))
            }
            ActuationKind::Reference | ActuationKind::CheckFolded => {
                wound_um.max(self.folded_um.unwrap_or(0) - 100)
            }
            kind => panic!("{kind:?} has found a zero"),
        };
        assert!(
            thread_um <= known_um + ROUNDED_UM,
            "{:?}: {thread_um} um of thread, {known_um} known",
            order.kind
        );
        self.zero = Some(count.wrapping_sub(counts(thread_um)));
    }

    /// A calibration is in force.
    pub fn calibrated(&mut self, calibration: Option<CapsuleCalibration>, wound_um: i32) {
        let folded_um = calibration.map(|calibration| calibration.folded_um);
        if folded_um != self.folded_um {
            let folded_um = folded_um.expect("a calibration was lost");
            assert!(
                folded_um <= wound_um + ROUNDED_UM,
                "{folded_um} um of thread, {wound_um} wound"
            );
        }
        self.folded_um = folded_um;
    }

    /// Thread wound in the present motion, um.
    pub fn wound_um(&self) -> i32 {
        self.order
            .map_or(0, |order| um(order.top.wrapping_sub(order.start)))
    }

    /// Looks at the bridge after an input.
    pub fn look(&mut self, now_us: u64, drive: Drive, is_reading: bool) {
        if drive != Drive::Off && self.order.is_none() && is_reading {
            assert!(
                now_us < self.ended_us + BRAKE_US,
                "{drive:?} {} us after the end",
                now_us - self.ended_us
            );
        }
        let count = self.counts[0];
        // A motor that still winds is braked by a voltage against it.
        let winds_on = self.counts[1..]
            .iter()
            .any(|before| count.wrapping_sub(*before) > 0);
        let millivolts = driven(drive);
        let pays_out = millivolts.is_some_and(|millivolts| millivolts < 0) && !winds_on;
        if let Some(order) = &mut self.order {
            if !order.pays_out {
                order.from = count;
                order.back_offs += u32::from(pays_out);
            }
            let winds = millivolts.is_some() && !pays_out;
            if !order.winds {
                order.wind_from = count;
            }
            (order.winds, order.pays_out) = (winds, pays_out);
        }
        let Some(millivolts) = millivolts else {
            return;
        };
        let Some(order) = self.order else {
            panic!("driven with {millivolts} mV, and no order explains it");
        };
        assert!(
            millivolts.unsigned_abs() <= self.sample.battery_mv,
            "{millivolts} mV from {} mV",
            self.sample.battery_mv
        );
        if pays_out {
            self.pays_out(&order);
        } else if millivolts > 0 && is_reading {
            self.winds(order);
        }
    }

    /// Winding has an end, even if no force is felt.
    fn winds(&mut self, mut order: Order) {
        let count = self.counts[0];
        let thread_um = self.zero.map(|zero| um(count.wrapping_sub(zero)));
        let (way_um, limit_um) = match (thread_um, self.folded_um) {
            // Thread and origami stretch by up to 0.8 mm.
            (Some(thread_um), Some(folded_um)) if order.kind != ActuationKind::Calibrate => {
                let overrun_um = self.value(SettingKey::EndOverrunUm) as i32;
                (thread_um, folded_um + 800 + overrun_um)
            }
            _ => {
                let longest_um = self.value(SettingKey::LongestFoldUm) as i32;
                // A search for a known end may go there.
                let end_um = self
                    .folded_um
                    .filter(|_| order.kind != ActuationKind::Calibrate);
                let limit_um = longest_um.max(end_um.unwrap_or(0)) + 1_000;
                (um(count.wrapping_sub(order.start)), limit_um)
            }
        };
        // Anywhere it may wind a little to feel the thread.
        let feels = um(count.wrapping_sub(order.wind_from)) < FELT_UM;
        order.beyond = match way_um < limit_um || feels {
            true => 0,
            false => order.beyond + 1,
        };
        // The first reading there may begin another leg, because here it may be late.
        assert!(
            order.beyond < 2,
            "{order:?} winds at {way_um} of {limit_um} um"
        );
        self.order = Some(order);
    }

    /// It began where the folded end may be by now.
    fn began_at_end(&self, order: &Order) -> bool {
        let began_um = self.zero.map(|zero| um(order.start.wrapping_sub(zero)));
        began_um
            .zip(self.folded_um)
            .is_some_and(|(began_um, folded_um)| {
                // A reference run may believe it this much shorter.
                began_um >= folded_um - 1_300
            })
    }

    /// Paying out needs thread that is known to be wound.
    fn pays_out(&self, order: &Order) {
        let count = self.counts[0];
        let wound_um = um(count.wrapping_sub(order.start));
        let thread_um = self.zero.map(|zero| um(count.wrapping_sub(zero)));
        let explained = match (order.kind, thread_um) {
            _ if order.leapt => true,
            // One that begins at the folded end feels the thread as a check does.
            (ActuationKind::Fold, Some(_)) if self.began_at_end(order) => wound_um > -CHECKED_UM,
            // At the folded end it may feel whether the thread pulls.
            (ActuationKind::Fold, _) => um(order.top.wrapping_sub(count)) < CHECKED_UM + FELT_UM,
            (ActuationKind::Calibrate, _) => wound_um > 0,
            (ActuationKind::CheckFolded, _) => wound_um > -CHECKED_UM,
            // The thread pulled where it began to.
            (ActuationKind::Reference, None) => {
                let out_um = um(order.from.wrapping_sub(count));
                out_um < BACK_OFF_UM && order.back_offs <= BACK_OFFS
            }
            (ActuationKind::FoldTo, Some(thread_um)) => thread_um > 500,
            (_, Some(thread_um)) => thread_um > 0,
            (_, None) => false,
        };
        assert!(
            explained,
            "{order:?} pays out at {wound_um} um from its start, {thread_um:?} from zero"
        );
    }
}
