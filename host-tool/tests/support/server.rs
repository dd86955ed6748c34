//! `retrograde serve` as a process beside a bench.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Stdio};
use std::thread;

use super::bench::Bench;

/// A process that is killed when this is dropped.
pub struct Killed(pub Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts the server with more arguments, and reads its address and token.
pub fn start(bench: &Bench, more: &[&str]) -> (Killed, String, String) {
    start_saying(bench, more, Stdio::inherit())
}

/// The same with another place for what it says on standard error.
pub fn start_saying(bench: &Bench, more: &[&str], stderr: Stdio) -> (Killed, String, String) {
    let args = [&["serve", "--listen", "127.0.0.1:0"], more].concat();
    start_of(bench.command(&args).stderr(stderr))
}

/// The same by a command of its own.
pub fn start_of(command: &mut Command) -> (Killed, String, String) {
    let mut child = command.spawn().expect("starts");
    let mut said = BufReader::new(child.stdout.take().expect("piped"));
    let mut url = String::new();
    while !url.contains("#token=") {
        url.clear();
        assert_ne!(said.read_line(&mut url).expect("text"), 0, "no address");
    }
    thread::spawn(move || said.read_to_end(&mut vec![]));
    let (at, token) = url.trim().split_once("/#token=").expect("an address");
    let at = at.trim_start_matches("http://");
    (Killed(child), at.to_owned(), token.to_owned())
}
