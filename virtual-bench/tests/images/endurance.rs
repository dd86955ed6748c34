//! Many runs on one start of the device.

use client::{Device, Observer, Unobserved};

use crate::common::{home_quickly, quick, rig, trials};
use protocol::{
    rig::{RigEvent, RunOutcome},
    system::{Event, What},
};

#[derive(Default)]
struct Residuals {
    strokes: u32,
    worst: u32,
}

impl Observer for Residuals {
    fn event(&mut self, event: &Event) {
        if let What::Rig(RigEvent::StrokeDone { residual_steps, .. }) = event.what {
            self.strokes += 1;
            self.worst = self.worst.max(residual_steps.unsigned_abs());
        }
    }
}

fn boot_id(device: &Device) -> u32 {
    device.identity().map_or(0, |identity| identity.boot_id)
}

#[test]
fn runs_of_five_cycles_lose_no_step() {
    let runs: u32 = trials(15, 100);
    let mut rig = rig();
    home_quickly(&mut rig);
    rig.home();
    let boot = boot_id(&rig.device);
    let request = quick(5, 3_000, 45_000, 2_000_000);
    let mut residuals = Residuals::default();
    for number in 1..=runs {
        let first = rig.edge_count();
        let accepted = rig.device.run(request).expect("the run is accepted");
        assert_eq!((accepted.run, accepted.edges), (number, 10 * 2_400));
        let record = rig
            .device
            .wait_run(&accepted, &mut residuals)
            .unwrap_or_else(|error| panic!("run {number}: {error}\n{}", rig.log()));
        assert_eq!(
            (record.run, record.outcome, record.strokes),
            (number, RunOutcome::Complete, 10),
            "{}",
            rig.log()
        );
        assert_eq!(
            (record.commanded_edges, record.counted_edges),
            (24_000, 24_000),
            "run {number}"
        );
        assert_eq!(
            (record.min_steps, record.max_steps),
            (0, 2_400),
            "run {number}"
        );
        assert_eq!(record.ticks, accepted.total_ticks, "run {number}");
        assert_eq!(record.worst_residual_steps, 0, "run {number}");
        assert_eq!(
            (rig.edge_count() - first, rig.carriage()),
            (24_000, 0),
            "run {number}"
        );
    }
    assert_eq!((residuals.strokes, residuals.worst), (10 * runs, 0));
    // The flag must still be where it was before, with all trials two and a half million steps ago.
    let accepted = rig.device.home().expect("homing is accepted");
    let homed = rig
        .device
        .wait_homing(&accepted, &mut Unobserved)
        .expect("homed");
    assert_eq!((homed.shift_steps, rig.carriage()), (0, 0));
    assert_eq!(rig.device.hello(5).expect("it answers").boot_id, boot);
    assert_eq!(rig.look(|rig| rig.lost()), 0);
    rig.check_clean(0);
}
