//! The person at the terminal as the operator of a commissioning.

use std::sync::mpsc::TryRecvError;
use std::thread;
use std::time::{Duration, Instant};

use client::visible::wrapped;
use client::{Interrupt, decimal};
use lab::commissioning::halt::Halt;
use lab::commissioning::operator::{Act, Operator, Part, Reading, Say, Watch};
use lab::commissioning::session::COLUMNS;

use crate::cli::keyboard::{Lines, TOO_SOON, TypedLine};
use crate::cli::screen::Keyboard;

/// Polling interval of the keyboard.
const TURN: Duration = Duration::from_millis(20);

/// A person who reads prompts and types.
pub(super) struct Terminal {
    typed: Lines,
    interrupt: Interrupt,
}

enum Answer {
    Nothing,
    TooSoon,
    Text(String),
}

impl Terminal {
    pub(super) fn new(keyboard: Keyboard, by_hand: bool, interrupt: Interrupt) -> Self {
        let typed = Lines::new(keyboard, by_hand);
        Self { typed, interrupt }
    }

    /// Reads the next line after the prompt at `asked`. `q`, the end of the input and Ctrl-C quit; `s` skips the step.
    fn answer(&self, asked: Instant) -> Result<Answer, Halt> {
        if (self.interrupt)().is_some() {
            return Err(Halt::Aborted);
        }
        match self.typed.answer(asked) {
            Err(TryRecvError::Empty) => Ok(Answer::Nothing),
            Err(TryRecvError::Disconnected) => Err(Halt::Aborted),
            Ok(TypedLine::TooSoon) => Ok(Answer::TooSoon),
            Ok(TypedLine::Text(line)) => match line.trim() {
                "q" => Err(Halt::Aborted),
                "s" => Err(Halt::NotShown("skipped by the operator".to_owned())),
                text => Ok(Answer::Text(text.to_owned())),
            },
        }
    }
}

impl Operator for Terminal {
    fn act(
        &mut self,
        act: Act,
        shows: bool,
        say: &mut Say<'_>,
        watch: &mut Watch<'_>,
    ) -> Result<(), Halt> {
        prompt(act_text(act), say);
        // An Enter typed by habit must not confirm an act that an input would have shown.
        let (done, hint) = if shows {
            (
                "n",
                "    Continues when it detects that. n: done, nothing happens; s skips, q quits",
            )
        } else {
            (
                "",
                "    Enter when done; s and Enter skips the step, q and Enter leaves",
            )
        };
        say(hint);
        let asked = Instant::now();
        loop {
            if watch()? {
                return Ok(());
            }
            match self.answer(asked)? {
                Answer::Text(text) if text == done => return Ok(()),
                Answer::TooSoon if done.is_empty() => say(&format!("    {TOO_SOON}")),
                Answer::TooSoon => {}
                Answer::Text(text) if text.is_empty() => {}
                Answer::Text(_) => say(hint),
                Answer::Nothing => thread::sleep(TURN),
            }
        }
    }

    fn read(&mut self, reading: Reading, say: &mut Say<'_>) -> Result<i64, Halt> {
        let hint = "    The number and Enter; s and Enter skips the step, q and Enter leaves";
        prompt(reading_text(reading), say);
        say(hint);
        let asked = Instant::now();
        loop {
            match self.answer(asked)? {
                Answer::Nothing => thread::sleep(TURN),
                Answer::TooSoon => {}
                Answer::Text(text) if text.is_empty() => {}
                // Millimetres and volts have three decimals here, so these are micrometres and millivolts, far below
                // 2^63.
                Answer::Text(text) => match decimal::parse(&text, 3, 1_000_000_000) {
                    Ok(value) => return Ok(value.cast_signed()),
                    Err(error) => {
                        say(&format!("    {text}: {error}"));
                        say(hint);
                    }
                },
            }
        }
    }
}

fn prompt(text: &str, say: &mut Say<'_>) {
    for line in wrapped(&format!("  > {text}"), COLUMNS, "    ") {
        say(&line);
    }
}

fn act_text(act: Act) -> &'static str {
    match (act.part, act.on) {
        (Part::HomeFlag, true) => "Actuate the HOME FLAG by hand, and keep it actuated.",
        (Part::HomeFlag, false) => "Let the home flag go.",
        (Part::FarLimit, true) => "Actuate the FAR LIMIT by hand, and keep it actuated.",
        (Part::FarLimit, false) => "Let the far limit go.",
        (Part::EStop, true) => "Press the E-STOP button, and leave it pressed.",
        (Part::EStop, false) => "Release the E-stop button.",
        (Part::HomeEnd, true) => {
            "Open the END-OF-TRAVEL SWITCH at the RIGHT end, beyond home, and keep it so."
        }
        (Part::HomeEnd, false) => "Let the end-of-travel switch at the right end go.",
        (Part::FarEnd, true) => "Open the END-OF-TRAVEL SWITCH at the LEFT end, and keep it so.",
        (Part::FarEnd, false) => "Let the end-of-travel switch at the left end go.",
        (Part::Jumper, true) => "Put the jumper D2-A0 back.",
        (Part::Jumper, false) => "Pull the read-back JUMPER D2-A0 while the carriage moves.",
        (Part::Supply, true) => {
            "Keep a hand on its switch, then switch the MOTOR SUPPLY ON. The carriage will move."
        }
        (Part::Supply, false) => "Switch the MOTOR SUPPLY OFF.",
        (Part::Rotor, true) => {
            "HOLD the capsule's MOTOR SHAFT (the vice at its worm), so that it cannot turn, and keep it so."
        }
        (Part::Rotor, false) => "Let the motor shaft go.",
        (Part::Cable, true) => "Wait 3 s, then plug the cable in again.",
        (Part::Cable, false) => {
            "Pull the USB CABLE while the carriage moves (the board has to be fed by E5V or VIN)."
        }
        (Part::Carriage, _) => {
            "Turn the screw by hand until the carriage is in the MIDDLE of its travel."
        }
    }
}

fn reading_text(reading: Reading) -> &'static str {
    match reading {
        Reading::EnableInReset => {
            "Hold the black RESET button, measure D8 against GND, release the button. Volts:"
        }
        Reading::Carriage => {
            "Measure with a caliper from a fixed point, such as the frame's right end, to the carriage. Millimetres:"
        }
        Reading::Battery => "Measure the BATTERY at the capsule's board. Volts:",
    }
}
