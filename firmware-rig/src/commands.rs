//! Requests to replies: the only place where the protocol meets motion and the state machine.

use crate::{
    machine::{Actions, Command, Machine},
    settings::{Settings, Values},
};
use motion::{
    axis::{Axis, Direction},
    run::{MAX_CYCLES, RunError, RunPlan, RunRequest, Timing},
    trapezoid::StrokeProfile,
    units::{Micrometres, TICK_HZ},
};
use protocol::{
    error::{Field, Refusal},
    events::EventRing,
    rig::{
        self, LinkLossPolicy, RigFault, RigHealth, RigInputs, RigStatus, RunAccepted, RunTiming,
        Stroke,
    },
    settings::{GetSetting, MAX_NAME, Name, Setting, SettingKey},
    system::{Done, LastWords, SetTelemetry},
    table::{Reply, Request, Response},
};

/// What a request may need to know.
pub struct Context<'a> {
    /// Device time.
    pub now_us: u64,
    /// Position by the read-back counter.
    pub position: i32,
    /// Inputs.
    pub inputs: RigInputs,
    /// Stroke in progress.
    pub stroke: u32,
    /// Events so far.
    pub ring: &'a EventRing,
    /// Text of the last panic or processor fault.
    pub last_words: &'a str,
    /// Settings, value by value.
    pub values: &'a Values,
    /// The rig's name.
    pub name: &'a str,
    /// Counters, when they are asked for.
    pub health: Option<RigHealth>,
}

/// What the caller has to do besides the machine's actions.
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing.
    None,
    /// Change the telemetry interval; 0 = off.
    Telemetry {
        /// In ms.
        period_ms: u16,
    },
    /// Record that a fault was acknowledged.
    Acknowledged,
    /// Write this to flash; then it is in force.
    Store(Change),
}

/// A change of the settings.
// One exists at a time, on the stack.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Change {
    /// One value.
    Value {
        /// The value as accepted.
        setting: Setting,
        /// All values.
        values: Values,
        /// What they give.
        settings: Settings,
    },
    /// The rig's name.
    Name(heapless::String<MAX_NAME>),
    /// The defaults of all values and of the name.
    Reset,
}

/// Carries out one request.
pub fn execute(
    request: Request,
    machine: &mut Machine,
    context: &Context<'_>,
    actions: &mut Actions,
) -> (Reply, Effect) {
    match respond(request, machine, context, actions) {
        Ok((response, effect)) => (Reply::Accepted(response), effect),
        Err(refusal) => (Reply::Refused(refusal), Effect::None),
    }
}

fn respond(
    request: Request,
    machine: &mut Machine,
    context: &Context<'_>,
    actions: &mut Actions,
) -> Result<(Response, Effect), Refusal> {
    let mut command = |machine: &mut Machine, command| {
        machine.command(
            context.now_us,
            command,
            context.position,
            context.inputs,
            actions,
        )
    };
    let response = match request {
        Request::KeepAlive(_) => Response::KeepAlive(Done),
        Request::GetLastWords(_) => Response::GetLastWords(LastWords {
            text: context.last_words.try_into().unwrap_or_default(),
        }),
        Request::SetTelemetry(SetTelemetry { period_ms }) => {
            if period_ms != 0 {
                in_range(Field::PeriodMs, period_ms, 5, 1000)?;
            }
            let response = Response::SetTelemetry(SetTelemetry { period_ms });
            return Ok((response, Effect::Telemetry { period_ms }));
        }
        Request::GetEvents(get) => Response::GetEvents(context.ring.since(get.from)),
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
            command(
                machine,
                Command::Run {
                    plan,
                    link_loss: requested.link_loss,
                },
            )?;
            Response::Run(accepted(machine, requested, &plan))
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
        Request::Jog(rig::Jog { sense, speed_um_s }) => {
            let direction = match sense {
                rig::Direction::Away => Direction::Away,
                rig::Direction::Home => Direction::Home,
            };
            let speed = machine.settings().speed(speed_um_s)?;
            command(machine, Command::Jog { direction, speed })?;
            Response::Jog(Done)
        }
        Request::MoveTo(requested) => {
            let settings = machine.settings();
            let axis = &settings.axis;
            let (position_um, max) = (requested.position_um, axis.stroke().0);
            in_range(Field::PositionUm, position_um, 0, max.into())?;
            let speed = settings.speed(requested.speed_um_s)?;
            let target = axis
                .position_um(Micrometres(position_um))
                .map_err(|_| Refusal::AlreadyThere)?;
            command(machine, Command::MoveTo { target, speed })?;
            // The same that the machine has just ordered.
            let settings = machine.settings();
            let from_steps = context.position;
            let to_steps = i32::try_from(target.steps().0).unwrap_or(i32::MAX);
            let profile = settings.move_profile(to_steps - from_steps, speed)?;
            Response::MoveTo(rig::MoveAccepted {
                from_steps,
                to_steps,
                stroke: stroke(&settings.axis, &profile),
            })
        }
        Request::GetSetting(GetSetting { key }) => Response::GetSetting(Setting {
            key,
            value: context.values.get(key),
        }),
        Request::SetSetting(setting) => {
            machine.may_change_settings()?;
            let (values, settings) = context.values.with(setting.key, setting.value)?;
            let change = Change::Value {
                setting,
                values,
                settings,
            };
            return Ok((Response::SetSetting(setting), Effect::Store(change)));
        }
        Request::FactoryReset(_) => {
            machine.may_change_settings()?;
            return Ok((Response::FactoryReset(Done), Effect::Store(Change::Reset)));
        }
        Request::GetName(_) => Response::GetName(Name {
            name: context.name.try_into().unwrap_or_default(),
        }),
        Request::SetName(name) => {
            machine.may_change_settings()?;
            let change = Change::Name(name.name.clone());
            return Ok((Response::SetName(name), Effect::Store(change)));
        }
        Request::GetRigHealth(_) => {
            Response::GetRigHealth(context.health.ok_or(Refusal::WrongDevice)?)
        }
        Request::Hello(_)
        | Request::GetCapsuleStatus(_)
        | Request::Reference(_)
        | Request::Fold(_)
        | Request::Unfold(_)
        | Request::GetActuationRecord(_) => return Err(Refusal::WrongDevice),
    };
    Ok((response, Effect::None))
}

/// The start button was pressed: what [`Command::Button`] says, with the run that the settings describe.
///
/// # Errors
/// The refusal; nothing moves.
pub fn press_button(
    machine: &mut Machine,
    values: &Values,
    now_us: u64,
    position: i32,
    inputs: RigInputs,
    actions: &mut Actions,
) -> Result<(), Refusal> {
    let run = rig::Run {
        // The range of the setting fits.
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
    machine.command(now_us, Command::Button(plan), position, inputs, actions)
}

fn in_range(field: Field, requested: impl Into<u64>, min: u64, max: u64) -> Result<(), Refusal> {
    let requested = requested.into();
    if (min..=max).contains(&requested) {
        Ok(())
    } else {
        Err(Refusal::OutOfRange {
            field,
            requested,
            min,
            max,
        })
    }
}

fn status(machine: &Machine, context: &Context<'_>) -> RigStatus {
    let axis = &machine.settings().axis;
    let running = machine.state() == rig::RigState::Running;
    RigStatus {
        time_us: context.now_us,
        state: machine.state(),
        fault: machine.fault(),
        homed: machine.homed(),
        position_steps: context.position,
        position_um: machine.settings().um(context.position),
        stroke_um: axis.stroke().0,
        steps_per_rev: axis.steps_per_rev(),
        lead_um: axis.lead().0,
        inputs: context.inputs,
        run: machine.record().run,
        stroke: if running {
            context.stroke
        } else {
            machine.record().strokes
        },
        strokes: machine.strokes(),
        elapsed_us: if running {
            context.now_us.saturating_sub(machine.started_us())
        } else {
            0
        },
        needs_acknowledge: matches!(machine.fault(), Some(RigFault::Watchdog | RigFault::Panic)),
    }
}

/// Solves a run exactly, or says why not.
fn solve(run: &rig::Run, machine: &Machine) -> Result<RunPlan, Refusal> {
    let settings = machine.settings();
    let timing = match run.timing {
        RunTiming::Total {
            total_us,
            accel_um_s2,
        } => Timing::Total {
            total_us,
            accel_um_s2,
        },
        RunTiming::Speeds {
            forward_um_s,
            return_um_s,
            accel_um_s2,
        } => Timing::Speeds {
            forward_um_s,
            return_um_s,
            accel_um_s2,
        },
    };
    let request = RunRequest {
        cycles: run.cycles,
        stroke_um: run.stroke_um,
        timing,
        far_dwell_us: run.far_dwell_us,
        home_dwell_us: run.home_dwell_us,
        start_delay_us: run.start_delay_us,
    };
    RunPlan::solve(&settings.axis, &settings.limits, &request)
        .map_err(|error| refusal(&error, run, settings))
}

fn accepted(machine: &Machine, requested: rig::Run, plan: &RunPlan) -> RunAccepted {
    let axis = &machine.settings().axis;
    RunAccepted {
        run: machine.record().run,
        requested,
        forward: stroke(axis, plan.forward()),
        back: stroke(axis, plan.return_()),
        total_ticks: plan.total().0,
        edges: plan.edges(),
        plan_hash: plan.hash(),
    }
}

fn stroke(axis: &Axis, profile: &StrokeProfile) -> Stroke {
    Stroke {
        steps: profile.steps().0,
        duration_ticks: profile.duration().0,
        ramp_ticks: profile.ramp().0,
        peak_um_s: profile.peak_um_s(axis),
        accel_um_s2: profile.accel_um_s2(axis),
    }
}

/// The wire's words for what the solver found.
fn refusal(error: &RunError, run: &rig::Run, settings: &Settings) -> Refusal {
    let (axis, limits) = (&settings.axis, &settings.limits);
    let out_of_range = |field, requested: u64, min, max| Refusal::OutOfRange {
        field,
        requested,
        min,
        max,
    };
    match *error {
        RunError::Cycles { cycles } => {
            out_of_range(Field::Cycles, cycles.into(), 1, MAX_CYCLES.into())
        }
        RunError::Stroke { .. } | RunError::StrokeBelowOneStep { .. } => {
            // The shortest stroke is one step, in whole micrometres.
            let min = u64::from(axis.lead().0).div_ceil(u64::from(axis.steps_per_rev()));
            out_of_range(
                Field::StrokeUm,
                run.stroke_um.into(),
                min,
                axis.stroke().0.into(),
            )
        }
        RunError::AccelerationAboveLimit {
            accel_um_s2,
            max_um_s2,
        } => out_of_range(Field::AccelUmS2, accel_um_s2.into(), 1, max_um_s2.into()),
        RunError::SpeedAboveLimit {
            speed_um_s,
            max_um_s,
        } => Refusal::SpeedLimit {
            needed_um_s: speed_um_s.into(),
            max_um_s: max_um_s.into(),
        },
        RunError::PeakAboveLimit {
            peak_um_s,
            max_um_s,
            ..
        } => Refusal::SpeedLimit {
            needed_um_s: peak_um_s.into(),
            max_um_s: max_um_s.into(),
        },
        RunError::TotalTooShort {
            minimal_total_us,
            minimal_accel_um_s2,
        } => Refusal::TooFast {
            requested_us: match run.timing {
                RunTiming::Total { total_us, .. } => total_us,
                RunTiming::Speeds { .. } => 0,
            },
            min_us: minimal_total_us,
            // None: dwells use up all the time, and no acceleration would do.
            min_accel_um_s2: minimal_accel_um_s2.unwrap_or(u64::MAX),
        },
        RunError::StepRate {
            interval,
            min_interval,
            ..
        } => Refusal::StepRateLimit {
            needed_hz: TICK_HZ / interval.0.max(1),
            max_hz: TICK_HZ / min_interval.0.max(1),
        },
        RunError::Turnaround {
            before,
            minimal_dwell_us,
            ..
        } => {
            let (field, requested) = match before {
                Direction::Home => (Field::FarDwellUs, run.far_dwell_us),
                Direction::Away => (Field::HomeDwellUs, run.home_dwell_us),
            };
            out_of_range(field, requested.into(), minimal_dwell_us, u32::MAX.into())
        }
        // Zero, for nothing else is no speed or no acceleration.
        RunError::Rate(_) => match run.timing {
            RunTiming::Speeds {
                forward_um_s: 0, ..
            } => out_of_range(Field::ForwardUmS, 0, 1, limits.max_speed_um_s.into()),
            RunTiming::Speeds { return_um_s: 0, .. } => {
                out_of_range(Field::ReturnUmS, 0, 1, limits.max_speed_um_s.into())
            }
            _ => out_of_range(Field::AccelUmS2, 0, 1, limits.max_accel_um_s2.into()),
        },
        RunError::TooLong | RunError::Profile(_) => Refusal::TooSlow,
    }
}
