//! The rig's wiring: NUCLEO-F411RE with a CNC shield.
//!
//! | pin | signal | electrically |
//! |---|---|---|
//! | PA10 | STEP | TIM1_CH3 as AF1, or a plain output; low while nothing drives it |
//! | PB4, PA9 | DIR, EN | plain outputs; a pull-up at EN, if the rig has it, keeps the driver off while nothing drives it |
//! | PA6 | E-stop loop | contact to ground, TIM1_BKIN as AF1 |
//! | PC7, PB6 | home flag, far limit | contacts to ground, the chip's pull-ups |
//! | PA0 | read-back | jumper from STEP, TIM2_ETR as AF1 |
//! | PA1 | capture | jumper from STEP, TIM5_CH2 as AF2 |
//! | PA8 | sync | TIM1_CH1 as AF1, or a plain output |
//! | PC13, PA5 | button, LED | the board's own; the button pulls to ground against a resistor |

use std::path::PathBuf;

use crate::bench::{Bench, BenchError, BenchOptions, images};
use crate::emulator::{OutputEdge, Pads, Pin, Unnoticed, Wiring};
use crate::plants::rig::{Rig, RigOptions, Switch};

const STEP: Pin = Pin::new('A', 10);
const DIR: Pin = Pin::new('B', 4);
const ENABLE: Pin = Pin::new('A', 9);
const ESTOP: Pin = Pin::new('A', 6);
const HOME: Pin = Pin::new('C', 7);
const FAR: Pin = Pin::new('B', 6);
const READ_BACK: Pin = Pin::new('A', 0);
const CAPTURE: Pin = Pin::new('A', 1);
const SYNC: Pin = Pin::new('A', 8);
const BUTTON: Pin = Pin::new('C', 13);
#[expect(
    dead_code,
    reason = "nothing here uses it, but the table of pins is compared with the firmware's"
)]
const LED: Pin = Pin::new('A', 5);
/// The alternate function for TIM1 and TIM2 (DS10314 table 9).
const AF_TIMER: Option<u8> = Some(1);
/// The alternate function for TIM5 (DS10314 table 9).
const AF_CAPTURE: Option<u8> = Some(2);
const CAPTURE_CHANNEL: u8 = 2;
/// TIM1's channels for STEP and sync.
const STEP_CHANNEL: u8 = 3;
const SYNC_CHANNEL: u8 = 1;

const CONTACTS: [(Switch, Pin); 3] = [
    (Switch::EStop, ESTOP),
    (Switch::Home, HOME),
    (Switch::Far, FAR),
];

/// The board with the rig on it.
#[derive(Debug)]
pub struct RigBoard {
    pub rig: Rig,
    step_high: bool,
    sync_high: bool,
    /// Levels that the board drove last; `None` after a reset.
    contacts: [Option<bool>; 3],
    button: Option<bool>,
    broken: Option<bool>,
    read_back: Option<bool>,
    captured: Option<bool>,
    enable: Option<bool>,
    kept_from_dma: bool,
    outputs_safe: bool,
    safe_before_clock: Option<bool>,
    switched_off_ns: Option<u64>,
}

impl RigBoard {
    /// `rig` on its board.
    #[must_use]
    pub fn new(rig: Rig) -> Self {
        Self {
            rig,
            step_high: false,
            sync_high: false,
            contacts: [None; 3],
            button: None,
            broken: None,
            read_back: None,
            captured: None,
            enable: None,
            kept_from_dma: false,
            outputs_safe: false,
            safe_before_clock: None,
            switched_off_ns: None,
        }
    }

    /// When the driver was last switched off, by driving or releasing EN.
    #[must_use]
    pub fn switched_off_ns(&self) -> Option<u64> {
        self.switched_off_ns
    }

    /// Whether EN was driven high, DIR driven and STEP low when the firmware last switched on the high-speed clock,
    /// whose start may take long; `None` before that.
    #[must_use]
    pub fn was_safe_before_clock(&self) -> Option<bool> {
        self.safe_before_clock
    }

    fn step(&mut self, high: bool, at_ns: u64, pads: &mut Pads<'_>) {
        if high == self.step_high {
            return;
        }
        self.step_high = high;
        self.rig
            .set_armed(pads.function(STEP) == AF_TIMER && pads.tim1_armed());
        self.rig.step(high, at_ns);
        let kept = self.rig.keeps_captures_from_dma();
        if std::mem::replace(&mut self.kept_from_dma, kept) != kept {
            pads.keep_tim5_from_dma(kept);
        }
        if let Some(at_ns) = self.rig.captured_ns() {
            self.capture(at_ns, pads);
        }
        self.drive(pads);
    }

    fn sync(&mut self, high: bool, at_ns: u64) {
        if high && !self.sync_high {
            self.rig.sync(at_ns);
        }
        self.sync_high = high;
    }

    /// Drives the capture input at `at_ns`, which may be that of the timer event being handled.
    fn capture(&mut self, at_ns: u64, pads: &mut Pads<'_>) {
        let high = self.rig.capture() && pads.function(CAPTURE) == AF_CAPTURE;
        if self.captured.replace(high) != Some(high) {
            pads.drive_tim5_input(CAPTURE_CHANNEL, high, at_ns);
        }
    }

    /// Drives every input whose level has changed.
    fn drive(&mut self, pads: &mut Pads<'_>) {
        for ((switch, pin), driven) in CONTACTS.into_iter().zip(&mut self.contacts) {
            let open = self.rig.is_open(switch);
            if driven.replace(open) != Some(open) {
                pads.drive(pin, (!open).then_some(false));
            }
        }
        let pressed = self.rig.is_pressed();
        if self.button.replace(pressed) != Some(pressed) {
            pads.drive(BUTTON, Some(!pressed));
        }
        let broken = pads.function(ESTOP) == AF_TIMER && pads.is_high(ESTOP);
        if self.broken.replace(broken) != Some(broken) {
            pads.drive_break(broken);
        }
        let pulled = self.rig.pulls_enable_up();
        if self.enable.replace(pulled) != Some(pulled) {
            pads.drive(ENABLE, Some(pulled));
        }
        let counted = self.rig.read_back() && pads.function(READ_BACK) == AF_TIMER;
        if self.read_back.replace(counted) != Some(counted) {
            pads.drive_tim2_etr(counted);
        }
        self.capture(pads.now_ns(), pads);
    }
}

impl Wiring for RigBoard {
    const ON_CHANGES_ONLY: bool = true;

    fn restarted(&mut self) {
        self.contacts = [None; 3];
        self.button = None;
        self.broken = None;
        self.read_back = None;
        self.captured = None;
        self.enable = None;
        self.kept_from_dma = false;
        self.outputs_safe = false;
        self.safe_before_clock = None;
    }

    fn update(&mut self, pads: &mut Pads<'_>) {
        let now_ns = pads.now_ns();
        let step_by_timer = pads.function(STEP) == AF_TIMER;
        let sync_by_timer = pads.function(SYNC) == AF_TIMER;
        for edge in pads.take_tim1_edges() {
            match edge.channel {
                STEP_CHANNEL if step_by_timer => self.step(edge.high, edge.at_ns, pads),
                SYNC_CHANNEL if sync_by_timer => self.sync(edge.high, edge.at_ns),
                _ => {}
            }
        }
        let step = if step_by_timer {
            pads.tim1_high(STEP_CHANNEL)
        } else {
            pads.output(STEP).unwrap_or(false)
        };
        self.step(step, now_ns, pads);
        let sync = if sync_by_timer {
            pads.tim1_high(SYNC_CHANNEL)
        } else {
            pads.output(SYNC).unwrap_or(false)
        };
        self.sync(sync, now_ns);
        match pads.output(DIR) {
            Some(away) => self.rig.turn(away, now_ns),
            None => self.rig.let_go_of_direction(now_ns),
        }
        // While nothing drives EN, a pull-up keeps the driver off. Without a pull-up the driver's own resistor switches
        // it on.
        let enable_high = pads.output(ENABLE).unwrap_or(self.rig.pulls_enable_up());
        if enable_high && self.rig.is_enabled() {
            self.switched_off_ns = Some(now_ns);
        }
        self.rig.set_enabled(!enable_high);
        if !pads.hse_is_on() {
            self.outputs_safe = pads.output(ENABLE) == Some(true)
                && pads.output(DIR).is_some()
                && pads.output(STEP) == Some(false);
        } else if self.safe_before_clock.is_none() {
            self.safe_before_clock = Some(self.outputs_safe);
        }
        self.rig.advance(now_ns);
        self.drive(pads);
        if let Some(next_ns) = self.rig.next_ns() {
            pads.wake_at(next_ns);
        }
    }

    fn unnoticed(&self, pads: &mut Pads<'_>) -> Option<Unnoticed> {
        let [read_back, capture] = self.rig.jumpers();
        let counted = read_back.leads()? && pads.function(READ_BACK) == AF_TIMER;
        let captured = capture.leads()? && pads.function(CAPTURE) == AF_CAPTURE;
        let is_driven = pads.function(STEP) == AF_TIMER && pads.tim1_armed();
        let has_been_told = self.read_back == Some(counted && self.step_high)
            && self.captured == Some(captured && self.step_high);
        (is_driven && has_been_told).then(|| Unnoticed {
            pulses: self.rig.unnoticed_steps(),
            syncs: pads.function(SYNC) == AF_TIMER,
            counted,
            captured,
        })
    }

    fn unseen_edge(&mut self, edge: OutputEdge, leads: &Unnoticed) {
        let OutputEdge { at_ns, high, .. } = edge;
        if edge.channel == SYNC_CHANNEL {
            if leads.syncs {
                self.sync(high, at_ns);
            }
            return;
        }
        self.step_high = high;
        self.rig.set_armed(true);
        self.rig.step(high, at_ns);
        self.read_back = Some(leads.counted && high);
        self.captured = Some(leads.captured && high);
    }

    fn flash_began(&mut self, _: bool) {
        self.rig.flash_began();
    }

    /// The carriage keeps its position; the next step needs an edge.
    fn powered_off(&mut self) {}
}

/// Path of the rig's image.
#[must_use]
pub fn image() -> PathBuf {
    images().join("firmware-rig")
}

/// Starts a rig on the bench with the image that would be flashed.
///
/// # Errors
/// A missing or unusable image.
pub fn start(rig: RigOptions) -> Result<Bench<RigBoard>, BenchError> {
    Bench::start(RigBoard::new(Rig::new(rig)), BenchOptions::new(image()))
}
