//! A small model of the capsule's mechanics: motor, gears, spool, slack, origami (beam estimate) or obstacle, battery
//! with internal resistance. It shares no arithmetic with the crate.

use firmware_capsule::{
    detect::Sample,
    fold::{Actions, Capsule, Command, Drive, Event},
    mechanics::Counts,
};
use protocol::capsule::CapsuleEvent;

const RESISTANCE: f64 = 5.4; // ohm
const TORQUE: f64 = 2.11e-3; // Nm/A
const BACK_EMF: f64 = 0.221e-3 * 60.0 / (2.0 * core::f64::consts::PI); // Vs/rad
const INERTIA: f64 = 5.1e-9; // kg m2
const NO_LOAD: f64 = 0.016; // A
const SPOOL: f64 = 1.5e-3; // m
const RATIO: f64 = 120.0;

/// An injected defect. Positions are thread on the spool, mm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Defect {
    /// The thread snaps here.
    Snap(f64),
    /// A hard stop blocks the thread here.
    Jam(f64),
    /// The encoder's lines break from here on.
    Encoder(f64),
    /// Encoder channels A and B are swapped.
    Swapped,
    /// nFAULT is low from here on.
    Driver(f64),
    /// The current sensor reads a short circuit from here on.
    Short(f64),
}

pub(crate) struct Plant {
    /// Motor, rad.
    pub(crate) angle: f64,
    /// Motor, rad/s.
    pub(crate) speed: f64,
    /// Motor, A.
    pub(crate) current: f64,
    /// Battery without load, V.
    pub(crate) cell: f64,
    pub(crate) cell_ohm: f64,
    pub(crate) bridge_ohm: f64,
    /// Battery under the present load, V.
    pub(crate) battery: f64,
    /// Drawn from the battery's terminals so far, J.
    pub(crate) energy: f64,
    pub(crate) defect: Option<Defect>,
    pub(crate) snapped: bool,
    /// Thread that slipped off the spool, mm.
    pub(crate) slipped_mm: f64,
    /// Of the origami, 1 = as estimated.
    pub(crate) stiffness: f64,
    pub(crate) encoder_at: Option<i32>,
}

impl Plant {
    pub(crate) fn at(thread_mm: f64) -> Self {
        Self {
            angle: thread_mm * 1e-3 / SPOOL * RATIO,
            speed: 0.0,
            current: 0.0,
            cell: 3.9,
            cell_ohm: 0.5,
            bridge_ohm: 0.6,
            battery: 3.9,
            energy: 0.0,
            defect: None,
            snapped: false,
            slipped_mm: 0.0,
            stiffness: 1.0,
            encoder_at: None,
        }
    }

    /// True thread on the spool, mm. 0 is 1 mm before the origami is touched.
    pub(crate) fn thread_mm(&self) -> f64 {
        self.angle / RATIO * SPOOL * 1e3
    }

    /// Pull of the thread, N.
    pub(crate) fn force(&self) -> f64 {
        if self.snapped {
            return 0.0;
        }
        let travel = (self.thread_mm() - self.slipped_mm - 1.0).max(0.0);
        let stop = match self.defect {
            Some(Defect::Jam(at)) => at,
            _ => 23.4 + 1.0 + self.slipped_mm,
        };
        beam(travel) * self.stiffness + (self.thread_mm() - stop).max(0.0) * 200.0
    }

    /// Runs for `us` with a constant drive.
    pub(crate) fn run(&mut self, drive: Drive, us: u32) {
        match self.defect {
            Some(Defect::Snap(at)) if self.thread_mm() > at => self.snapped = true,
            _ => {}
        }
        let step = 20e-6;
        for _ in 0..us / 20 {
            let torque = self.force() * SPOOL / 30.0;
            // Winding lifts against the worm's efficiency, paying out against its self-locking.
            let load = match drive {
                Drive::Millivolts(millivolts) if millivolts < 0 => -torque * 1.133 / (4.0 * 0.8),
                _ => torque / 0.315 / (4.0 * 0.8),
            };
            // The bridge drives for a share of the time and lets the motor coast for the rest.
            let share = match drive {
                Drive::Millivolts(millivolts) => {
                    (f64::from(millivolts) / 1e3 / self.battery.max(0.1)).clamp(-1.0, 1.0)
                }
                _ => 0.0,
            };
            let loop_ohm = RESISTANCE + self.bridge_ohm;
            self.current = match drive {
                Drive::Off => 0.0,
                Drive::Brake => -BACK_EMF * self.speed / loop_ohm,
                Drive::Millivolts(_) => {
                    let against = BACK_EMF * self.speed * share.signum();
                    share * (self.cell - against).max(0.0) / (loop_ohm + self.cell_ohm)
                }
            };
            let drag = TORQUE * NO_LOAD;
            let push = TORQUE * self.current;
            if self.speed == 0.0 {
                let resisting = drag + load.abs();
                if push.abs() > resisting {
                    self.speed += (push - resisting.copysign(push)) / INERTIA * step;
                }
            } else {
                let resisting = (drag + load.abs()).copysign(self.speed);
                let speed = self.speed + (push - resisting) / INERTIA * step;
                // Friction and a self-locking load stop the motor but do not reverse it.
                self.speed = if speed * self.speed < 0.0 { 0.0 } else { speed };
            }
            self.angle += self.speed * step;
            let drawn = if drive == Drive::Brake {
                0.0
            } else {
                self.current.abs()
            };
            self.battery = (self.cell - self.cell_ohm * drawn).max(0.0);
            self.energy += self.battery * drawn * step;
        }
    }

    pub(crate) fn sample(&mut self) -> Sample {
        let count = (self.angle / (2.0 * core::f64::consts::PI) * 64.0).floor() as i32;
        let thread = self.thread_mm();
        let mut sample = Sample {
            counts: Counts(count),
            current_ma: (self.current.abs() * 1e3).round() as u16,
            offset_ma: 0,
            battery_mv: (self.battery * 1e3).round() as u16,
            driver_fault: false,
        };
        match self.defect {
            Some(Defect::Encoder(at)) if thread > at || self.encoder_at.is_some() => {
                sample.counts = Counts(*self.encoder_at.get_or_insert(count));
            }
            Some(Defect::Swapped) => sample.counts = Counts(-count),
            Some(Defect::Driver(at)) => sample.driver_fault = thread > at,
            Some(Defect::Short(at)) if thread > at => sample.current_ma = 1_500,
            _ => {}
        }
        sample
    }
}

/// Force of the nine crescents at a travel: F = 0.2055 N a / (dd0/da), d = 9 d0(a), Eqs. (2)-(5) and (7).
fn beam(travel_mm: f64) -> f64 {
    let (h, ta, tb) = (9.76_f64, 2.0 / 9.0, 2.0 / 3.0);
    let (l1, l2) = (
        h * (1.0_f64 + tb * tb).sqrt(),
        h * (1.0_f64 + ta * ta).sqrt(),
    );
    let psi = |a: f64| {
        let u = h - a;
        (l1 * l1 - u * u).sqrt() - (l2 * l2 - u * u).sqrt()
    };
    let travel = |a: f64| 9.0 * (psi(0.0) - psi(a));
    static TABLE: std::sync::OnceLock<Vec<(f64, f64)>> = std::sync::OnceLock::new();
    let table = TABLE.get_or_init(|| {
        let force = |a: f64| 0.2055 * a * 2e-4 / (psi(a - 1e-4) - psi(a + 1e-4));
        (0..970)
            .map(|i| f64::from(i) / 100.0)
            .map(|a| (travel(a), force(a)))
            .collect()
    });
    let above = table.partition_point(|(travel, _)| *travel < travel_mm);
    let (Some(low), Some(high)) = (table.get(above.wrapping_sub(1)), table.get(above)) else {
        return if above == 0 {
            0.0
        } else {
            table[table.len() - 1].1
        };
    };
    low.1 + (high.1 - low.1) * (travel_mm - low.0) / (high.0 - low.0)
}

#[test]
fn the_beam_estimate_gives_the_published_forces() {
    for (travel_mm, newton) in [(16.6, 1.2), (19.0, 2.9), (20.6, 5.8), (21.7, 10.8)] {
        let error = beam(travel_mm) / newton - 1.0;
        assert!(error.abs() < 0.04, "{travel_mm} mm: {} N", beam(travel_mm));
    }
    assert!(beam(-1.0) == 0.0 && beam(0.0) < 0.01);
}

/// The state machine in closed loop with the plant, in virtual time.
pub(crate) struct Simulation {
    pub(crate) plant: Plant,
    pub(crate) capsule: Capsule,
    pub(crate) now_us: u64,
    pub(crate) events: Vec<CapsuleEvent>,
    /// Least and most true thread on the spool.
    pub(crate) lowest_mm: f64,
    pub(crate) highest_mm: f64,
    /// N.
    pub(crate) peak_force: f64,
}

impl Simulation {
    pub(crate) fn new(plant: Plant) -> Self {
        let mut sim = Self {
            capsule: Capsule::new(None),
            now_us: 0,
            events: Vec::new(),
            lowest_mm: plant.thread_mm(),
            highest_mm: plant.thread_mm(),
            peak_force: 0.0,
            plant,
        };
        sim.tick();
        sim
    }

    /// One millisecond, then a sample.
    pub(crate) fn tick(&mut self) {
        self.now_us += 1_000;
        self.plant.run(self.capsule.drive(), 1_000);
        self.lowest_mm = self.lowest_mm.min(self.plant.thread_mm());
        self.highest_mm = self.highest_mm.max(self.plant.thread_mm());
        self.peak_force = self.peak_force.max(self.plant.force());
        let sample = self.plant.sample();
        self.give(Event::Sample(sample));
    }

    pub(crate) fn give(&mut self, event: Event) -> Actions {
        let actions = self.capsule.step(self.now_us, event);
        self.events.extend(actions.events.iter().copied());
        actions
    }

    pub(crate) fn order(&mut self, command: Command) {
        let actions = self.give(Event::Command(command));
        assert_eq!(actions.refusal, None, "{command:?} refused");
    }

    /// Runs until the machine rests and the bridge sleeps; at most 15 s.
    pub(crate) fn settle(&mut self) {
        for _ in 0..15_000 {
            self.tick();
            if !self.capsule.is_moving() && self.capsule.drive() == Drive::Off {
                return;
            }
        }
        panic!("still moving: {:?}", self.capsule);
    }

    /// Orders and runs until everything rests.
    pub(crate) fn run(&mut self, command: Command) {
        self.order(command);
        self.settle();
    }

    /// Referenced and unfolded.
    pub(crate) fn referenced() -> Self {
        let mut sim = Self::new(Plant::at(0.4));
        sim.run(Command::Reference);
        sim.events.clear();
        (sim.lowest_mm, sim.highest_mm) = (sim.plant.thread_mm(), sim.plant.thread_mm());
        sim.peak_force = 0.0;
        sim
    }

    /// Orders and runs until the true thread passes `mm`.
    pub(crate) fn run_past(&mut self, command: Command, mm: f64) {
        let above = self.plant.thread_mm() > mm;
        self.order(command);
        while (self.plant.thread_mm() > mm) == above {
            self.tick();
            assert!(self.capsule.is_moving(), "ended before {mm} mm");
        }
    }
}
