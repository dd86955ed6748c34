//! Tries the capsule's image on the seeded capsules of `capsule-plant`, each on a new board.

use capsule_plant::cases::{Course, Kind, Motion};
use capsule_plant::verdict::{Verdict, name};
use client::error::ClientError;
use client::{Device, Unobserved};
use protocol::capsule::{
    ActuationAccepted, ActuationOutcome, ActuationRecord, Calibrate, CapsuleState, GetCapsuleTotals,
};
use protocol::error::Refusal;
use protocol::system::DeviceKind;

use crate::bench::{Bench, BenchError};
use crate::boards::capsule::{self, CapsuleBoard};
use crate::link::VirtualLink;
use crate::plants::capsule::Capsule;

/// Time from the request to the motor's first drive: the frame, the answer, a control period, ms.
const START_MS: f64 = 5.0;
/// Rest before a capsule is checked, so that the motor has run down and the bridge sleeps.
const REST_US: u64 = 300_000;

/// A board with one capsule.
struct Workbench {
    bench: Bench<CapsuleBoard>,
    device: Device,
}

/// Tries one capsule with one defect. Returns the verdict of the image.
///
/// # Errors
/// The bench fails, or the image does what is wrong for every capsule: drives at rest, forgets a fault, moves with
/// one, writes flash while the motor turns, accesses what the chip does not have.
pub fn try_case(kind: Kind, seed: u64) -> Result<Verdict, BenchError> {
    let parameters = kind.parameters(seed);
    let bench = capsule::start(parameters)?;
    let link = Box::new(VirtualLink::new(&bench, "virtual capsule"));
    let device = Device::connect(link, DeviceKind::Capsule, 1)?;
    let mut workbench = Workbench { bench, device };
    workbench.device.idle(REST_US, &mut Unobserved)?;
    let mut end_mm = 0.0;
    if kind.course(seed, end_mm).motion != Motion::Calibrate {
        let calibrated = workbench.calibrate()?;
        if calibrated.name() != "Complete" {
            return Ok(Verdict {
                name: calibrated.name(),
                took_ms: None,
                peak_n: workbench.look(|capsule| capsule.peak_force_n())?,
                short_mm: None,
            });
        }
        end_mm = workbench.folded_mm()? - parameters.slack_mm;
    }
    let mut verdict = workbench.follow(&kind.course(seed, end_mm), end_mm)?;
    match workbench.check(kind, &mut verdict)? {
        Ok(()) => Ok(verdict),
        Err(what) => Err(BenchError::Wrong(format!("{kind:?}, seed {seed}: {what}"))),
    }
}

impl Workbench {
    fn look<T: Send + 'static>(
        &self,
        look: impl FnOnce(&mut Capsule) -> T + Send + 'static,
    ) -> Result<T, BenchError> {
        self.bench.visit(|visit| look(&mut visit.board().capsule))
    }

    fn wait(
        &mut self,
        accepted: Result<ActuationAccepted, ClientError>,
    ) -> Result<Moved, BenchError> {
        let accepted = match accepted {
            Ok(accepted) => accepted,
            Err(ClientError::Refused { refusal, .. }) => return Ok(Moved::Refused(refusal)),
            Err(other) => return Err(other.into()),
        };
        let record = self.device.wait_actuation(&accepted, &mut Unobserved)?;
        self.device.idle(REST_US, &mut Unobserved)?;
        Ok(Moved::Ended(record))
    }

    fn calibrate(&mut self) -> Result<Moved, BenchError> {
        let accepted = self.device.call(Calibrate);
        self.wait(accepted)
    }

    fn fold(&mut self) -> Result<Moved, BenchError> {
        let accepted = self.device.fold();
        self.wait(accepted)
    }

    fn unfold(&mut self) -> Result<Moved, BenchError> {
        let accepted = self.device.unfold();
        self.wait(accepted)
    }

    /// Thread at the calibrated end, mm.
    fn folded_mm(&mut self) -> Result<f64, BenchError> {
        let totals = self.device.call(GetCapsuleTotals)?;
        let folded_um = totals
            .calibration
            .map_or(0, |calibration| calibration.folded_um);
        Ok(f64::from(folded_um) / 1e3)
    }

    fn follow(&mut self, course: &Course, end_mm: f64) -> Result<Verdict, BenchError> {
        if course.folds_first {
            self.fold()?;
        }
        let (defects, planned) = (course.defects.clone(), course.planned);
        let planned_before = planned.filter(|(at_ms, _)| *at_ms < 0.0);
        self.look(move |capsule| {
            let now = planned_before.map(|(_, defect)| defect);
            for defect in defects.into_iter().chain(now) {
                capsule.suffer(defect);
            }
            capsule.plant_mut().forget_extremes();
        })?;
        // Give the next samples at rest a chance to notice the defect.
        let rests_ms = course.rests_ms.max(u32::from(planned_before.is_some()));
        self.device
            .idle(u64::from(rests_ms) * 1_000, &mut Unobserved)?;
        let in_motion = planned.filter(|(at_ms, _)| *at_ms >= 0.0);
        if let Some((at_ms, defect)) = in_motion {
            let at_ns = self.bench.now_ns() + ((START_MS + at_ms) * 1e6) as u64;
            self.look(move |capsule| capsule.plan(at_ns, defect))?;
        }
        let mut short_mm = None;
        let mut last = Moved::Refused(Refusal::AlreadyThere);
        let motions = match course.motion {
            Motion::Calibrate => vec![Self::calibrate as fn(&mut Self) -> _],
            Motion::Fold => vec![Self::fold as _],
            Motion::Unfold => vec![Self::unfold as _],
            Motion::Cycles(cycles) => [Self::fold as _, Self::unfold as _].repeat(cycles as usize),
        };
        for motion in motions {
            last = motion(self)?;
            if self.device.capsule_status()?.state == CapsuleState::Folded {
                let short = end_mm - self.look(|capsule| capsule.travel_mm())?;
                short_mm = Some(short_mm.map_or(short, |most: f64| most.max(short)));
            }
            if last.name() != "Complete" {
                break;
            }
        }
        let took_ms = match (&last, in_motion) {
            (Moved::Ended(record), Some((at_ms, _))) => {
                Some((f64::from(record.duration_ms) - at_ms).max(0.0) as u64)
            }
            _ => None,
        };
        Ok(Verdict {
            name: last.name(),
            took_ms,
            peak_n: self.look(|capsule| capsule.peak_force_n())?,
            short_mm,
        })
    }

    /// Checks the rules that hold for every capsule, whatever its defect.
    fn check(
        &mut self,
        kind: Kind,
        verdict: &mut Verdict,
    ) -> Result<Result<(), String>, BenchError> {
        let (awake, moving, before_mm) =
            self.look(|capsule| (capsule.is_awake(), capsule.is_moving(), capsule.wound_mm()))?;
        self.device.idle(REST_US, &mut Unobserved)?;
        let after_mm = self.look(|capsule| capsule.wound_mm())?;
        if awake || moving || before_mm != after_mm {
            return Ok(Err(format!(
                "driven at rest: {before_mm} mm, then {after_mm} mm"
            )));
        }
        let status = self.device.capsule_status()?;
        let latched = status.fault.map(|fault| name(&fault));
        // The amplifier's zero is checked only at rest, after the motion has ended well. Take the fault that is latched
        // then, as the library's verdict does.
        if kind == Kind::Offset && latched.as_deref() == Some("SenseLost") {
            verdict.name = "SenseLost".to_owned();
        }
        let faulted = !["Complete", "BatteryLow"].contains(&verdict.name.as_str());
        if faulted && latched.as_ref() != Some(&verdict.name) {
            return Ok(Err(format!(
                "{} is not latched, {latched:?} is",
                verdict.name
            )));
        }
        if faulted {
            match self.unfold()? {
                Moved::Refused(Refusal::CapsuleFaulted(_)) => {}
                other => return Ok(Err(format!("with a fault: {}", other.name()))),
            }
        }
        let moving_writes = self.look(|capsule| capsule.flash_moving())?;
        if moving_writes > 0 {
            return Ok(Err(
                "the flash was written while the motor turned".to_owned()
            ));
        }
        Ok(self.bench.bus()?.check(0))
    }
}

enum Moved {
    Refused(Refusal),
    Ended(ActuationRecord),
}

impl Moved {
    fn name(&self) -> String {
        match self {
            Self::Refused(Refusal::CapsuleFaulted(fault)) => name(fault),
            Self::Refused(refusal) => name(refusal),
            Self::Ended(record) => match record.outcome {
                ActuationOutcome::Faulted(fault) => name(&fault),
                outcome => name(&outcome),
            },
        }
    }
}
