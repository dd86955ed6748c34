//! Sends signals to other processes, without an external program that a small machine may lack.

pub use rustix::process::Signal;
use rustix::process::{Pid, kill_process};

/// Sends `signal` to the process `pid`.
pub fn kill(signal: Signal, pid: u32) {
    let pid = pid.try_into().ok().and_then(Pid::from_raw);
    kill_process(pid.expect("a process"), signal).expect("it is ours");
}
