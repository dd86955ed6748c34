//! `stop` and `estop`: sends the stop to every machine at once and reports the result of each.

use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use lab::operations::arguments::Which;
use lab::operations::delivery::{DO_NOW, Delivery, StopReport};
use lab::operations::failure::Failure;
use lab::operations::finder::{Finder, Target};
use protocol::system::Urgent;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

/// Time after which the operator sees which machines have not confirmed. The attempt continues.
const PATIENCE: Duration = Duration::from_secs(2);

/// Sends the stop. Returns the results in the order of the targets, and prints each as soon as it arrives.
fn tell(
    urgent: Urgent,
    targets: &[Target],
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Vec<StopReport> {
    let (results, arriving) = mpsc::channel();
    let begin = Instant::now();
    let mut reports: Vec<Option<StopReport>> = targets.iter().map(|_| None).collect();
    thread::scope(|scope| {
        let mut alone = vec![];
        for (index, target) in targets.iter().enumerate() {
            let results = results.clone();
            let tell = move || {
                let report = target.report(finder.urgent(target, urgent));
                // The receiver lives as long as the scope.
                let _ = results.send((index, report));
            };
            let thread = thread::Builder::new().spawn_scoped(scope, tell.clone());
            if thread.is_err() {
                alone.push(tell);
            }
        }
        // No thread could be started: stop these one after the other.
        for tell in alone {
            tell();
            while let Ok((index, result)) = arriving.try_recv() {
                screen.say(&result.line(urgent));
                reports[index] = Some(result);
            }
        }
        drop(results);
        let mut warned = false;
        loop {
            let remaining = match warned {
                false => PATIENCE.saturating_sub(begin.elapsed()),
                true => Duration::from_secs(3_600),
            };
            match arriving.recv_timeout(remaining) {
                Ok((index, result)) => {
                    screen.say(&result.line(urgent));
                    reports[index] = Some(result);
                }
                Err(mpsc::RecvTimeoutError::Timeout) => {
                    warned = true;
                    for (target, report) in targets.iter().zip(&reports) {
                        if report.is_none() {
                            screen.say(&format!("{target}: NOT YET CONFIRMED: {DO_NOW}"));
                        }
                    }
                }
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
            }
        }
    });
    reports.into_iter().flatten().collect()
}

pub(crate) fn stop(
    urgent: Urgent,
    which: &Which,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let targets = finder.targets_to_stop(which);
    if targets.is_empty() {
        return Err(Failure::Stops {
            reports: vec![StopReport {
                machine: "any machine".to_owned(),
                delivery: Delivery::NotDelivered,
                why: "no address was given, and there is no port with an ST-LINK".to_owned(),
            }],
        });
    }
    let reports = tell(urgent, &targets, finder, screen);
    if reports
        .iter()
        .any(|report| report.delivery != Delivery::Stopped)
    {
        return Err(Failure::Stops { reports });
    }
    let stopped: Vec<_> = reports
        .iter()
        .map(|report| report.machine.clone())
        .collect();
    let machines: Vec<_> = reports.iter().map(StopReport::json).collect();
    Ok(json!({ "stopped": stopped, "machines": machines }))
}
