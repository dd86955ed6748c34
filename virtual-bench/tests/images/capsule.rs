//! Tests of the capsule's image at its motor, thread and spring.

use std::sync::OnceLock;

use client::{Device, Observer, Unobserved};

use crate::common::{Any, flash_operations, inject, log_of, refusal};
use crate::watchdog::A_PANIC;
use capsule_plant::verdict::name;
use protocol::{
    capsule::{
        ActuationAccepted, ActuationOutcome, ActuationRecord, CapsuleFault, CapsuleState,
        CheckFolded, Fold, FoldTo, GetCapsuleTotals, Reference, Unfold,
    },
    error::Refusal,
    system::{DeviceKind, ResetCause, Urgent},
    table::{Endpoint, Telemetry},
};
use virtual_bench::{
    bench::{Bench, BenchOptions},
    boards::capsule::{self, CapsuleBoard},
    fault_injection::Misbehaviour,
    link::VirtualLink,
    plants::capsule::{Capsule, Defect, Parameters},
};

pub(crate) struct CapsuleRun {
    pub(crate) bench: Bench<CapsuleBoard>,
    pub(crate) device: Device,
}

/// A capsule that was never calibrated.
pub(crate) fn start() -> CapsuleRun {
    start_with(Parameters::nominal(), capsule::options())
}

fn start_with(parameters: Parameters, options: BenchOptions) -> CapsuleRun {
    let board = CapsuleBoard::new(Capsule::new(parameters));
    let bench = Bench::start(board, options).expect("the image boots");
    let link = Box::new(VirtualLink::new(&bench, "virtual capsule"));
    let device = Device::connect(link, DeviceKind::Capsule, 1).expect("the capsule answers");
    CapsuleRun { bench, device }
}

/// A capsule that was calibrated before it was switched on, unfolded.
pub(crate) fn referenced() -> CapsuleRun {
    referenced_with(Parameters::nominal(), capsule::options())
}

/// The same with other parameters or another chip, which leave the calibration as it is.
fn referenced_with(parameters: Parameters, mut options: BenchOptions) -> CapsuleRun {
    static CALIBRATED: OnceLock<(Vec<u8>, f64)> = OnceLock::new();
    let (flash, wound_mm) = CALIBRATED.get_or_init(|| {
        let mut capsule = start();
        capsule.completes(Reference);
        capsule.rest();
        let flash = capsule.bench.visit(|visit| visit.flash());
        let wound_mm = capsule.with(|capsule| capsule.wound_mm());
        (flash.expect("the bench runs"), wound_mm)
    });
    options.flash = Some(flash.clone());
    let parameters = Parameters {
        wound_mm: *wound_mm,
        ..parameters
    };
    let mut capsule = start_with(parameters, options);
    assert_eq!(capsule.state(), (CapsuleState::Unfolded, None, true));
    capsule
}

impl CapsuleRun {
    pub(crate) fn with<T: Send + 'static>(
        &self,
        observe: impl FnOnce(&mut Capsule) -> T + Send + 'static,
    ) -> T {
        self.bench
            .visit(|visit| observe(&mut visit.board().capsule))
            .expect("the bench runs")
    }

    pub(crate) fn inject(&self, defect: Defect) {
        self.with(move |capsule| capsule.inject(defect));
    }

    pub(crate) fn log(&self) -> String {
        log_of(&self.bench)
    }

    /// Begins a motion.
    pub(crate) fn begin(&mut self, order: impl Endpoint<Response = ActuationAccepted>) {
        self.device.call(order).expect("it is accepted");
    }

    /// Waits for the end of a motion.
    pub(crate) fn ends(
        &mut self,
        order: impl Endpoint<Response = ActuationAccepted>,
    ) -> ActuationRecord {
        let accepted = self.device.call(order).expect("it is accepted");
        let ended = self.device.wait_actuation(&accepted, &mut Unobserved);
        ended.expect("it ends")
    }

    pub(crate) fn completes(
        &mut self,
        order: impl Endpoint<Response = ActuationAccepted>,
    ) -> ActuationRecord {
        let record = self.ends(order);
        let complete = ActuationOutcome::Complete;
        assert_eq!(record.outcome, complete, "{record:?}\n{}", self.log());
        record
    }

    /// Lets time pass while the host keeps the link alive.
    pub(crate) fn idle(&mut self, us: u64) {
        let idled = self.device.idle(us, &mut Unobserved);
        idled.expect("the link stays");
    }

    /// Lets time pass without a host.
    fn pass(&self, us: u64) {
        self.bench.advance_us(us).expect("the bench runs");
    }

    /// Waits until the persistent data is written.
    pub(crate) fn rest(&mut self) {
        self.idle(1_500_000);
    }

    /// Switches off for a second, then opens a new session.
    pub(crate) fn power_cycle(&mut self, nonce: u32) {
        self.bench.power_cycle(1_000_000).expect("the bench runs");
        self.device.hello(nonce).expect("it answers again");
    }

    fn reset(&mut self, nonce: u32) {
        self.bench.reset().expect("the bench runs");
        self.device.hello(nonce).expect("it answers again");
    }

    pub(crate) fn state(&mut self) -> (CapsuleState, Option<CapsuleFault>, bool) {
        let status = self.device.capsule_status().expect("a status");
        (status.state, status.fault, status.referenced)
    }

    fn wound_mm(&self) -> f64 {
        self.with(|capsule| capsule.wound_mm())
    }

    /// Total time for which encoder and amplifier were powered.
    fn sensors_ns(&self) -> u64 {
        let powered = self.bench.visit(|visit| {
            let now_ns = visit.now_ns();
            visit.board().sensors_powered_ns(now_ns)
        });
        powered.expect("the bench runs")
    }

    /// Checks that at rest the motor is off and the bridge asleep, in any state: the worm gear holds.
    fn check_at_rest(&mut self) {
        self.idle(200_000);
        let observe = |capsule: &mut Capsule| {
            let driven = capsule.is_awake() || capsule.is_moving();
            (driven, capsule.wound_mm())
        };
        let (driven, before_mm) = self.with(observe);
        let powered_ns = self.sensors_ns();
        self.idle(1_000_000);
        // Encoder and amplifier are switched on for an occasional reading.
        let powered_ms = (self.sensors_ns() - powered_ns) / 1_000_000;
        assert!((1..23).contains(&powered_ms), "{powered_ms} ms of a second");
        assert_eq!(self.with(observe), (false, before_mm), "{}", self.log());
        assert!(!driven, "driven at rest\n{}", self.log());
    }

    pub(crate) fn check_clean(&self) {
        self.check_clean_after(0);
    }

    /// The same after so many resets.
    fn check_clean_after(&self, resets: usize) {
        let bus = self.bench.bus().expect("the bench runs");
        let checked = bus.check(resets);
        checked.unwrap_or_else(|why| panic!("{why}\n{}", self.log()));
        assert_eq!(self.with(|capsule| capsule.flash_moving()), 0);
    }
}

/// It folds and unfolds by count again and again, and what it says is what the plant did. Energy is current times
/// voltage, so an offset that is left in the current shows there.
#[test]
fn what_it_says_is_what_the_plant_did() {
    // Pause as a person does: no reading of the idle bridge may leak into the next actuation.
    for (sense_offset_mv, pauses_us) in [(0.0, [0, 30_000]), (18.0, [77_000, 101_000])] {
        let parameters = Parameters {
            sense_offset_mv,
            ..Parameters::nominal()
        };
        let mut capsule = referenced_with(parameters, capsule::options());
        for pause_us in pauses_us {
            folds_and_unfolds(&mut capsule, pause_us);
        }
        capsule.check_at_rest();
        capsule.check_clean();
    }
}

fn folds_and_unfolds(capsule: &mut CapsuleRun, pause_us: u64) {
    capsule.idle(pause_us);
    let powered_ns = capsule.sensors_ns();
    let fold = says_what_it_did(capsule, Fold, 500..=4_000, 350.0);
    let powered_ms = (capsule.sensors_ns() - powered_ns) / 1_000_000;
    assert!(powered_ms >= fold.duration_ms.into(), "{powered_ms} ms");
    assert!((100..=fold.peak_current_ma).contains(&fold.end_current_ma));
    let (force_n, travel_mm) =
        capsule.with(|capsule| (capsule.peak_force_n(), capsule.travel_mm()));
    assert!((19.5..=22.5).contains(&travel_mm), "{travel_mm} mm");
    assert!((4.0..=9.0).contains(&force_n), "{force_n} N");
    assert_eq!(capsule.state().0, CapsuleState::Folded);
    capsule.idle(pause_us);
    says_what_it_did(capsule, Unfold, 1..=3_200, 220.0);
    let least_mm = capsule.with(|capsule| capsule.extremes_mm().0);
    let wound_mm = capsule.wound_mm();
    assert!(
        least_mm >= 0.0 && wound_mm < 0.2,
        "{least_mm}, {wound_mm} mm"
    );
    assert_eq!(capsule.state().0, CapsuleState::Unfolded);
}

/// Completes a motion, and compares its record with the plant.
fn says_what_it_did(
    capsule: &mut CapsuleRun,
    motion: impl Endpoint<Response = ActuationAccepted>,
    takes_ms: std::ops::RangeInclusive<u32>,
    most_mj: f64,
) -> ActuationRecord {
    let before_j = capsule.with(|capsule| capsule.energy_j());
    let record = capsule.completes(motion);
    let drawn_mj = capsule.with(move |capsule| (capsule.energy_j() - before_j) * 1e3);
    let off_mm = f64::from(record.thread_um) / 1e3 - capsule.wound_mm();
    let what = format!("{drawn_mj:.1} mJ drawn, {off_mm} mm off, {record:?}");
    assert!(off_mm.abs() < 0.5 && drawn_mj < most_mj, "{what}");
    let error = f64::from(record.energy_mj) / drawn_mj - 1.0;
    assert!(error.abs() < 0.05, "{what}");
    assert!(takes_ms.contains(&record.duration_ms), "{what}");
    record
}

/// The bench does not stop for the bridge's pulses. A bench that stops for each of them looks at the motor a hundred
/// thousand times a second more, and must find a capsule that moves alike. That the pulses are the same is shown in
/// `emulator/timer.rs`.
#[test]
fn a_capsule_moves_alike_if_the_bench_stops_for_each_pulse() {
    let [made_up, stopped] = [false, true].map(|every_event| {
        let mut options = capsule::options();
        options.chip.every_event = every_event;
        let mut capsule = referenced_with(Parameters::nominal(), options);
        let fold_to = FoldTo { thread_um: 12_000 };
        let motions = [capsule.completes(fold_to), capsule.completes(Unfold)];
        let [fold_ms, unfold_ms] = motions.map(|record| f64::from(record.duration_ms));
        let observe = |capsule: &mut Capsule| (capsule.peak_force_n(), capsule.energy_j());
        let (force_n, energy_j) = capsule.with(observe);
        [fold_ms, unfold_ms, force_n, energy_j]
    });
    // Noise is drawn per step of the mechanics: one unfolding takes up to 3 % more than the next, and the largest force
    // is that of a single reading.
    let within = [0.03, 0.03, 0.06, 0.03];
    for ((made_up_for, stopped_for), within) in made_up.into_iter().zip(stopped).zip(within) {
        let ratio: f64 = made_up_for / stopped_for;
        assert!((ratio - 1.0).abs() < within, "{made_up:?} {stopped:?}");
    }
}

/// Each way in which the image hears of a defect, once, from before a fold or from half a second within it. The library
/// tries a population (`firmware-capsule/tests/motions.rs`).
#[test]
fn each_defect_is_stopped_named_and_latched() {
    for (defects, after_ms, named) in [
        (&[Defect::Jam(12.0)][..], 0, "Jam"),
        (&[Defect::Snap(6.0)], 0, "SlipOrBreak"),
        (
            &[Defect::Weak(8.0), Defect::Battery(3_150.0)],
            0,
            "LowBattery",
        ),
        (&[Defect::ChannelA], 500, "EncoderLost"),
        (&[Defect::ChannelB], 500, "EncoderLost"),
        (&[Defect::SilentBridge], 500, "BridgeSilent"),
        (&[Defect::DriverFault], 500, "DriverFault"),
        (&[Defect::Short], 500, "OverCurrent"),
        (&[Defect::SenseOpen], 500, "SenseLost"),
    ] {
        let mut capsule = referenced();
        let at_ns = capsule.bench.now_ns() + after_ms * 1_000_000;
        for defect in defects.iter().copied() {
            capsule.with(move |capsule| capsule.plan(at_ns, defect));
        }
        let record = capsule.ends(Fold);
        let what = format!("{defects:?}: {record:?}\n{}", capsule.log());
        let ActuationOutcome::Faulted(fault) = record.outcome else {
            panic!("{what}");
        };
        assert_eq!(name(&fault), named, "{what}");
        if let CapsuleFault::Jam { thread_um } = fault {
            assert!((12_800..13_400).contains(&thread_um), "{what}");
        }
        assert!(capsule.with(|capsule| capsule.peak_force_n()) < 18.0);
        capsule.check_at_rest();
        let (state, latched, _) = capsule.state();
        assert_eq!((state, latched), (CapsuleState::Faulted, Some(fault)));
        let refused = refusal(capsule.device.unfold());
        assert_eq!(refused, Refusal::CapsuleFaulted(fault));
        capsule.check_clean();
    }
}

/// A seized worm: the motor stalled with all its current until the time-out, which cost the position.
#[test]
fn a_motor_that_is_held_while_it_pays_out_is_a_jam_at_once() {
    let mut capsule = referenced();
    capsule.completes(FoldTo { thread_um: 8_000 });
    capsule.with(|capsule| capsule.plant_mut().hold(true));
    let record = capsule.ends(Unfold);
    let what = format!("{record:?}\n{}", capsule.log());
    let fault = |outcome| matches!(outcome, ActuationOutcome::Faulted(CapsuleFault::Jam { .. }));
    assert!(fault(record.outcome) && record.duration_ms < 150, "{what}");
    assert!(capsule.state().2, "it is referenced");
    capsule.check_clean();
}

/// Calibration, totals and the place survive a power cut, and a check leaves it folded.
#[test]
fn what_is_kept_outlives_the_power_and_a_check_stays_folded() {
    let mut capsule = referenced();
    let earlier = capsule.device.call(GetCapsuleTotals).expect("an answer");
    capsule.completes(Fold);
    capsule.rest();
    let before = capsule.device.call(GetCapsuleTotals).expect("an answer");
    assert_eq!(before.actuations, earlier.actuations + 1);
    let drawn_mj = capsule.with(|capsule| capsule.energy_j() * 1e3);
    let energy_mj = (before.energy_mj - earlier.energy_mj) as f64;
    assert!(
        (energy_mj / drawn_mj - 1.0).abs() < 0.05,
        "{before:?}, {drawn_mj:.1} mJ"
    );
    let calibration = before.calibration.expect("the reference was one");
    assert!(
        (21_300..21_900).contains(&calibration.folded_um),
        "{calibration:?}"
    );
    capsule.power_cycle(2);
    assert_eq!(capsule.state(), (CapsuleState::Folded, None, true));
    let totals = capsule.device.call(GetCapsuleTotals).expect("an answer");
    assert_eq!(totals, before);
    capsule.idle(300_000);
    let folded_mm = capsule.wound_mm();
    capsule.completes(CheckFolded);
    assert_eq!(capsule.state(), (CapsuleState::Folded, None, true));
    let (off_mm, force_n) = (
        capsule.wound_mm() - folded_mm,
        capsule.with(|capsule| capsule.peak_force_n()),
    );
    assert!(
        off_mm.abs() < 0.1 && force_n < 9.0,
        "{off_mm} mm, {force_n} N"
    );
    capsule.completes(Unfold);
    let unfolded_mm = capsule.wound_mm();
    assert!((0.0..0.1).contains(&unfolded_mm), "{unfolded_mm} mm");
    capsule.check_clean();
}

/// The manual's way out after a cut within a motion: what the flash says is where the thread is, and a reference leads to
/// unfolded, never past zero. The worst case is a cut while the thread is paid out at full speed: nothing brakes the motor
/// then.
#[test]
fn a_cut_within_a_motion_leaves_a_way_out() {
    let fold_to = FoldTo { thread_um: 14_000 };
    for (folds_first, motion, after_us, is_left) in [
        (false, Fold.into_request(), 1_200_000, true),
        (false, fold_to.into_request(), 700_000, false),
        (true, CheckFolded.into_request(), 300_000, false),
        (true, Unfold.into_request(), 600_000, false),
        (true, Unfold.into_request(), 1_500_000, false),
        (true, Unfold.into_request(), 2_300_000, false),
    ] {
        let mut capsule = referenced();
        if folds_first {
            capsule.completes(Fold);
        }
        let what = format!("{motion:?}, cut after {after_us} us");
        capsule.device.call(Any(motion)).expect("it is accepted");
        capsule.idle(after_us);
        capsule.power_cycle(2);
        let status = capsule.device.capsule_status().expect("a status");
        assert_eq!(status.state, CapsuleState::Unreferenced, "{what}");
        let (wound_um, uncertainty_um) = (
            (capsule.wound_mm() * 1e3) as i32,
            status.uncertainty_um.expect("an uncertainty") as i32,
        );
        let told_um = status.thread_um..=status.thread_um + uncertainty_um;
        assert!(
            told_um.contains(&wound_um),
            "{what}: {status:?}, {wound_um} um"
        );
        if is_left {
            capsule.completes(Reference);
            let status = capsule.device.capsule_status().expect("a status");
            assert_eq!(status.state, CapsuleState::Unfolded);
            let off_mm = capsule.wound_mm() - f64::from(status.remaining_um) / 1e3;
            assert!(off_mm.abs() < 0.3, "{what}: {off_mm} mm, {status:?}");
            capsule.completes(Fold);
        }
        let least_mm = capsule.with(|capsule| capsule.extremes_mm().0);
        assert!(least_mm >= 0.0, "{what}: {least_mm} mm");
        capsule.check_clean();
    }
}

/// The recording matches the plant, reading by reading.
#[test]
fn a_fold_is_recorded_on_the_capsule() {
    let mut capsule = referenced();
    let record = capsule.completes(Fold);
    let points = capsule.device.trace().expect("it is fetched").points;
    let missing = points.len().abs_diff(record.duration_ms as usize);
    assert!(missing < 60, "{missing} of {} readings", record.duration_ms);
    // While the motor is braked the amplifier shows the motor's current, which does not come from the cell.
    let driven = points.windows(2).filter(|pair| pair[0].drive_mv != 0);
    let peak_ma = driven.map(|pair| pair[1].current_ma).max();
    assert!((140..260).contains(&peak_ma.expect("some")), "{peak_ma:?}");
    let last = points.last().expect("some");
    let off_um = f64::from(last.thread_um) - capsule.wound_mm() * 1e3;
    assert!(off_um.abs() < 20.0, "{last:?}");
    assert!(points.iter().any(|point| point.drive_mv > 1_000));
}

/// The chip's supply falls with an empty cell, and with it the ADC's reference.
#[test]
fn the_battery_is_read_right_down_to_an_empty_cell() {
    let mut capsule = referenced();
    for battery_mv in [
        4_200, 3_700, 3_400, 3_300, 3_200, 3_000, 2_850, 2_700, 2_500,
    ] {
        capsule.inject(Defect::Battery(f64::from(battery_mv)));
        capsule.idle(250_000);
        let status = capsule.device.capsule_status().expect("a status");
        let read_mv = status.battery_mv;
        let error = f64::from(read_mv) / f64::from(battery_mv) - 1.0;
        assert!(error.abs() < 0.005, "{read_mv} mV read of {battery_mv} mV");
    }
    let low = refusal(capsule.device.fold());
    assert!(matches!(low, Refusal::BatteryLow { .. }), "{low:?}");
    capsule.check_at_rest();
    capsule.check_clean();
}

/// The amplifier's zero lies at half of its supply. An offset at rest, up to the end of its range, keeps the motor off.
#[test]
fn a_current_at_rest_keeps_the_motor_off() {
    for sense_offset_mv in [-500.0, 500.0, -1_650.0] {
        let parameters = Parameters {
            sense_offset_mv,
            ..Parameters::nominal()
        };
        let mut capsule = start_with(parameters, capsule::options());
        // At once: the first reading has measured the amplifier's zero.
        capsule.bench.reset().expect("the bench runs");
        capsule.pass(12_000);
        capsule.device.hello(2).expect("it answers again");
        let before_mm = capsule.wound_mm();
        let fault = CapsuleFault::SenseLost;
        let refused = refusal(capsule.device.reference());
        assert_eq!(refused, Refusal::CapsuleFaulted(fault));
        capsule.check_at_rest();
        assert_eq!(capsule.wound_mm(), before_mm);
        let (state, latched, _) = capsule.state();
        assert_eq!((state, latched), (CapsuleState::Faulted, Some(fault)));
        let refused = refusal(capsule.device.acknowledge());
        assert_eq!(refused, Refusal::CauseStillPresent);
        capsule.check_clean_after(1);
    }
}

/// An emergency stop just after a fold comes before the fold's end is in flash, and leaves it folded.
#[test]
fn a_stop_in_mid_fold_holds_and_an_estop_latches() {
    let stopped = (CapsuleState::Stopped, None, true);
    let latched = (CapsuleState::Faulted, Some(CapsuleFault::EStopFrame), true);
    for (urgent, then) in [(Urgent::Stop, stopped), (Urgent::EStop, latched)] {
        let mut capsule = referenced();
        capsule.begin(Fold);
        capsule.idle(700_000);
        capsule.device.urgent(urgent).expect("an answer");
        capsule.check_at_rest();
        let wound_mm = capsule.wound_mm();
        assert!(wound_mm > 2.0 && wound_mm < 20.0, "{wound_mm} mm");
        assert_eq!(capsule.state(), then);
        if then == latched {
            capsule.device.acknowledge().expect("it can be cleared");
        }
        capsule.completes(Fold);
        capsule.idle(200_000);
        capsule.device.urgent(Urgent::EStop).expect("an answer");
        capsule.rest();
        assert_eq!(capsule.state(), latched);
        capsule.device.acknowledge().expect("it can be cleared");
        assert_eq!(capsule.state().0, CapsuleState::Folded);
        capsule.check_clean();
    }
}

#[test]
fn a_silent_host_stops_the_motor() {
    let mut capsule = referenced();
    // Slow it down, so that the fold lasts longer than the link time-out.
    capsule.inject(Defect::Battery(3_050.0));
    capsule.begin(Fold);
    capsule.pass(6_000_000);
    let record = capsule.device.actuation_record().expect("the link is back");
    assert_eq!(record.outcome, ActuationOutcome::LinkLost, "{record:?}");
    capsule.check_at_rest();
}

/// An unacknowledged E-stop is still latched after a reset. It is cleared by an acknowledgement or a power cut.
#[test]
fn a_latched_estop_survives_a_reset() {
    let mut capsule = start();
    let stopped = CapsuleFault::EStopFrame;
    let latched = (CapsuleState::Faulted, Some(stopped), false);
    let fresh = (CapsuleState::Unreferenced, None, false);
    capsule.device.urgent(Urgent::EStop).expect("it is heard");
    for nonce in [2, 3] {
        capsule.reset(nonce);
        assert_eq!(capsule.state(), latched, "{}", capsule.log());
        let refused = refusal(capsule.device.reference());
        assert_eq!(refused, Refusal::CapsuleFaulted(stopped));
    }
    capsule.device.acknowledge().expect("it can be cleared");
    capsule.reset(4);
    assert_eq!(capsule.state(), fresh);
    capsule.device.urgent(Urgent::EStop).expect("it is heard");
    capsule.power_cycle(5);
    assert_eq!(capsule.state(), fresh);
    capsule.check_at_rest();
    capsule.check_clean_after(3);
}

/// Makes `client` misbehave while the capsule folds, until the device has restarted: motor off, bridge asleep, fault
/// latched. Returns how long that took, and the last words.
fn after_injection(client: u8, deed: Misbehaviour, cause: ResetCause) -> (u64, String) {
    let mut capsule = referenced();
    capsule.begin(Fold);
    capsule.idle(300_000);
    assert!(capsule.with(|capsule| capsule.is_moving()));
    let armed_ns = inject(&capsule.bench, &capsule::image(), client, deed);
    if deed == Misbehaviour::Panic {
        stays_asleep(&capsule);
    }
    capsule.pass(1_500_000);
    let resets = capsule.bench.bus().expect("the bench runs").resets;
    assert_eq!(resets.len(), 1, "{resets:?}\n{}", capsule.log());
    let identity = capsule.device.hello(2).expect("it answers again");
    assert_eq!(identity.reset_cause, cause);
    let fault = match cause {
        ResetCause::Panic => CapsuleFault::Panic,
        _ => CapsuleFault::Watchdog,
    };
    let latched = |fault| (CapsuleState::Faulted, Some(fault), false);
    assert_eq!(capsule.state(), latched(fault));
    capsule.check_at_rest();
    let words = capsule.device.last_words().expect("they are kept");
    // The crash keeps its name as the fault; the next start knows of the stop.
    capsule.device.urgent(Urgent::EStop).expect("it is heard");
    assert_eq!(capsule.state(), latched(fault));
    capsule.reset(3);
    let stopped = latched(CapsuleFault::EStopFrame);
    assert_eq!(capsule.state(), stopped, "{}", capsule.log());
    capsule.device.acknowledge().expect("the cause is gone");
    (resets[0].0 - armed_ns, words)
}

/// Whoever panics has the bridge asleep from then on, also while the last words are kept: no other task wakes it up.
fn stays_asleep(capsule: &CapsuleRun) {
    let mut was_asleep = false;
    for _ in 0..6_000 {
        capsule.pass(20);
        let is_awake = capsule.with(|capsule| capsule.is_awake());
        assert!(!(was_asleep && is_awake), "the bridge was woken up again");
        was_asleep |= !is_awake;
        let bus = capsule.bench.bus().expect("the bench runs");
        if !bus.resets.is_empty() {
            break;
        }
    }
    assert!(was_asleep);
}

/// Longer than the watchdog's period and the two check-ins before it, ns.
const HANG_NS: u64 = 800_000_000 + 100_000_000 + 150_000_000;

#[test]
fn a_task_that_hangs_is_ended_by_the_watchdog() {
    for client in [1, 2, 4] {
        let (took_ns, words) = after_injection(client, Misbehaviour::Hang, ResetCause::Watchdog);
        assert!(took_ns <= HANG_NS, "client {client}: {took_ns} ns");
        assert_eq!(words, "");
    }
}

#[test]
fn a_panic_switches_off_and_leaves_its_words() {
    for client in [1, 2, 4] {
        let (took_ns, words) = after_injection(client, Misbehaviour::Panic, ResetCause::Panic);
        assert!(took_ns <= 101_000_000, "client {client}: {took_ns} ns");
        assert!(words.starts_with(A_PANIC), "client {client}: {words:?}");
    }
}

/// Device time of each sample, us, and how many were missing before it.
#[derive(Default)]
struct Samples(Vec<(u64, u16)>);

impl Observer for Samples {
    fn telemetry(&mut self, sample: &Telemetry, missed: u16) {
        let Telemetry::Capsule(sample) = sample else {
            panic!("{sample:?} of a capsule");
        };
        self.0.push((sample.time_us, missed));
    }
}

/// The totals are written half a second after a motion.
#[test]
fn telemetry_counts_the_samples_that_it_leaves_out_while_flash_is_written() {
    const INTERVAL_US: u64 = 10_000;
    let mut capsule = referenced();
    capsule.completes(FoldTo { thread_um: 3_000 });
    let before = flash_operations(&capsule.bench);
    let mut samples = Samples::default();
    capsule.device.set_telemetry(10).expect("accepted");
    let idled = capsule.device.idle(1_500_000, &mut samples);
    idled.expect("the link stays");
    assert!(flash_operations(&capsule.bench) > before);
    for pair in samples.0.windows(2) {
        let apart_us = pair[1].0 - pair[0].0;
        let explained_us = INTERVAL_US * (u64::from(pair[1].1) + 1);
        assert!(apart_us.abs_diff(explained_us) < INTERVAL_US, "{pair:?}");
        assert!(apart_us < 20_000, "{pair:?}");
    }
}
