//! The rig's image. This file only wires: who runs at which priority is the table in this package's README.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![cfg_attr(target_os = "none", deny(unsafe_code))]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod channels;
#[cfg(target_os = "none")]
mod image;
#[cfg(target_os = "none")]
mod limits;
#[cfg(target_os = "none")]
mod panic;
#[cfg(target_os = "none")]
mod stepgen;
#[cfg(target_os = "none")]
mod storage;
#[cfg(target_os = "none")]
mod tasks;

#[cfg(target_os = "none")]
mod start {
    use crate::{board, channels, image, panic, stepgen::StepGen, storage::Store, tasks};
    use core::sync::atomic::Ordering;
    use defmt_rtt as _;
    use embassy_executor::{InterruptExecutor, Spawner};
    use embassy_stm32::{interrupt, pac};
    use protocol::{
        VERSION,
        rig::RigFault,
        system::{BuildProfile, DeviceKind, Identity, ResetCause, Revision},
        table::SCHEMA_KEY,
    };
    use static_cell::StaticCell;

    static MOTION_EXECUTOR: InterruptExecutor = InterruptExecutor::new();

    #[pac::interrupt]
    #[allow(unsafe_code)]
    unsafe fn SPI5() {
        // SAFETY: called from the interrupt that the executor was started with.
        unsafe { MOTION_EXECUTOR.on_interrupt() }
    }

    #[embassy_executor::main]
    async fn main(spawner: Spawner) {
        let panic::Left {
            boot_id,
            last_words,
            latched,
        } = panic::start();
        let board = board::init();
        let reset_cause = match (&last_words, board::reset_cause()) {
            (Some(_), ResetCause::Software) => ResetCause::Panic,
            (_, cause) => cause,
        };
        defmt::info!("rig, start {=u32}, {}", boot_id, reset_cause);
        let fault = match reset_cause {
            ResetCause::Panic => Some(RigFault::Panic),
            ResetCause::Watchdog => Some(RigFault::Watchdog),
            _ => latched,
        };
        channels::HOME_FLAG_OPEN.store(board::inputs().home_flag, Ordering::Relaxed);
        let identity = Identity {
            device: DeviceKind::Rig,
            protocol: VERSION,
            schema_key: SCHEMA_KEY,
            uid: board::uid(),
            revision: Revision {
                commit: revision(),
                dirty: env!("RETROGRADE_DIRTY").len() == 1,
            },
            profile: if cfg!(debug_assertions) {
                BuildProfile::Debug
            } else {
                BuildProfile::Firmware
            },
            boot_id,
            reset_cause,
            session: 0,
        };

        static RECEIVE_BUFFER: StaticCell<[u8; 512]> = StaticCell::new();
        let (transmitter, receiver) = board.uart.split();
        let receiver = receiver.into_ring_buffered(RECEIVE_BUFFER.init([0; 512]));

        let motion_spawner = MOTION_EXECUTOR.start(interrupt::SPI5);
        let start = tasks::control::Start {
            store: Store::new(board.sectors),
            fault,
            reset_cause,
            last_words: last_words.unwrap_or_default(),
            image_hash: image::hash(),
        };
        motion_spawner.spawn(defmt::unwrap!(tasks::motion::motion(StepGen::new())));
        spawner.spawn(defmt::unwrap!(tasks::control::control(start)));
        spawner.spawn(defmt::unwrap!(tasks::link::transmit(transmitter)));
        spawner.spawn(defmt::unwrap!(tasks::link::receive(receiver, identity)));
        spawner.spawn(defmt::unwrap!(tasks::telemetry::telemetry()));
        spawner.spawn(defmt::unwrap!(tasks::watchdog::watchdog(
            board.watchdog,
            board.led
        )));
    }

    /// The commit that `build.rs` found.
    fn revision() -> u32 {
        u32::from_str_radix(env!("RETROGRADE_COMMIT"), 16).unwrap_or(0)
    }
}

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!(
        "This is firmware: flash it with `cargo rig`, or run it on the virtual bench with `cargo xtask demo`."
    );
}
