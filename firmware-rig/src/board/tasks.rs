//! The tasks. Each waits at one place. The README of this package lists their priorities.

use super::{
    channels::{
        COMMANDED, DMA_ERRORS, ENABLE_HIGH_AT_START, GLITCHES, HOME_FLAG_OPEN, INTERVALS,
        LOST_CAPTURES, MOTION_WAKE, MotionMailbox, NOTICES, ORDERS, SNAPSHOT, STOP, STROKE,
        SWITCH_FILTER_US, TIMER_RESETS, wake_after_cut,
    },
    pins,
    step_generator::{self, StepGenerator},
    switches,
};
use core::sync::atomic::Ordering;
use device::{
    chip::{
        channels::{BAD_FRAMES, REPLIES, REQUESTS, UART_ERRORS, UNSENT_FRAMES},
        clock,
        flash::Sectors,
        image, link,
        surroundings::OnChip,
        telemetry,
        watchdog::{self, check_in},
    },
    retained::Retained,
    service::Answers,
    supervision::Client,
};
use embassy_futures::select::{Either3, select3};
use embassy_stm32::{
    gpio::Output,
    mode::Async,
    peripherals,
    usart::{RingBufferedUartRx, UartTx},
    wdg::IndependentWatchdog,
};
use embassy_time::{Duration, Instant, Ticker, with_timeout};
use firmware_rig::{
    control::{self, Control, ROUND_US},
    execution::{MotionTask, Order},
    machine::Now,
};
use motion::units::StepPosition;
use protocol::{
    rig::{RigHardware, RigHealth, RigInputs, RigState, RigTelemetry},
    system::{Identity, ResetCause, Urgent},
    table::Telemetry,
};

/// Highest task priority. Runs every 100 ms when idle; in motion whenever half of the ring has played, which takes 4
/// ms, or less above 32 kHz if the periods differ; every 0.1 ms before a turn or the end.
#[embassy_executor::task]
pub async fn motion(mut generator: StepGenerator) -> ! {
    let mut motion = MotionTask::default();
    loop {
        check_in(Client::Motion);
        let within_us = motion.pace().within_us().min(switches::poll_within_us());
        let wait = Duration::from_micros(within_us.into());
        // Run a round after a time-out as well as after a wake-up.
        let _ = with_timeout(wait, MOTION_WAKE.wait()).await;
        switches::unmask_due_lines();
        motion.round(&mut generator, &mut MotionMailbox);
    }
}

/// Every 10 ms and at every notice or request.
#[embassy_executor::task]
pub async fn control(sectors: Sectors, previous: Retained, cause: ResetCause) -> ! {
    let mut control = Control::new(Rig, sectors, previous, cause, image::hash());
    let mut ticker = Ticker::every(Duration::from_micros(ROUND_US));
    loop {
        check_in(Client::Control);
        SNAPSHOT.lock(|snapshot| snapshot.set(Some(control.snapshot())));
        match select3(NOTICES.receive(), REQUESTS.wait(), ticker.next()).await {
            Either3::First(event) => control.event(event),
            Either3::Second(inbound) => REPLIES.signal(control.answer(inbound)),
            Either3::Third(()) => {
                switches::unmask_due_lines();
                control.tick();
            }
        }
    }
}

/// The rest of the rig, as control sees it.
pub struct Rig;

impl OnChip for Rig {}

impl control::Rig for Rig {
    fn now(&self) -> Now {
        let glitches = GLITCHES.each_ref().map(|switch| switch.get().count);
        Now {
            time_us: Instant::now().as_micros(),
            position: step_generator::counted(),
            // Use the filtered home flag: one glitch must not choose how homing begins.
            inputs: RigInputs {
                home_flag: HOME_FLAG_OPEN.load(Ordering::Relaxed),
                ..pins::inputs()
            },
            glitches: glitches[0].wrapping_add(glitches[1]),
        }
    }

    fn button_is_down(&self) -> bool {
        pins::button_is_down()
    }

    fn stroke(&self) -> u32 {
        STROKE.load(Ordering::Relaxed)
    }

    fn health(&self) -> RigHealth {
        let (stack_size, stack_used) = image::stack();
        RigHealth {
            home_flag: GLITCHES[0].get(),
            far_limit: GLITCHES[1].get(),
            uart_errors: UART_ERRORS.load(Ordering::Relaxed),
            bad_frames: BAD_FRAMES.load(Ordering::Relaxed),
            unsent_frames: UNSENT_FRAMES.load(Ordering::Relaxed),
            stack_used,
            stack_size,
            underruns: 0,
            control_late_us: 0,
            image_hash: 0,
        }
    }

    fn hardware(&self) -> RigHardware {
        let [exact, one, two, more] = INTERVALS.get();
        RigHardware {
            intervals_exact: exact,
            intervals_1_tick: one,
            intervals_2_ticks: two,
            intervals_more: more,
            lost_captures: LOST_CAPTURES.load(Ordering::Relaxed),
            dma_errors: DMA_ERRORS.load(Ordering::Relaxed),
            timer_resets: TIMER_RESETS.load(Ordering::Relaxed),
            enable_high_at_start: ENABLE_HIGH_AT_START.load(Ordering::Relaxed),
        }
    }

    fn start(&mut self, order: Order) {
        ORDERS.signal(order);
        MOTION_WAKE.signal(());
    }

    fn stop_path(&mut self) {
        STOP.store(true, Ordering::Release);
        MOTION_WAKE.signal(());
    }

    fn cut(&mut self) {
        pins::cut_pulses();
        wake_after_cut();
    }

    fn rearm_loop(&mut self) {
        step_generator::rearm_loop();
    }

    fn set_position(&mut self, position: StepPosition) {
        step_generator::set_counted(position);
        // Publish the position here: if the carriage is at 0 already, no path follows that would.
        COMMANDED.store(position.0, Ordering::Relaxed);
    }

    fn set_switch_filter(&mut self, filter_us: u32) {
        SWITCH_FILTER_US.store(filter_us, Ordering::Relaxed);
    }

    fn clock_has_come(&self) -> bool {
        clock::external_clock_has_come()
    }

    fn restart(&mut self, previous: &Retained, cause: ResetCause) {
        defmt::info!("the 8 MHz clock has come");
        clock::restart(previous, cause)
    }
}

/// Sends what the other tasks have queued.
#[embassy_executor::task]
pub async fn transmit(uart: UartTx<'static, Async>) -> ! {
    link::transmit(uart).await
}

/// Reads the port; at least every 100 ms.
#[embassy_executor::task]
pub async fn receive(uart: RingBufferedUartRx<'static>, identity: Identity) -> ! {
    // Cut the pulses at once; control latches the fault later.
    let at_once = |urgent| {
        if urgent == Urgent::EStop {
            pins::cut_pulses();
            wake_after_cut();
        }
    };
    link::receive(uart, identity, at_once).await
}

/// Lowest priority, as often as the host asked for.
#[embassy_executor::task]
pub async fn telemetry() -> ! {
    let mut last = (Instant::now(), step_generator::travelled());
    telemetry::run(|now| {
        let (before, from) = last;
        let to = step_generator::travelled();
        last = (now, to);
        let snapshot = SNAPSHOT.lock(|snapshot| snapshot.get())?;
        let elapsed_us = now.saturating_duration_since(before).as_micros();
        Some(Telemetry::Rig(RigTelemetry {
            time_us: now.as_micros(),
            state: snapshot.state,
            position_steps: step_generator::counted().0,
            commanded_steps: COMMANDED.load(Ordering::Relaxed),
            speed_um_s: snapshot.axis.mean_speed_um_s(to.since(from), elapsed_us),
            stroke: STROKE.load(Ordering::Relaxed),
            residual_steps: snapshot.residual_steps,
            inputs: pins::inputs(),
        }))
    })
    .await
}

/// Every 150 ms; also shows the state on the LED.
#[embassy_executor::task]
pub async fn watchdog(
    watchdog: IndependentWatchdog<'static, peripherals::IWDG>,
    mut led: Output<'static>,
) -> ! {
    let mut round = 0_u8;
    let show_state = || {
        round = (round + 1) % 8;
        let state = SNAPSHOT.lock(|snapshot| snapshot.get().map(|snapshot| snapshot.state));
        led.set_level((state.map_or(0, pattern) >> round & 1 == 1).into());
    };
    watchdog::run(watchdog, show_state).await
}

/// One bit per round, 1 = lit; eight rounds are 1.2 s.
fn pattern(state: RigState) -> u8 {
    match state {
        RigState::Ready => 0b1111_1111,
        RigState::Unhomed => 0b0000_1111,
        RigState::Held => 0b0000_0101,
        RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping => 0b0111_1111,
        RigState::Faulted => 0b0101_0101,
    }
}
