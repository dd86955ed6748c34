//! Fixture at a machine on the bench: it presses, pulls and measures as `retrograde commission` asks a person to.

use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use lab::commissioning::halt::Halt;
use lab::commissioning::operator::{Act, Instruction, Operator, Part, Reading, Say, Watch};

use crate::bench::{Bench, BenchError};
use crate::boards::capsule::CapsuleBoard;
use crate::boards::rig::RigBoard;
use crate::emulator::Wiring;
use crate::plants::rig::{Action, LoopContact, Switch};
use crate::plants::wire::Fault;

/// How long a cable stays pulled, us.
const PULLED_US: u64 = 3_000_000;

/// The cable between a machine and its host, which a hand can pull.
#[derive(Clone, Debug)]
pub struct Plug(Arc<AtomicBool>);

impl Default for Plug {
    fn default() -> Self {
        Self(Arc::new(AtomicBool::new(true)))
    }
}

impl Plug {
    /// Whether it is plugged in.
    #[must_use]
    pub fn is_in(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    fn set(&self, plugged: bool) {
        self.0.store(plugged, Ordering::Relaxed);
    }
}

/// The machine at the fixture.
#[derive(Clone)]
pub enum Machine {
    /// A rig.
    Rig(Bench<RigBoard>),
    /// A capsule.
    Capsule(Bench<CapsuleBoard>),
}

/// Fixture at one machine.
#[derive(Clone)]
pub struct Fixture {
    machine: Machine,
    plug: Plug,
    /// A server runs the machine in real time, so the fixture need not advance its clock.
    served: bool,
}

impl Fixture {
    /// Fixture at a machine whose link has this plug.
    #[must_use]
    pub fn new(machine: Machine, plug: Plug) -> Self {
        Self {
            machine,
            plug,
            served: false,
        }
    }

    /// The same for a machine that a server runs in real time.
    #[must_use]
    pub fn served(self) -> Self {
        Self {
            served: true,
            ..self
        }
    }

    /// Does or measures something; the text says what this machine does not have.
    ///
    /// # Errors
    /// The instruction does not fit the machine, or the machine has ended.
    pub fn carry_out(&self, instruction: Instruction) -> Result<Option<i64>, String> {
        let ended = |why: BenchError| why.to_string();
        match (&self.machine, instruction) {
            (
                Machine::Rig(bench),
                Instruction::Do(Act {
                    part: Part::Cable,
                    on,
                }),
            ) => self.cable(bench, on).map_err(ended)?,
            (
                Machine::Capsule(bench),
                Instruction::Do(Act {
                    part: Part::Cable,
                    on,
                }),
            ) => self.cable(bench, on).map_err(ended)?,
            (
                Machine::Capsule(bench),
                Instruction::Do(Act {
                    part: Part::Rotor,
                    on,
                }),
            ) => {
                let hold = bench.visit(move |visit| {
                    visit.board().capsule.plant_mut().hold(on);
                });
                hold.map_err(ended)?;
            }
            (Machine::Rig(bench), Instruction::Do(act)) if act.part != Part::Rotor => {
                do_at_rig(bench, act).map_err(ended)?;
            }
            (Machine::Rig(bench), Instruction::Read(Reading::Carriage)) => {
                let um = bench.visit(|visit| visit.board().rig.carriage_um());
                return um.map(Some).map_err(ended);
            }
            (Machine::Rig(bench), Instruction::Read(Reading::EnableInReset)) => {
                let mv = bench.visit(|visit| {
                    visit.reset();
                    visit.board().rig.enable_undriven_mv()
                });
                return mv.map(|mv| Some(mv.into())).map_err(ended);
            }
            (Machine::Capsule(bench), Instruction::Read(Reading::Battery)) => {
                let mv = bench.visit(|visit| visit.board().capsule.battery_terminal_mv());
                return mv.map(|mv| Some(mv.round() as i64)).map_err(ended);
            }
            (_, instruction) => return Err(format!("this machine cannot `{instruction}`")),
        }
        Ok(None)
    }

    fn cable<W: Wiring>(&self, bench: &Bench<W>, plugged: bool) -> Result<(), BenchError> {
        if !plugged {
            self.plug.set(false);
            return Ok(());
        }
        if self.served {
            std::thread::sleep(Duration::from_micros(PULLED_US));
        } else {
            bench.advance_us(PULLED_US)?;
            let mut cable = bench.cable();
            // The cable was out, so drop the bytes that the machine sent meanwhile.
            let mut lost = [0; 256];
            while cable.take_received(&mut lost) > 0 {}
        }
        self.plug.set(true);
        Ok(())
    }
}

fn do_at_rig(bench: &Bench<RigBoard>, Act { part, on }: Act) -> Result<(), BenchError> {
    bench.visit(move |visit| {
        let now_ns = visit.now_ns();
        let rig = &mut visit.board().rig;
        let action = match part {
            Part::HomeFlag => Action::Actuate(Switch::Home, on),
            Part::FarLimit => Action::Actuate(Switch::Far, on),
            Part::EStop => Action::EStop(on),
            Part::HomeEnd => Action::Loop(LoopContact::HomeEnd, on),
            Part::FarEnd => Action::Loop(LoopContact::FarEnd, on),
            Part::Jumper => Action::ReadBack(Fault::Whole(on)),
            Part::Supply => Action::Supply(on),
            Part::Carriage => Action::Place(rig.middle()),
            Part::Cable | Part::Rotor => return,
        };
        rig.act(action, now_ns);
    })
}

impl Operator for Fixture {
    fn act(&mut self, act: Act, _: bool, say: &mut Say<'_>, _: &mut Watch<'_>) -> Result<(), Halt> {
        say(&format!("  fixture: {}", Instruction::Do(act)));
        self.carry_out(Instruction::Do(act))
            .map(|_| ())
            .map_err(Halt::NotShown)
    }

    fn read(&mut self, reading: Reading, say: &mut Say<'_>) -> Result<i64, Halt> {
        say(&format!("  fixture: {}", Instruction::Read(reading)));
        match self.carry_out(Instruction::Read(reading)) {
            Ok(Some(value)) => Ok(value),
            Ok(None) => Err(Halt::NotShown("nothing was measured".to_owned())),
            Err(why) => Err(Halt::NotShown(why)),
        }
    }
}

/// Answers a client until it is gone.
pub(crate) fn converse(stream: &TcpStream, fixture: &Fixture) -> std::io::Result<()> {
    let mut out = stream;
    for line in BufReader::new(stream).lines() {
        let answer = match line?
            .parse()
            .and_then(|instruction| fixture.carry_out(instruction))
        {
            Ok(None) => "done".to_owned(),
            Ok(Some(value)) => format!("value {value}"),
            Err(why) => format!("error {}", why.replace('\n', " ")),
        };
        writeln!(out, "{answer}")?;
    }
    Ok(())
}
