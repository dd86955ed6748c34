//! The peers' image: waits for an order of the bench, carries it out, and stores each interval where the bench looks.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![allow(
    unsafe_code,
    reason = "a symbol that the bench can find needs its name"
)]

#[cfg(target_os = "none")]
mod image {
    use core::panic::PanicInfo;
    use core::sync::atomic::{AtomicU32, Ordering::Relaxed};

    // Brings the vectors and the critical section of the core.
    use cortex_m as _;
    use cortex_m_rt::entry;
    use step_peers::ours::{Batches, Single};
    use step_peers::{Method, Move, austin, ramp_maker, segments, stepgen};

    /// The words that the bench writes and looks at; `virtual-bench/src/peers/follow.rs` has their places.
    #[repr(C)]
    pub struct Mailbox {
        /// Ticks to the next step.
        single: AtomicU32,
        /// Ticks to each of the next equal steps, and behind it their number.
        interval: AtomicU32,
        equal: AtomicU32,
        state: AtomicU32,
        /// The method; 0 until the bench has written the rest.
        method: AtomicU32,
        steps: AtomicU32,
        duration_ticks: AtomicU32,
        ramp_ticks: AtomicU32,
    }

    const READY: u32 = 1;
    const DONE: u32 = 2;
    const REFUSED: u32 = 3;
    const PANICKED: u32 = 4;

    // SAFETY: no other symbol has this name.
    #[unsafe(no_mangle)]
    pub static MAILBOX: Mailbox = Mailbox {
        single: AtomicU32::new(0),
        interval: AtomicU32::new(0),
        equal: AtomicU32::new(0),
        state: AtomicU32::new(0),
        method: AtomicU32::new(0),
        steps: AtomicU32::new(0),
        duration_ticks: AtomicU32::new(0),
        ramp_ticks: AtomicU32::new(0),
    };

    #[inline(always)]
    fn one_by_one<M: Method>(order: &Move) -> u32 {
        let Some(mut method) = M::new(order) else {
            return REFUSED;
        };
        while let Some(interval) = method.next_interval() {
            MAILBOX.single.store(interval, Relaxed);
        }
        DONE
    }

    fn in_batches(order: &Move) -> u32 {
        let Some(mut batches) = Batches::new(order) else {
            return REFUSED;
        };
        loop {
            let groups = batches.next_groups();
            if groups.is_empty() {
                return DONE;
            }
            for group in groups {
                MAILBOX.interval.store(group.interval, Relaxed);
                MAILBOX.equal.store(group.steps, Relaxed);
            }
        }
    }

    #[entry]
    fn main() -> ! {
        MAILBOX.state.store(READY, Relaxed);
        let method = loop {
            let method = MAILBOX.method.load(Relaxed);
            if method != 0 {
                break method;
            }
        };
        let order = Move {
            steps: MAILBOX.steps.load(Relaxed),
            duration_ticks: MAILBOX.duration_ticks.load(Relaxed),
            ramp_ticks: MAILBOX.ramp_ticks.load(Relaxed),
        };
        let ended = match method {
            1 => in_batches(&order),
            2 => one_by_one::<Single>(&order),
            3 => one_by_one::<ramp_maker::Fixed>(&order),
            4 => one_by_one::<ramp_maker::Float>(&order),
            5 => one_by_one::<stepgen::Delays>(&order),
            6 => one_by_one::<austin::Delays>(&order),
            7 => one_by_one::<segments::Intervals>(&order),
            _ => REFUSED,
        };
        MAILBOX.state.store(ended, Relaxed);
        halt()
    }

    /// Waits for the bench to end the run.
    fn halt() -> ! {
        loop {
            cortex_m::asm::nop();
        }
    }

    #[panic_handler]
    fn panicked(_: &PanicInfo<'_>) -> ! {
        MAILBOX.state.store(PANICKED, Relaxed);
        halt()
    }
}

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("This is an image for the virtual bench: `cargo xtask bench` builds and runs it.");
}
