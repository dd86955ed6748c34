//! Kills the process that runs the rig's image while others look on, in real time, and measures how long the rig moves
//! on. Their questions must not keep the run of a dead process going.

use std::thread;
use std::time::{Duration, Instant};

use crate::processes::{DoorError, Process, Rig, wrong};

/// Time that the rig waits for a sign of life, ms. Braking and the delays of this computer come on top.
const LINK_TIMEOUT_MS: &str = "1000";
/// Longest time from the last byte of the killed process to the last edge.
const LIMIT: Duration = Duration::from_millis(1_100);
/// Time without an edge after which the rig counts as standing.
const STANDS: Duration = Duration::from_millis(400);
/// Edges of one cycle of 20 mm, at 800 steps per mm of the paper's rig.
const FAR_EDGES: usize = 32_000;

/// Kills the run `kills` times for each kind of looker with the policy "stop", and once with "finish". Prints the
/// measurements.
///
/// # Errors
/// [`DoorError`], also if the rig moved on for too long, or a run that should have finished did not.
pub fn run(kills: u32, say: &mut dyn FnMut(String)) -> Result<(), DoorError> {
    let rig = Rig::start()?;
    rig.warm_up()?;
    rig.retrograde(&["settings", "set", "link_timeout_ms", LINK_TIMEOUT_MS], 0)?;
    let lookers: [(&str, &[&str], usize); 4] = [
        ("nobody", &[], 0),
        ("`watch`", &["watch"], 1),
        (
            "`serve`",
            &["retrograde", "serve", "--listen", "127.0.0.1:0"],
            1,
        ),
        ("five windows", &["watch"], 5),
    ];
    let mut late = false;
    for (name, args, count) in lookers {
        let look_on = || {
            (0..count)
                .map(|_| rig.spawn(args))
                .collect::<Result<Vec<_>, _>>()
        };
        let mut took = vec![];
        for number in 0..kills {
            took.push(stopped(&rig, &look_on, number)?);
        }
        let within = took.iter().filter(|took| **took <= LIMIT).count();
        took.sort();
        let [least, most] =
            [took.first(), took.last()].map(|took| took.map_or(0, |took| took.as_millis()));
        say(format!(
            "killed while {name} looked on: {within} of {kills} stood within {} ms of its last byte; {least} to {most} ms",
            LIMIT.as_millis()
        ));
        late |= within < took.len();
        let edges = finished(&rig, &look_on)?;
        say(format!(
            "  with the policy \"finish\": {edges} of {FAR_EDGES} edges"
        ));
        late |= edges != FAR_EDGES;
    }
    match late {
        true => Err(wrong("a run did not end as its policy says")),
        false => Ok(()),
    }
}

type LookOn<'a> = &'a dyn Fn() -> Result<Vec<Process>, DoorError>;

/// Begins a run, kills its process while others look on, and waits until the rig stands. Returns the edges before and
/// after, and how long it moved on after the last byte.
fn orphaned(
    rig: &Rig,
    policy: &str,
    look_on: LookOn<'_>,
    number: u32,
) -> Result<(usize, Duration), DoorError> {
    rig.retrograde(&["home"], 0)?;
    let before = rig.seen().edges;
    let mut run = rig.spawn(&[
        "run",
        "--cycles",
        "1",
        "--stroke-mm",
        "20",
        "--duration-s",
        "6",
        "--on-link-loss",
        policy,
    ])?;
    rig.wait("motion", |seen| seen.edges > before)?;
    let lookers = look_on()?;
    thread::sleep(Duration::from_millis(300 + u64::from(number) * 37 % 500));
    let heard = rig
        .seen()
        .heard
        .ok_or_else(|| wrong("the run said nothing"))?;
    run.child.kill()?;
    run.child.wait()?;
    let mut last = rig.seen();
    let begin = Instant::now();
    while last.last.is_some_and(|edge| edge.elapsed() < STANDS) {
        if begin.elapsed() > Duration::from_secs(20) {
            return Err(wrong("it moves on"));
        }
        thread::sleep(Duration::from_millis(2));
        last = rig.seen();
    }
    drop(lookers);
    let edge = last.last.unwrap_or(begin);
    Ok((last.edges - before, edge.saturating_duration_since(heard)))
}

fn stopped(rig: &Rig, look_on: LookOn<'_>, number: u32) -> Result<Duration, DoorError> {
    let (_, took) = orphaned(rig, "stop", look_on, number)?;
    Ok(took)
}

fn finished(rig: &Rig, look_on: LookOn<'_>) -> Result<usize, DoorError> {
    let (edges, _) = orphaned(rig, "finish", look_on, 0)?;
    Ok(edges)
}
