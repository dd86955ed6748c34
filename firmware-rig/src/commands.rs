//! Executes requests: turns them into commands of the state machine, and its answers into responses.

use crate::{
    machine::{Actions, Command, Event, Machine, Now},
    settings::Settings,
};
use device::{
    common::{About, Effect, Executed},
    settings::Values,
};
use motion::{
    axis::{Position, Speed},
    run::RunPlan,
    units::Micrometres,
};
use protocol::{
    error::{Field, Refusal},
    rig::{self, LinkLossPolicy, RigFault, RigHardware, RigHealth, RigStatus, RunTiming},
    settings::SettingKey,
    system::Done,
    table::{Request, Response},
};

/// Inputs for answering a request.
#[derive(Debug)]
pub struct Context<'a> {
    /// Time, position and inputs.
    pub now: Now,
    pub stroke: u32,
    /// Data for the requests that both machines answer alike.
    pub about: About<'a>,
    /// Counters, if the request needs them.
    pub health: Option<RigHealth>,
    /// Findings about the hardware, if the request needs them.
    pub hardware: Option<RigHardware>,
}

/// Carries out one request.
pub fn execute(
    request: Request,
    machine: &mut Machine,
    context: &Context<'_>,
) -> Executed<Actions, Settings> {
    let mut actions = Actions::default();
    let answer = respond(request, machine, context, &mut actions);
    Executed::new(answer, actions)
}

fn respond(
    request: Request,
    machine: &mut Machine,
    context: &Context<'_>,
    actions: &mut Actions,
) -> Result<(Response, Effect<Settings>), Refusal> {
    let may_change = || machine.may_change_settings();
    if let Some(answer) = (context.about).answer(&request, may_change, Settings::new)? {
        return Ok(answer);
    }
    let mut command = |machine: &mut Machine, command| {
        machine.handle(&context.now, Event::Command(&command), actions);
        actions.refusal.map_or(Ok(()), Err)
    };
    let response = match request {
        Request::Acknowledge(_) => {
            command(machine, Command::Acknowledge)?;
            return Ok((Response::Acknowledge(Done), Effect::Acknowledged));
        }
        Request::GetRigStatus(_) => Response::GetRigStatus(status(machine, context)),
        Request::Home(_) => {
            command(machine, Command::Home)?;
            let settings = machine.settings();
            Response::Home(rig::HomeAccepted {
                seek_um_s: settings.seek_um_s,
                locate_um_s: settings.locate_um_s,
                max_travel_um: settings.axis.stroke().0 + settings.overtravel_um,
            })
        }
        Request::Run(requested) => {
            let plan = solve(&requested, machine)?;
            let link_loss = requested.link_loss;
            command(machine, Command::Run { plan, link_loss })?;
            let (run, axis) = (machine.record().run, &machine.settings().axis);
            Response::Run(planning::accepted(run, requested, &plan, axis))
        }
        Request::GetRunRecord(_) => Response::GetRunRecord(*machine.record()),
        Request::Hold(_) => {
            command(machine, Command::Hold)?;
            Response::Hold(Done)
        }
        Request::Resume(_) => {
            command(machine, Command::Resume)?;
            Response::Resume(Done)
        }
        Request::Jog(jog) => {
            let direction = planning::direction(jog.direction);
            let speed = machine.settings().speed(jog.speed_um_s)?;
            command(machine, Command::Jog { direction, speed })?;
            Response::Jog(Done)
        }
        Request::MoveTo(requested) => {
            let (target, speed) = destination(&requested, machine.settings())?;
            command(machine, Command::MoveTo { target, speed })?;
            // Calculate the profile again for the reply: the machine has just started the same one.
            let settings = machine.settings();
            let (from, to) = (context.now.position, target.signed());
            let profile = settings.move_profile(from.distance_to(to), speed)?;
            Response::MoveTo(rig::MoveAccepted {
                from_steps: from.0,
                to_steps: to.0,
                stroke: planning::stroke(&profile, &settings.axis),
            })
        }
        Request::GetRigHealth(_) => {
            Response::GetRigHealth(context.health.ok_or(Refusal::WrongDevice)?)
        }
        Request::GetRigHardware(_) => {
            Response::GetRigHardware(context.hardware.ok_or(Refusal::WrongDevice)?)
        }
        // The capsule's requests. The common ones were answered above, and a Hello by the session.
        _ => return Err(Refusal::WrongDevice),
    };
    Ok((response, Effect::None))
}

/// Where a move ends, and how fast it may go.
fn destination(requested: &rig::MoveTo, settings: &Settings) -> Result<(Position, Speed), Refusal> {
    let target = (settings.axis).position_um(Micrometres(requested.position_um));
    let target = target.ok_or(Refusal::OutOfRange {
        field: Field::PositionUm,
        requested: requested.position_um.into(),
        min: 0,
        max: settings.axis.stroke().0.into(),
    })?;
    Ok((target, settings.speed(requested.speed_um_s)?))
}

/// Handles a press of the start button: [`Command::Button`], with the run that the settings describe.
pub fn press_button(machine: &mut Machine, values: &Values, now: &Now) -> Actions {
    let run = rig::Run {
        // The setting's range fits into 16 bits.
        cycles: values.get(SettingKey::ButtonCycles) as u16,
        stroke_um: values.get(SettingKey::ButtonStrokeUm),
        timing: RunTiming::Total {
            total_us: u64::from(values.get(SettingKey::ButtonTotalMs)) * 1_000,
            accel_um_s2: values.get(SettingKey::ButtonAccelUmS2),
        },
        far_dwell_us: 0,
        home_dwell_us: 0,
        start_delay_us: 0,
        link_loss: LinkLossPolicy::Finish,
    };
    let plan = solve(&run, machine).ok();
    machine.step(now, Event::Command(&Command::Button(plan)))
}

fn status(machine: &Machine, context: &Context<'_>) -> RigStatus {
    let axis = &machine.settings().axis;
    let running = machine.state() == rig::RigState::Running;
    RigStatus {
        time_us: context.now.time_us,
        state: machine.state(),
        fault: machine.fault(),
        homed: machine.homed(),
        position_steps: context.now.position.0,
        position_um: axis.um_from_home(context.now.position),
        stroke_um: axis.stroke().0,
        steps_per_rev: axis.steps_per_rev(),
        lead_um: axis.lead().0,
        inputs: context.now.inputs,
        run: machine.record().run,
        stroke: if running {
            context.stroke
        } else {
            machine.record().strokes
        },
        strokes: machine.strokes(),
        // A hold does not end the run.
        elapsed_us: if machine.record().outcome == rig::RunOutcome::Running {
            context.now.time_us.saturating_sub(machine.started_us())
        } else {
            0
        },
        needs_acknowledge: matches!(machine.fault(), Some(RigFault::Watchdog | RigFault::Panic)),
    }
}

/// Solves a run exactly, or refuses it with the reason.
fn solve(run: &rig::Run, machine: &Machine) -> Result<RunPlan, Refusal> {
    let Settings { axis, limits, .. } = machine.settings();
    planning::solve(run, axis, limits).map_err(|error| planning::refusal(&error, run, axis, limits))
}
