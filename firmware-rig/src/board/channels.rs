//! State that the rig's tasks and interrupts share, beyond `device::chip::channels`. The rings of DMA and the state of
//! the switch filter are in their own modules.

use core::{
    cell::Cell,
    sync::atomic::{AtomicBool, AtomicI32, AtomicU32, Ordering},
};
use embassy_sync::{
    blocking_mutex::{Mutex, raw::CriticalSectionRawMutex as Raw},
    channel::Channel,
    signal::Signal,
};
use embassy_time::Instant;
use firmware_rig::{
    control::Snapshot,
    execution::{Mailbox, Order},
    machine::Event,
};
use motion::{edge_timing::Intervals, units::StepPosition};
use protocol::settings::SettingKey;

/// Fed by interrupts and motion, drained by control.
pub static NOTICES: Channel<Raw, Event<'static>, 16> = Channel::new();
/// Fed by control, drained by motion.
pub static ORDERS: Signal<Raw, Order> = Signal::new();
/// Decelerate. Fed by control, drained by motion.
pub static STOP: AtomicBool = AtomicBool::new(false);
/// The pulses of the present path were cut. Set by interrupts, link and control; cleared by motion at a start.
pub static CUT: AtomicBool = AtomicBool::new(false);
/// Wakes motion: for an order, a stop, a cut or a masked switch.
pub static MOTION_WAKE: Signal<Raw, ()> = Signal::new();
/// Set by control, read by telemetry and the LED.
pub static SNAPSHOT: Mutex<Raw, Cell<Option<Snapshot>>> = Mutex::new(Cell::new(None));
/// Position by the generator, steps. Set by motion.
pub static COMMANDED: AtomicI32 = AtomicI32::new(0);
/// Sum of the changes of the counter that were not motion, steps. Set by control where it sets the counter.
pub static POSITION_SHIFT: AtomicI32 = AtomicI32::new(0);
/// Stroke in progress, from 0. Set by motion.
pub static STROKE: AtomicU32 = AtomicU32::new(0);
/// False pulses on home flag and far limit. Set by the switch interrupt.
pub static GLITCHES: [Glitches; 2] = [const { Glitches::new() }; 2];
/// How long a switch must keep its level, us. Set by control, read by the switch interrupt.
pub static SWITCH_FILTER_US: AtomicU32 = AtomicU32::new(SettingKey::SwitchFilterUs.range().default);
/// Filtered state of the home flag. Set at the start and by the switch interrupt.
pub static HOME_FLAG_OPEN: AtomicBool = AtomicBool::new(false);
/// Filtered state of the far limit. Set at the start and by the switch interrupt.
pub static FAR_LIMIT_OPEN: AtomicBool = AtomicBool::new(false);

/// Captured intervals by their error. Set by motion.
pub static INTERVALS: CapturedIntervals = CapturedIntervals::new();
/// Captures that were overwritten before DMA read them. Set by motion.
pub static LOST_CAPTURES: AtomicU32 = AtomicU32::new(0);
/// Errors of the two DMA streams of the step timer and of its captures. Set by motion.
pub static DMA_ERRORS: AtomicU32 = AtomicU32::new(0);
/// Polls that found an underrun or overrun of a FIFO of these streams, which is not an error. Set by motion.
pub static FIFO_ERRORS: AtomicU32 = AtomicU32::new(0);
/// Resets of the step timer after a burst that was cut in two. Set by motion.
pub static TIMER_RESETS: AtomicU32 = AtomicU32::new(0);
/// EN was high before the firmware drove it. Set at the start.
pub static ENABLE_HIGH_AT_START: AtomicBool = AtomicBool::new(false);

/// [`Intervals`] in atomics, so that other tasks can read them.
pub struct CapturedIntervals([AtomicU32; 4]);

impl CapturedIntervals {
    const fn new() -> Self {
        Self([const { AtomicU32::new(0) }; 4])
    }

    /// Publishes the counts of the comparison.
    pub fn publish(&self, Intervals { exact, off }: Intervals) {
        for (shown, count) in self.0.iter().zip([exact, off[0], off[1], off[2]]) {
            shown.store(count, Ordering::Relaxed);
        }
    }

    /// Exact ones, and those that were off by 1, by 2 and by more ticks.
    pub fn get(&self) -> [u32; 4] {
        self.0.each_ref().map(|count| count.load(Ordering::Relaxed))
    }
}

/// False pulses on one switch, and when the last one was.
pub struct Glitches {
    count: AtomicU32,
    last_us: AtomicU32,
    masked: AtomicU32,
}

impl Glitches {
    const fn new() -> Self {
        Self {
            count: AtomicU32::new(0),
            last_us: AtomicU32::new(0),
            masked: AtomicU32::new(0),
        }
    }

    /// Counts a false pulse and notes its time.
    pub fn add(&self) {
        self.count.fetch_add(1, Ordering::Relaxed);
        let now = Instant::now().as_micros() as u32;
        self.last_us.store(now, Ordering::Relaxed);
    }

    /// Counts a masking of the line.
    pub fn add_masking(&self) {
        self.masked.fetch_add(1, Ordering::Relaxed);
    }

    /// The counts as sent to the host.
    pub fn get(&self) -> protocol::rig::Glitches {
        protocol::rig::Glitches {
            count: self.count.load(Ordering::Relaxed),
            last_us: self.last_us.load(Ordering::Relaxed),
            masked: self.masked.load(Ordering::Relaxed),
        }
    }
}

/// Tells motion that the pulses were cut.
pub fn wake_after_cut() {
    CUT.store(true, Ordering::Release);
    MOTION_WAKE.signal(());
}

/// Tells motion and control that the pulses were cut.
pub fn pulses_were_cut(why: Event<'static>) {
    wake_after_cut();
    // Control takes notices at least every 10 ms, so 16 cannot pile up. If one is lost, the report of the path's end
    // still shows the cut.
    let _ = NOTICES.try_send(why);
}

/// Motion's end of these channels.
pub struct MotionMailbox;

impl Mailbox for MotionMailbox {
    fn take_order(&mut self) -> Option<Order> {
        let order = ORDERS.try_take()?;
        CUT.store(false, Ordering::Release);
        STOP.store(false, Ordering::Release);
        Some(order)
    }

    fn is_cut(&self) -> bool {
        CUT.load(Ordering::Acquire)
    }

    fn take_stop(&mut self) -> bool {
        STOP.swap(false, Ordering::AcqRel)
    }

    fn notify(&mut self, event: Event<'static>) -> bool {
        NOTICES.try_send(event).is_ok()
    }

    fn publish(&mut self, stroke: u32, commanded: StepPosition) {
        STROKE.store(stroke, Ordering::Relaxed);
        COMMANDED.store(commanded.0, Ordering::Relaxed);
    }
}
