//! Tests the side door with the image in real time: a run in one process, stops and windows from others, over a
//! pseudo-terminal.

use std::thread;
use std::time::{Duration, Instant};

use crate::processes::{DoorError, Rig, ends, judge, record, stood};
use crate::server::Server;

/// Default number of emergency stops.
pub const STOPS: u32 = 50;
/// Time limit for the exit of a process that has given up its line.
const LEAVING: Duration = Duration::from_secs(2);

/// Times emergency stops by a second process during a run with a crowd connected, then makes a run with windows. Prints
/// the measurements.
///
/// # Errors
/// [`DoorError`], also for a stop that came too late.
pub fn run(stops: u32, say: &mut dyn FnMut(String)) -> Result<(), DoorError> {
    let rig = Rig::start()?;
    rig.warm_up()?;
    rig.be_patient()?;
    let server = Server::start(&rig)?;
    let mut crowd = server.crowd();
    let mut took = vec![];
    // Do not count the first one: the emulator is still translating the code of a stop.
    for number in 0..=stops {
        rig.retrograde(&["home"], 0)?;
        let args = [
            "run",
            "--cycles",
            "1",
            "--stroke-mm",
            "40",
            "--duration-s",
            "8",
        ];
        let edges = rig.seen().edges;
        let run = rig.spawn(&args)?;
        // Stop somewhere in the first half second.
        let at = edges + 200 + (number as usize * 37) % 1_500;
        rig.wait("motion", |seen| seen.edges > at)?;
        crowd.press(&rig)?;
        let (begin, lost_us) = (Instant::now(), rig.seen().lost_us);
        let stop = rig.spawn(&["estop"])?;
        ends(stop, &["estop"], 0)?;
        let told = Instant::now();
        ends(run, &args, 6)?;
        crowd.guests_left();
        let seen = rig.seen();
        let last = seen.last.unwrap_or(begin);
        stood(told, last)?;
        if number > 0 {
            took.push((last.duration_since(begin), seen.lost_us - lost_us));
        }
        rig.retrograde(&["ack"], 0)?;
    }
    let what = format!(
        "E-stop by a second process, from its start to the last edge of STEP, {}",
        crowd.described()
    );
    drop((crowd, server));
    let late = judge(&what, took, say);
    say(windows(&rig)?);
    late
}

/// The paper's run with five watches, and commands that query the rig one after the other.
fn windows(rig: &Rig) -> Result<String, DoorError> {
    rig.retrograde(&["home"], 0)?;
    let before = rig.seen();
    let out = rig.folder.path().join("windows");
    let args = ["run", "--out", "windows"];
    let mut run = rig.spawn(&args)?;
    rig.wait("motion", |seen| seen.edges > before.edges)?;
    let watches = (0..5)
        .map(|_| rig.spawn(&["watch"]))
        .collect::<Result<Vec<_>, _>>()?;
    let mut looks = 0_u32;
    while run.child.try_wait()?.is_none() {
        for args in [&["info", "rig"][..], &["health"]] {
            if let Err(why) = rig.retrograde(args, 0) {
                // The run may have ended meanwhile, and its door with it.
                thread::sleep(LEAVING);
                if run.child.try_wait()?.is_none() {
                    return Err(why);
                }
            }
            looks += 1;
        }
        thread::sleep(Duration::from_millis(100));
    }
    drop(watches);
    ends(run, &args, 0)?;
    let (counted, missed) = record(&out)?;
    let after = rig.seen();
    let driven = after.edges - before.edges;
    let lost_ms = (after.lost_us - before.lost_us) / 1_000;
    let text = format!(
        "the paper's run with five watches and {looks} looks: {driven} edges at the pin, {counted} counted, {missed} samples of telemetry missed; the emulator was {lost_ms} ms slower than time"
    );
    if (driven, counted, missed) == (1_040_000, 1_040_000, 0) {
        Ok(text)
    } else {
        Err(DoorError::Wrong(text))
    }
}
