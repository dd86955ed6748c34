//! Recording of the present or last motion at 1 kHz: its last 4.2 s, so that a fault keeps the readings before it.

use crate::known::Known;
use crate::sense::{Counts, Sample};
use crate::speed::Drive;
use protocol::capsule::{GetTrace, KEPT_TRACE_POINTS, MAX_TRACE_POINTS, Trace, TracePoint};

/// Resolution and origin of the recorded battery voltage, mV.
const BATTERY_STEP_MV: u16 = 10;
const BATTERY_FROM_MV: u16 = 2_000;
/// Resolution of the recorded drive, mV.
const DRIVE_STEP_MV: i16 = 40;

/// One reading in six bytes.
#[derive(Clone, Copy, Default)]
struct Packed {
    /// Counts from the position at the start; 40 mm fit.
    counts: i16,
    current_ma: u16,
    battery: u8,
    drive: i8,
}

pub struct Recording {
    actuation: u32,
    origin: Counts,
    points: [Packed; KEPT_TRACE_POINTS],
    count: usize,
    next: usize,
}

impl Default for Recording {
    fn default() -> Self {
        Self {
            actuation: 0,
            origin: Counts(0),
            points: [Packed::default(); KEPT_TRACE_POINTS],
            count: 0,
            next: 0,
        }
    }
}

impl Recording {
    /// Takes a reading and the drive that follows from it. The first one of another motion clears the recording.
    pub fn take(&mut self, actuation: u32, sample: &Sample, drive: Drive) {
        if self.actuation != actuation {
            self.actuation = actuation;
            self.origin = sample.counts;
            (self.count, self.next) = (0, 0);
        }
        let from_origin = (sample.counts - self.origin).0;
        let battery = sample.battery_mv.saturating_sub(BATTERY_FROM_MV) / BATTERY_STEP_MV;
        let drive_mv = drive.millivolts().unwrap_or(0);
        self.points[self.next] = Packed {
            counts: from_origin.clamp(i16::MIN.into(), i16::MAX.into()) as i16,
            current_ma: sample.magnitude_ma(),
            battery: u8::try_from(battery).unwrap_or(u8::MAX),
            drive: (drive_mv / DRIVE_STEP_MV).clamp(i8::MIN.into(), i8::MAX.into()) as i8,
        };
        self.next = (self.next + 1) % KEPT_TRACE_POINTS;
        self.count = (self.count + 1).min(KEPT_TRACE_POINTS);
    }

    /// A part of the recording, with the thread on the spool as it is `known`.
    pub fn part(&self, get: &GetTrace, known: &Known) -> Trace {
        let from = usize::try_from(get.from).unwrap_or(usize::MAX);
        let last = self.count.min(from.saturating_add(MAX_TRACE_POINTS));
        let oldest = self.next + KEPT_TRACE_POINTS - self.count;
        let points = (from..last).map(|index| {
            let packed = &self.points[(oldest + index) % KEPT_TRACE_POINTS];
            let counts = self.origin + Counts(packed.counts.into());
            TracePoint {
                thread_um: known.thread(counts).0,
                current_ma: packed.current_ma,
                battery_mv: BATTERY_FROM_MV + u16::from(packed.battery) * BATTERY_STEP_MV,
                drive_mv: i16::from(packed.drive) * DRIVE_STEP_MV,
            }
        });
        Trace {
            actuation: self.actuation,
            // At most 4,200.
            total: self.count as u16,
            points: points.collect(),
        }
    }
}
