//! Progress for people: a bar on a terminal, plain lines elsewhere.

use std::io::Write;

use client::decimal;
use client::{Begun, Observer, Pace, Progress, homing_limit_us, visible, wording};
use indicatif::{ProgressBar, ProgressStyle};
use protocol::capsule::CapsuleEvent;
use protocol::error::Refusal;
use protocol::rig::{RigEvent, RunTiming};
use protocol::system::{Event, What};

/// Interval between two plain lines, us of the machine's time.
const LINE_US: u64 = 5_000_000;

/// One line of 80 columns, cut off at the width of the terminal: a bar of two lines would erase text above it.
const BAR: &str = "  {bar:20} {percent:>3} % {wide_msg}";

/// Prints the progress of an action. All times are the machine's, so they mean the same on the virtual bench.
pub struct Live<'a> {
    out: &'a mut dyn Write,
    terminal: bool,
    bar: Option<ProgressBar>,
    next_line_us: u64,
    /// Whether the run was held at the last report.
    held: bool,
}

impl<'a> Live<'a> {
    /// Prints to `out`; draws a bar on standard error instead of lines if that is a terminal.
    pub fn new(out: &'a mut dyn Write, terminal: bool) -> Self {
        Self {
            out,
            terminal,
            bar: None,
            next_line_us: 0,
            held: false,
        }
    }

    fn line(&mut self, text: &str) {
        let text = visible::lines(text);
        match &self.bar {
            Some(bar) => bar.println(text.as_ref()),
            // Ignore the error: a closed pipe must not stop the machine's supervision.
            None => drop(writeln!(self.out, "{text}")),
        }
    }

    fn show(&mut self, elapsed_us: u64, total_us: u64, message: &str) {
        if self.terminal {
            let bar = self.bar.get_or_insert_with(|| {
                let bar = ProgressBar::new(total_us);
                if let Ok(style) = ProgressStyle::with_template(BAR) {
                    bar.set_style(style);
                }
                bar
            });
            bar.set_length(total_us);
            bar.set_position(elapsed_us.min(total_us));
            bar.set_message(message.to_owned());
        } else if elapsed_us >= self.next_line_us {
            self.next_line_us = elapsed_us - elapsed_us % LINE_US + LINE_US;
            self.line(&format!("  {message}"));
        }
    }
}

impl Drop for Live<'_> {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Observer for Live<'_> {
    fn begun(&mut self, begun: &Begun) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
        self.next_line_us = LINE_US;
        self.line(&begun_text(begun));
    }

    fn event(&mut self, event: &Event) {
        match event.what {
            What::Rig(RigEvent::Faulted(fault)) => self.line(&format!("  fault: {fault}")),
            What::Capsule(CapsuleEvent::Faulted(fault)) => self.line(&format!("  fault: {fault}")),
            What::Rig(RigEvent::Resumed) => self.line("  resumed"),
            What::LinkLost => self.line("  the device has not heard from the host for too long"),
            _ => {}
        }
    }

    fn unrecorded(&mut self, why: &str) {
        self.line(&format!(
            "  NOT RECORDED from here on: {why}; the machine goes on, Ctrl-C stops it"
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
                let message = format!(
                    "{} s of {} s, stroke {} of {strokes}, {} mm, {} s left",
                    tenths(elapsed_us),
                    tenths(total_us),
                    stroke.saturating_add(1).min(strokes),
                    decimal::fixed(position_um.into(), 3),
                    tenths(total_us.saturating_sub(elapsed_us)),
                );
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

    #[test]
    fn a_refused_hold_speaks_in_the_units_of_the_options() {
        let refusal = Refusal::NotAtHome { position_um: 1_500 };
        let text = refused_text(Pace::Resume, &refusal);
        assert!(
            text.contains("not resumed: the carriage stands at 1.5 mm"),
            "{text}"
        );
    }
}
