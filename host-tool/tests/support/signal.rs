//! Signals to other processes, without a program that a small machine may not have.

pub use rustix::process::Signal;
use rustix::process::{Pid, kill_process};

/// Sends `signal` to the process `pid`.
pub fn kill(signal: Signal, pid: u32) {
    let pid = pid.try_into().ok().and_then(Pid::from_raw);
    kill_process(pid.expect("a process"), signal).expect("it is ours");
}
