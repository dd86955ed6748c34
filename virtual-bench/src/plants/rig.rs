//! The rig: step driver, screw, carriage and switches.
//!
//! The carriage is counted in steps from position 0 = right end, positive to the left. It follows every step that the
//! driver accepts. At the ends of travel and with injected faults it loses steps, which the chip cannot see.

use super::contact::{Bounce, Contact};
use super::wire::{self, Wire};
use crate::faults::{Faults, When};
use crate::pins::{EdgeLog, StepEdge};

/// Timing requirements of a DRV8825, the slowest of the supported drivers (its data sheet): shortest high and low of
/// STEP, and how long DIR is steady before and after a rising STEP, ns.
const PULSE_NS: u64 = 1_900;
const DIR_NS: u64 = 650;
/// Steps closer together than this belong to one movement, ns.
const MOVING_NS: u64 = 10_000_000;
/// Longest time from the opening of the E-stop loop to the last pulse, ns: the chip's break input ends the pulses.
const LOOP_CUTS_NS: u64 = 10_000;
/// Longest time from the opening of the far limit to the last pulse, ns: the firmware's filter and two sampling windows
/// of 24 us, the masking of a noisy line, which may keep it busy for a millisecond, and its next poll.
const LIMIT_CUTS_NS: u64 = 5_000_000;

/// Parameters of the rig.
#[derive(Clone, Copy, Debug)]
pub struct RigOptions {
    /// Initial position of the carriage, steps.
    pub carriage: i64,
    /// Steps per millimetre.
    pub steps_per_mm: i64,
    /// The home flag is open at this position and below, steps.
    pub flag: i64,
    /// The far limit is open at this position and above, steps.
    pub limit: i64,
    /// The mechanical ends of travel, steps.
    pub stops: (i64, i64),
    /// One coil of the motor is reversed: it turns against DIR.
    pub reversed: bool,
    /// Home flag and far limit are plugged into each other's inputs.
    pub swapped_switches: bool,
    /// The second jumper connects STEP to the capture input.
    pub capture_jumper: bool,
    /// Voltage that EN is pulled up to, mV: 3,300 by the board, 5,000 by a shield at 5 V; `None` without a pull-up,
    /// when the driver's own resistor switches it on.
    pub enable_pull_up_mv: Option<u32>,
}

impl Default for RigOptions {
    fn default() -> Self {
        Self::REFERENCE
    }
}

impl RigOptions {
    /// The paper's rig with the carriage at 20 mm: flag at 1 mm, limit at 131 mm, stops at -3 and 133 mm.
    pub const REFERENCE: Self = Self {
        carriage: 16_000,
        steps_per_mm: 800,
        flag: 800,
        limit: 131 * 800,
        stops: (-3 * 800, 133 * 800),
        reversed: false,
        swapped_switches: false,
        capture_jumper: false,
        enable_pull_up_mv: Some(3_300),
    };

    /// The rig as the manual wires it, with the jumper that times its steps. It emulates edges more slowly.
    pub const WITH_BOTH_JUMPERS: Self = Self {
        capture_jumper: true,
        ..Self::REFERENCE
    };

    /// The same rig with a driver or screw of `steps_per_mm` steps per millimetre.
    #[must_use]
    pub fn with_steps_per_mm(self, steps_per_mm: i64) -> Self {
        let scaled = |steps: i64| steps * steps_per_mm / self.steps_per_mm;
        Self {
            carriage: scaled(self.carriage),
            steps_per_mm,
            flag: scaled(self.flag),
            limit: scaled(self.limit),
            stops: (scaled(self.stops.0), scaled(self.stops.1)),
            ..self
        }
    }
}

/// The rig's contacts. All are closed to ground in the normal state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Switch {
    Home,
    Far,
    EStop,
}

/// A contact of the E-stop loop. Opening any of them opens the loop, because they are in series.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LoopContact {
    /// The E-stop button.
    Button,
    /// The end-of-travel switch beyond home.
    HomeEnd,
    /// The end-of-travel switch beyond the far end.
    FarEnd,
}

/// Actions and faults of the rig.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// Press (or release) the E-stop.
    EStop(bool),
    /// Press (or release) the start button.
    Button(bool),
    /// Apply a fault to the jumper from STEP to the read-back input.
    ReadBack(wire::Fault),
    /// Apply a fault to the jumper from STEP to the capture input.
    Capture(wire::Fault),
    /// Make a contact stay open or closed, or work again.
    Stick(Switch, Option<bool>),
    /// Make a contact bounce from now on, or stop that.
    Bounce(Switch, Option<Bounce>),
    /// Inject a pulse of this width, ns, on a contact's wire.
    Disturb(Switch, u64),
    /// Put noise on a contact's wire that toggles at this interval in ns, or remove it.
    Noise(Switch, Option<u64>),
    /// Make the motor ignore this many steps.
    LoseSteps(u64),
    /// Actuate (or release) an end-of-travel switch by hand.
    Loop(LoopContact, bool),
    /// Actuate (or release) the home flag or the far limit by hand.
    Actuate(Switch, bool),
    /// Switch the motor supply.
    Supply(bool),
    /// Move the carriage by hand to this position, steps. Works only while the motor has no supply.
    Place(i64),
    /// Carry out an action after this delay, ns.
    Later(u64, Box<Action>),
}

/// Violations of the requirements of driver and mechanics. All zero in a correct run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Violations {
    /// STEP pulses too short, except those cut because STEP was no longer driven.
    pub short_high: u64,
    /// Gaps between STEP pulses too short.
    pub short_low: u64,
    /// Steps too soon after a change of DIR.
    pub dir_setup: u64,
    /// Changes of DIR too soon after a step.
    pub dir_hold: u64,
    /// Steps while the driver was off.
    pub disabled: u64,
    /// Steps lost at the ends of travel.
    pub stalled: u64,
    /// Steps less than 10 ms apart with a flash operation between them, which stalls every instruction.
    pub flash_moving: u64,
    /// Steps while the E-stop loop was open.
    pub loop_open: u64,
    /// Steps away from home while the far limit was open.
    pub limit_open: u64,
}

/// The rig.
#[derive(Debug)]
pub struct Rig {
    options: RigOptions,
    carriage: i64,
    away: bool,
    enabled: bool,
    armed: bool,
    step_high: bool,
    rose_ns: Option<u64>,
    fell_ns: Option<u64>,
    turned_ns: Option<u64>,
    /// Whether a flash operation has begun since the last step.
    flash_began: bool,
    lose: u64,
    lost: u64,
    cut_pulses: u64,
    extremes: (i64, i64),
    edges: EdgeLog,
    syncs: Vec<u64>,
    violations: Violations,
    home: Contact,
    far: Contact,
    estop: Contact,
    /// Contacts of the E-stop loop that are open: button, home end, far end.
    loop_open: [bool; 3],
    /// Home flag and far limit are actuated by hand.
    by_hand: [bool; 2],
    supplied: bool,
    button: bool,
    read_back: Wire,
    capture: Wire,
    /// When the last change of STEP reaches the capture input.
    captured_ns: Option<u64>,
    faults: Faults<Action>,
}

impl Rig {
    /// A rig at rest.
    #[must_use]
    pub fn new(options: RigOptions) -> Self {
        Self {
            options,
            carriage: options.carriage,
            away: false,
            enabled: false,
            armed: true,
            step_high: false,
            rose_ns: None,
            fell_ns: None,
            turned_ns: None,
            flash_began: false,
            lose: 0,
            lost: 0,
            cut_pulses: 0,
            extremes: (options.carriage, options.carriage),
            edges: EdgeLog::default(),
            syncs: Vec::new(),
            violations: Violations::default(),
            home: Contact::new(options.carriage <= options.flag),
            far: Contact::new(options.carriage >= options.limit),
            estop: Contact::new(false),
            loop_open: [false; 3],
            by_hand: [false; 2],
            supplied: true,
            button: false,
            read_back: Wire::new(true),
            capture: Wire::new(options.capture_jumper),
            captured_ns: None,
            faults: Faults::default(),
        }
    }

    /// Position of the carriage, steps from the right end.
    #[must_use]
    pub fn carriage(&self) -> i64 {
        self.carriage
    }

    /// Extreme positions since the last call of [`Rig::forget_extremes`], steps.
    #[must_use]
    pub fn extremes(&self) -> (i64, i64) {
        self.extremes
    }

    /// Restarts the record of extremes at the present position.
    pub fn forget_extremes(&mut self) {
        self.extremes = (self.carriage, self.carriage);
    }

    /// All step edges so far.
    #[must_use]
    pub fn edges(&self) -> &EdgeLog {
        &self.edges
    }

    /// Rising edges of the sync output, ns.
    #[must_use]
    pub fn syncs(&self) -> &[u64] {
        &self.syncs
    }

    /// Violations so far.
    #[must_use]
    pub fn violations(&self) -> Violations {
        self.violations
    }

    /// Number of steps that the carriage did not follow: lost by a fault, stalled, or sent to a driver that was off.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// When the E-stop loop last opened at the chip's pin, ns.
    #[must_use]
    pub fn loop_opened_ns(&self) -> Option<u64> {
        self.estop.opened_ns()
    }

    /// Number of pulses cut short because STEP was no longer driven.
    #[must_use]
    pub fn cut_pulses(&self) -> u64 {
        self.cut_pulses
    }

    /// Whether the driver is on.
    #[must_use]
    pub fn is_enabled(&self) -> bool {
        self.enabled
    }

    /// Whether the input of `switch` is open.
    #[must_use]
    pub fn is_open(&self, switch: Switch) -> bool {
        let swapped = self.options.swapped_switches;
        match switch {
            Switch::Home if swapped => self.far.is_open(),
            Switch::Far if swapped => self.home.is_open(),
            Switch::Home => self.home.is_open(),
            Switch::Far => self.far.is_open(),
            Switch::EStop => self.estop.is_open(),
        }
    }

    /// Position of the carriage from the right end, um.
    #[must_use]
    pub fn carriage_um(&self) -> i64 {
        self.carriage * 1_000 / self.options.steps_per_mm
    }

    /// The middle between the mechanical ends, steps.
    #[must_use]
    pub fn middle(&self) -> i64 {
        i64::midpoint(self.options.stops.0, self.options.stops.1)
    }

    /// Whether EN is pulled up on the board.
    #[must_use]
    pub fn pulls_enable_up(&self) -> bool {
        self.options.enable_pull_up_mv.is_some()
    }

    /// EN while nothing drives it, mV: 10 kohm, if fitted, against the driver's own 100 kohm to ground.
    #[must_use]
    pub fn enable_undriven_mv(&self) -> u32 {
        self.options.enable_pull_up_mv.unwrap_or(0) * 10 / 11
    }

    /// Whether the start button is pressed.
    #[must_use]
    pub fn is_pressed(&self) -> bool {
        self.button
    }

    /// Level at the read-back input.
    #[must_use]
    pub fn read_back(&self) -> bool {
        self.read_back.is_high()
    }

    /// Level at the capture input.
    #[must_use]
    pub fn capture(&self) -> bool {
        self.capture.is_high()
    }

    /// When the last change of STEP reaches the capture input, ns; `None` if it does not.
    #[must_use]
    pub fn captured_ns(&self) -> Option<u64> {
        self.captured_ns
    }

    /// Whether DMA is kept from the captured instants now.
    #[must_use]
    pub fn keeps_captures_from_dma(&self) -> bool {
        self.capture.keeps_from_dma()
    }

    /// The jumpers to the read-back and to the capture input.
    #[must_use]
    pub fn jumpers(&self) -> [&Wire; 2] {
        [&self.read_back, &self.capture]
    }

    /// Steps from now on, in this direction, that only move the carriage: no switch changes, no fault is due, and no
    /// step is lost.
    #[must_use]
    pub fn unnoticed_steps(&self) -> u64 {
        if !self.enabled || !self.supplied || self.lose > 0 {
            return 0;
        }
        let RigOptions {
            flag, limit, stops, ..
        } = self.options;
        let at = self.carriage;
        let left = self.away != self.options.reversed;
        let (to_stop, changes) = if left {
            (stops.1 - at, [flag - at, limit - 1 - at])
        } else {
            (at - stops.0, [at - flag - 1, at - limit])
        };
        let to_change = changes.into_iter().filter(|&steps| steps >= 0);
        let steps = to_change.fold(to_stop, i64::min).max(0).unsigned_abs();
        let made = self.edges.len() as u64;
        let to_fault = self
            .faults
            .next_edge()
            .map(|number| number.saturating_sub(made + 1));
        to_fault.map_or(steps, |to_fault| steps.min(to_fault))
    }

    /// Plans a fault.
    pub fn plan(&mut self, when: When, action: Action) {
        self.faults.plan(when, action);
    }

    /// Forgets the planned faults, and the steps that were still to be lost.
    pub fn forget_faults(&mut self) {
        (self.faults, self.lose) = (Faults::default(), 0);
    }

    /// Does `action` now.
    pub fn act(&mut self, action: Action, at_ns: u64) {
        match action {
            Action::EStop(pressed) => self.open_loop(LoopContact::Button, pressed, at_ns),
            Action::Loop(contact, open) => self.open_loop(contact, open, at_ns),
            Action::Actuate(switch, actuated) => {
                match switch {
                    Switch::Home => self.by_hand[0] = actuated,
                    Switch::Far => self.by_hand[1] = actuated,
                    Switch::EStop => self.open_loop(LoopContact::Button, actuated, at_ns),
                }
                self.actuate_switches(at_ns);
            }
            Action::Supply(on) => self.supplied = on,
            Action::Place(steps) if !self.supplied => {
                let (low, high) = self.options.stops;
                self.carriage = steps.clamp(low, high);
                self.actuate_switches(at_ns);
            }
            // A motor with current holds its position against a hand.
            Action::Place(_) => {}
            Action::Button(pressed) => self.button = pressed,
            Action::ReadBack(fault) => self.read_back.act(fault, at_ns),
            Action::Capture(fault) => self.capture.act(fault, at_ns),
            Action::Stick(switch, open) => self.contact(switch).stick(open, at_ns),
            Action::Bounce(switch, bounce) => self.contact(switch).set_bounce(bounce),
            Action::Disturb(switch, width_ns) => self.contact(switch).disturb(at_ns, width_ns),
            Action::Noise(switch, half_period_ns) => {
                self.contact(switch).set_noise(half_period_ns, at_ns);
            }
            Action::LoseSteps(steps) => self.lose += steps,
            Action::Later(after_ns, action) => self.plan(When::At(at_ns + after_ns), *action),
        }
    }

    fn open_loop(&mut self, contact: LoopContact, open: bool, at_ns: u64) {
        self.loop_open[contact as usize] = open;
        self.estop.actuate(self.loop_open.contains(&true), at_ns);
    }

    /// Actuates home flag and far limit by the carriage and by hand.
    fn actuate_switches(&mut self, at_ns: u64) {
        let [flag, limit] = self.by_hand;
        let flag = flag || self.carriage <= self.options.flag;
        let limit = limit || self.carriage >= self.options.limit;
        self.home.actuate(flag, at_ns);
        self.far.actuate(limit, at_ns);
    }

    fn contact(&mut self, switch: Switch) -> &mut Contact {
        match switch {
            Switch::Home => &mut self.home,
            Switch::Far => &mut self.far,
            Switch::EStop => &mut self.estop,
        }
    }

    /// Advances to `now_ns`, and applies the faults and contact changes due by then.
    pub fn advance(&mut self, now_ns: u64) {
        for action in self.faults.due_by(now_ns) {
            self.act(action, now_ns);
        }
        self.read_back.advance(now_ns);
        self.capture.advance(now_ns);
        for contact in [&mut self.home, &mut self.far, &mut self.estop] {
            contact.advance(now_ns);
        }
    }

    /// When something changes next without an action, ns.
    #[must_use]
    pub fn next_ns(&self) -> Option<u64> {
        let contacts = [&self.home, &self.far, &self.estop];
        let contacts = contacts.into_iter().filter_map(Contact::next_ns);
        contacts
            .chain(self.faults.next_ns())
            .chain(self.read_back.next_ns())
            .chain(self.capture.next_ns())
            .min()
    }

    /// EN changed: low switches the driver on.
    pub fn set_enabled(&mut self, enabled: bool) {
        self.enabled = enabled;
    }

    /// Tells whether STEP is driven. A pulse that ends because STEP is no longer driven was cut by a stop or a reset.
    pub fn set_armed(&mut self, armed: bool) {
        self.armed = armed;
    }

    /// DIR is no longer driven, as after a reset, and its pull-down makes it low. This is no change of direction: no
    /// pulse comes before the firmware drives it again.
    pub fn let_go_of_direction(&mut self, at_ns: u64) {
        if std::mem::take(&mut self.away) {
            self.turned_ns = Some(at_ns);
        }
    }

    /// DIR changed: high is away from home.
    pub fn turn(&mut self, away: bool, at_ns: u64) {
        if away == self.away {
            return;
        }
        self.away = away;
        self.turned_ns = Some(at_ns);
        if self.rose_ns.is_some_and(|rose| at_ns - rose < DIR_NS) {
            self.violations.dir_hold += 1;
        }
    }

    /// STEP changed.
    pub fn step(&mut self, high: bool, at_ns: u64) {
        if high == self.step_high {
            return;
        }
        self.step_high = high;
        self.read_back.step(high, at_ns);
        self.captured_ns = self.capture.step(high, at_ns);
        if high {
            self.rising_edge(at_ns);
        } else {
            self.fall(at_ns);
        }
    }

    fn fall(&mut self, at_ns: u64) {
        self.fell_ns = Some(at_ns);
        let short = self.rose_ns.is_some_and(|rose| at_ns - rose < PULSE_NS);
        if short && !self.armed {
            self.cut_pulses += 1;
        } else if short {
            self.violations.short_high += 1;
        }
    }

    fn rising_edge(&mut self, at_ns: u64) {
        let since = |event: Option<u64>| event.map_or(u64::MAX, |event| at_ns - event);
        self.violations.short_low += u64::from(since(self.fell_ns) < PULSE_NS);
        self.violations.dir_setup += u64::from(since(self.turned_ns) < DIR_NS);
        let moving = since(self.rose_ns) < MOVING_NS;
        self.violations.flash_moving += u64::from(std::mem::take(&mut self.flash_began) && moving);
        self.rose_ns = Some(at_ns);
        let away = self.away;
        let open_for = |contact: &Contact, ns: u64| contact.is_open_for(ns, at_ns);
        self.violations.loop_open += u64::from(open_for(&self.estop, LOOP_CUTS_NS));
        self.violations.limit_open += u64::from(away && open_for(&self.far, LIMIT_CUTS_NS));
        self.edges.push(StepEdge { at_ns, away });
        self.move_carriage();
        self.actuate_switches(at_ns);
        for action in self.faults.due_at_edge(self.edges.len() as u64) {
            self.act(action, at_ns);
        }
    }

    fn move_carriage(&mut self) {
        let left = self.away != self.options.reversed;
        let next = self.carriage + if left { 1 } else { -1 };
        let (low, high) = self.options.stops;
        if !self.enabled {
            self.violations.disabled += 1;
        } else if !self.supplied {
            // The driver accepts the step, but the motor has no current.
        } else if self.lose > 0 {
            self.lose -= 1;
        } else if next < low || next > high {
            self.violations.stalled += 1;
        } else {
            self.carriage = next;
            self.extremes = (self.extremes.0.min(next), self.extremes.1.max(next));
            return;
        }
        self.lost += 1;
    }

    /// The sync output rose.
    pub fn sync(&mut self, at_ns: u64) {
        self.syncs.push(at_ns);
    }

    /// The chip has begun a flash operation.
    pub fn flash_began(&mut self) {
        self.flash_began = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plants::contact::TO_PIN_NS;

    fn pulses(rig: &mut Rig, from_ns: u64, count: u64) {
        for n in 0..count {
            rig.step(true, from_ns + n * 10_000);
            rig.step(false, from_ns + n * 10_000 + 3_000);
        }
    }

    #[test]
    fn steps_move_the_carriage_and_the_flag_opens_at_its_place() {
        let mut rig = Rig::new(RigOptions {
            carriage: 802,
            ..RigOptions::default()
        });
        rig.set_enabled(true);
        pulses(&mut rig, 10_000, 1);
        rig.advance(20_000);
        assert!(!rig.is_open(Switch::Home));
        pulses(&mut rig, 30_000, 1);
        assert_eq!(rig.next_ns(), Some(30_000 + TO_PIN_NS));
        rig.advance(30_000 + TO_PIN_NS);
        assert!(rig.is_open(Switch::Home));
        assert_eq!(rig.carriage(), 800);
        assert_eq!(rig.violations(), Violations::default());
    }

    #[test]
    fn the_driver_objects_to_what_it_cannot_follow() {
        let mut rig = Rig::new(RigOptions::default());
        rig.set_enabled(true);
        rig.turn(true, 0);
        rig.step(true, 649);
        rig.step(false, 649 + 1_899);
        rig.step(true, 649 + 1_899 + 1_899);
        rig.turn(false, 649 + 1_899 + 1_899 + 649);
        rig.set_enabled(false);
        rig.step(false, 10_000);
        rig.step(true, 20_000);
        let expected = Violations {
            short_high: 1,
            short_low: 1,
            dir_setup: 1,
            dir_hold: 1,
            disabled: 1,
            ..Violations::default()
        };
        assert_eq!(rig.violations(), expected);
    }

    #[test]
    fn flash_may_be_changed_at_rest_only() {
        let mut rig = Rig::new(RigOptions::default());
        rig.set_enabled(true);
        rig.flash_began();
        pulses(&mut rig, 1_000_000, 2);
        rig.flash_began();
        assert_eq!(rig.violations().flash_moving, 0);
        pulses(&mut rig, 1_020_000 + MOVING_NS, 1);
        assert_eq!(rig.violations().flash_moving, 0);
        rig.flash_began();
        pulses(&mut rig, 1_030_000 + MOVING_NS, 2);
        assert_eq!(rig.violations().flash_moving, 1);
    }

    #[test]
    fn the_ends_of_travel_lose_steps() {
        let mut rig = Rig::new(RigOptions {
            carriage: -2_399,
            ..RigOptions::default()
        });
        rig.set_enabled(true);
        pulses(&mut rig, 0, 3);
        assert_eq!((rig.carriage(), rig.lost()), (-2_400, 2));
        assert_eq!(rig.violations().stalled, 2);
    }

    #[test]
    fn a_fault_at_an_edge_happens_with_it() {
        let mut rig = Rig::new(RigOptions::default());
        rig.set_enabled(true);
        rig.plan(When::Edge(2), Action::EStop(true));
        pulses(&mut rig, 0, 1);
        assert!(!rig.is_open(Switch::EStop));
        rig.step(true, 50_000);
        rig.advance(50_000 + TO_PIN_NS);
        assert!(rig.is_open(Switch::EStop));
    }

    #[test]
    fn a_spike_is_on_the_read_back_and_not_on_step() {
        let mut rig = Rig::new(RigOptions::default());
        rig.act(Action::ReadBack(wire::Fault::Spike(250)), 1_000);
        assert!(rig.read_back());
        assert_eq!(rig.next_ns(), Some(1_250));
        rig.advance(1_249);
        assert!(rig.read_back());
        rig.advance(1_250);
        assert!(!rig.read_back());
        assert!(rig.edges().is_empty());
    }

    #[test]
    fn a_short_pulse_is_a_violation_unless_it_was_cut() {
        let mut rig = Rig::new(RigOptions::default());
        rig.set_enabled(true);
        rig.step(true, 50_000);
        rig.step(false, 50_010);
        assert_eq!((rig.cut_pulses(), rig.violations().short_high), (0, 1));
        rig.step(true, 100_000);
        rig.set_armed(false);
        rig.step(false, 100_010);
        assert_eq!((rig.cut_pulses(), rig.violations().short_high), (1, 1));
    }
}
