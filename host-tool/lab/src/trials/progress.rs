//! Progress for people: a bar on a terminal, plain lines elsewhere.

use std::io::Write;

use client::decimal;
use client::{Begun, Observer, Pace, Progress, homing_limit_us, visible, wording};
use protocol::capsule::CapsuleEvent;
use protocol::error::Refusal;
use protocol::rig::{RigEvent, RunTiming};
use protocol::system::{Event, What};

use crate::operations::output::{ERASE, columns};

/// Interval between two plain lines, us of the machine's time.
const LINE_US: u64 = 5_000_000;

/// A bar and a message that replace the present line. Cut off at the width of the terminal, because a bar of two lines
/// would erase text above it; 80 columns leave 61 for the message.
#[must_use]
pub fn bar(done: u64, total: u64, message: &str) -> String {
    let part = |of: u64| done.min(total) * of / total.max(1);
    let tenths = part(10) as usize;
    let line = format!(
        "  {}{} {:>3} % {message}",
        "#".repeat(tenths),
        ".".repeat(10 - tenths),
        part(100)
    );
    let shown: String = line.chars().take(columns()).collect();
    format!("{ERASE}{shown}")
}

/// Prints the progress of an action. All times are the machine's, so they mean the same on the virtual bench.
pub struct Live<'a> {
    out: &'a mut dyn Write,
    terminal: bool,
    /// A bar is on the present line.
    has_bar: bool,
    next_line_us: u64,
    /// Whether the run was held at the last report.
    held: bool,
}

impl<'a> Live<'a> {
    /// Prints to `out`; draws a bar instead of lines if that is a terminal.
    pub fn new(out: &'a mut dyn Write, terminal: bool) -> Self {
        Self {
            out,
            terminal,
            has_bar: false,
            next_line_us: 0,
            held: false,
        }
    }

    fn line(&mut self, text: &str) {
        self.write(&format!("{}\n", visible::lines(text)), false);
    }

    /// Replaces the bar by a text, in one piece.
    fn write(&mut self, text: &str, is_bar: bool) {
        let erase = if self.has_bar && !is_bar { ERASE } else { "" };
        self.has_bar = is_bar;
        // Ignore the error: a closed pipe must not stop the supervision of the machine.
        let _ = self.out.write_all(format!("{erase}{text}").as_bytes());
    }

    fn show(&mut self, elapsed_us: u64, total_us: u64, message: &str) {
        if self.terminal {
            self.write(&bar(elapsed_us, total_us, message), true);
        } else if elapsed_us >= self.next_line_us {
            self.next_line_us = elapsed_us - elapsed_us % LINE_US + LINE_US;
            self.line(&format!("  {message}"));
        }
    }
}

impl Drop for Live<'_> {
    fn drop(&mut self) {
        self.write("", false);
    }
}

impl Observer for Live<'_> {
    fn begun(&mut self, begun: &Begun) {
        self.next_line_us = LINE_US;
        self.line(&begun_text(begun));
    }

    fn event(&mut self, event: &Event) {
        match event.what {
            What::Rig(RigEvent::Faulted(fault)) => self.line(&format!("  fault: {fault}")),
            What::Capsule(CapsuleEvent::Faulted(fault)) => self.line(&format!("  fault: {fault}")),
            What::Rig(RigEvent::Resumed) => self.line("  resumed"),
            What::Capsule(CapsuleEvent::StorageFailed) => self.line(
                "  NOT KEPT: the flash could not be written; after the next start the place is uncertain. Charge the cell, then try again",
            ),
            What::LinkLost => self.line("  the device has not heard from the host for too long"),
            _ => {}
        }
    }

    fn unrecorded(&mut self, why: &str) {
        self.line(&format!(
            "  NOT RECORDED from here on: {why}; the machine continues, Ctrl-C stops it"
        ));
    }

    fn refused(&mut self, pace: Pace, refusal: &Refusal) {
        self.line(&refused_text(pace, refusal));
    }

    fn progress(&mut self, progress: &Progress) {
        match *progress {
            Progress::Homing {
                elapsed_us,
                at_most_us,
                ..
            } => {
                let message = format!(
                    "homing, {} s of at most {} s",
                    tenths(elapsed_us),
                    tenths(at_most_us)
                );
                self.show(elapsed_us, at_most_us, &message);
            }
            Progress::Run {
                elapsed_us,
                total_us,
                stroke,
                strokes,
                position_um,
                held,
            } => {
                let held_now = !std::mem::replace(&mut self.held, held);
                if held {
                    let message = format!("held at {} mm", decimal::fixed(position_um.into(), 3));
                    if self.terminal {
                        self.show(elapsed_us, total_us, &message);
                    } else if held_now {
                        self.line(&format!("  {message}"));
                    }
                    return;
                }
                let place = format!(
                    "stroke {} of {strokes}, {} mm",
                    stroke.saturating_add(1).min(strokes),
                    decimal::fixed(position_um.into(), 3),
                );
                let message = run_text(elapsed_us, total_us, &place, self.terminal);
                self.show(elapsed_us, total_us, &message);
            }
            Progress::Actuation {
                elapsed_us,
                at_most_us,
                thread_um,
                current_ma,
            } => {
                let message = format!(
                    "{} s of at most {} s, {} mm of thread, {current_ma} mA",
                    tenths(elapsed_us),
                    tenths(at_most_us),
                    decimal::fixed(thread_um.into(), 3),
                );
                self.show(elapsed_us, at_most_us, &message);
            }
        }
    }
}

/// Times and position of a run. Beside a bar, omits the elapsed time: the bar shows it, and there is no room.
fn run_text(elapsed_us: u64, total_us: u64, place: &str, beside_bar: bool) -> String {
    let (total, remaining) = (
        tenths(total_us),
        tenths(total_us.saturating_sub(elapsed_us)),
    );
    match beside_bar {
        true => format!("{remaining} of {total} s left, {place}"),
        false => format!(
            "{} s of {total} s, {place}, {remaining} s left",
            tenths(elapsed_us)
        ),
    }
}

/// The refused action and the reason, in words.
fn refused_text(pace: Pace, refusal: &Refusal) -> String {
    let what = match pace {
        Pace::Hold => "not held",
        Pace::Resume => "not resumed",
    };
    format!("  {what}: {}", wording::refusal(refusal))
}

/// The action that has begun and its duration, in words.
#[must_use]
fn begun_text(begun: &Begun) -> String {
    match begun {
        Begun::Homing(homing) => format!(
            "Homing: to the flag at {} mm/s, again at {} mm/s, then to 0; at most {} s.",
            milli(homing.seek_um_s),
            milli(homing.locate_um_s),
            tenths(homing_limit_us(homing)),
        ),
        Begun::Run(run) => {
            let how = match run.requested.timing {
                RunTiming::Total { .. } => "",
                RunTiming::Speeds { .. } => " (from the speeds)",
            };
            let delay = match run.requested.start_delay_us {
                0 => String::new(),
                us => format!(" with a start delay of {} s", decimal::write(us.into(), 6)),
            };
            format!(
                "Run {}: {} strokes of {} mm in {} s{how}{delay}; peak {} / {} mm/s, {} mm/s2, {} steps.",
                run.run,
                u32::from(run.requested.cycles) * 2,
                milli(run.requested.stroke_um),
                decimal::write(run.total_ticks, 8),
                milli(run.forward.peak_um_s),
                milli(run.back.peak_um_s),
                milli(run.forward.accel_um_s2),
                run.edges,
            )
        }
        Begun::Move(accepted) => format!(
            "Move: {} steps in {} s; peak {} mm/s, {} mm/s2.",
            accepted.stroke.steps,
            decimal::write(accepted.stroke.duration_ticks, 8),
            milli(accepted.stroke.peak_um_s),
            milli(accepted.stroke.accel_um_s2),
        ),
        Begun::Actuation(actuation) => format!(
            "Actuation {}: ends by itself within {} s.",
            actuation.actuation,
            decimal::write(actuation.timeout_ms.into(), 3)
        ),
    }
}

fn milli(value: u32) -> String {
    decimal::write(value.into(), 3)
}

/// Seconds with one decimal, to the nearest.
fn tenths(us: u64) -> String {
    let tenths = us.saturating_add(50_000) / 100_000;
    format!("{}.{}", tenths / 10, tenths % 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: the line of the paper's run was cut off at 80 columns: `4.7 s lef`.
    #[test]
    fn a_bar_and_its_text_fit_80_columns() {
        for (total_us, place) in [
            (40_000_000, "stroke 10 of 10, 130.000 mm"),
            // The most strokes, in the paper's time.
            (80_000_000_000, "stroke 20000 of 20000, 130.000 mm"),
        ] {
            let text = run_text(1, total_us, place, true);
            assert!(text.contains(" s left, stroke"), "{text}");
            assert!(bar(1, total_us, &text).ends_with(&text), "{text}");
        }
    }

    #[test]
    fn a_refused_hold_speaks_in_the_units_of_the_options() {
        let refusal = Refusal::NotAtHome { position_um: 1_500 };
        let text = refused_text(Pace::Resume, &refusal);
        assert!(
            text.contains("not resumed: the carriage is at 1.5 mm"),
            "{text}"
        );
    }

    /// The lines of an action with these reports.
    fn lines(report: impl FnOnce(&mut Live)) -> Vec<String> {
        let mut out = vec![];
        report(&mut Live::new(&mut out, false));
        let text = String::from_utf8(out).expect("UTF-8");
        text.lines().map(str::to_owned).collect()
    }

    #[test]
    fn a_line_is_told_in_each_five_seconds() {
        let shown = lines(|live| {
            live.begun(&Begun::Actuation(protocol::capsule::ActuationAccepted {
                actuation: 1,
                timeout_ms: 16_000,
            }));
            for elapsed_us in [
                4_999_999, 5_000_000, 9_999_999, 10_700_000, 14_999_999, 15_000_000,
            ] {
                live.progress(&Progress::Actuation {
                    elapsed_us,
                    at_most_us: 16_000_000,
                    thread_um: 1_500,
                    current_ma: 30,
                });
            }
        });
        assert_eq!(
            shown,
            [
                "Actuation 1: ends by itself within 16 s.",
                "  5.0 s of at most 16.0 s, 1.500 mm of thread, 30 mA",
                "  10.7 s of at most 16.0 s, 1.500 mm of thread, 30 mA",
                "  15.0 s of at most 16.0 s, 1.500 mm of thread, 30 mA",
            ]
        );
    }

    #[test]
    fn what_the_operator_has_to_know_is_told() {
        let shown = lines(|live| {
            live.unrecorded("no space");
            live.refused(Pace::Hold, &Refusal::NothingToAcknowledge);
            for what in [What::Rig(RigEvent::Resumed), What::LinkLost] {
                live.event(&Event {
                    index: 0,
                    time_us: 0,
                    what,
                });
            }
        });
        let begins = [
            "  NOT RECORDED from here on: no space",
            "  not held: ",
            "  resumed",
            "  the device",
        ];
        assert_eq!(shown.len(), begins.len(), "{shown:?}");
        for (line, begin) in shown.iter().zip(begins) {
            assert!(line.starts_with(begin), "{line}");
        }
    }

    #[test]
    fn a_hold_is_told_once_and_a_fault_at_once() {
        let shown = lines(|live| {
            for held in [true, true, false, true] {
                live.progress(&Progress::Run {
                    elapsed_us: 0,
                    total_us: 60_000_000,
                    stroke: 0,
                    strokes: 4,
                    position_um: 1_250,
                    held,
                });
            }
            let faults = [
                What::Rig(RigEvent::Faulted(protocol::rig::RigFault::EStopFrame)),
                What::Capsule(CapsuleEvent::Faulted(
                    protocol::capsule::CapsuleFault::Timeout,
                )),
            ];
            for what in faults {
                live.event(&Event {
                    index: 0,
                    time_us: 0,
                    what,
                });
            }
        });
        assert_eq!(shown.len(), 4 + 1, "a line of the run, too: {shown:?}");
        let held = "  held at 1.250 mm".to_owned();
        assert_eq!(
            shown.iter().filter(|line| **line == held).count(),
            2,
            "{shown:?}"
        );
        let faults = shown.iter().filter(|line| line.starts_with("  fault: "));
        assert_eq!(faults.count(), 2, "{shown:?}");
    }
}
