//! Connects to a rig, homes it if needed, executes the paper's run and prints the rig's record of it:
//!
//! ```sh
//! cargo run -p host-tool --example paper_run -- /dev/ttyACM0
//! cargo run -p host-tool --example paper_run -- tcp:127.0.0.1:7001
//! ```
//!
//! If this program ends early, by Ctrl-C for example, the rig stops by itself after a second without its host.
#![forbid(unsafe_code)]
#![allow(
    clippy::print_stdout,
    reason = "a program for the terminal talks to it"
)]

use std::io::Write;

use client::Device;
use client::address::Address;
use client::decimal;
use client::identity;
use client::link::serial::DEFAULT_BAUD;
use lab::operations::connector::{Connector, LinkPurpose, Ports};
use lab::operations::output::Stream;
use lab::trials::experiment::{self, PAPER_RUN};
use lab::trials::progress::Live;
use miette::{IntoDiagnostic, Result, miette};
use protocol::rig::{RunOutcome, RunRecord};
use protocol::system::DeviceKind;

fn main() -> Result<()> {
    let address: Address = std::env::args()
        .nth(1)
        .ok_or_else(|| miette!("give the rig's address: a serial port or tcp:HOST:PORT"))?
        .parse()
        .into_diagnostic()?;

    // The session is refused if this is not a rig, or not one with this program's protocol. Nothing moves yet.
    let link = Ports.open(
        DeviceKind::Rig,
        &address,
        DEFAULT_BAUD,
        LinkPurpose::Own("run"),
    )?;
    let mut rig = Device::connect(link, DeviceKind::Rig, Ports.nonce())?;
    if let Some(identity) = rig.identity() {
        println!("{}", identity::line(identity));
    }

    // Prints what begins and, every few seconds, its progress. Output never blocks, so that the rig never waits for a
    // reader.
    let mut out = Stream::Out;
    let mut progress = Live::new(&mut out, false);

    // A run starts at home.
    let status = rig.rig_status()?;
    if !status.homed || status.position_steps != 0 {
        experiment::home(&mut rig, &mut progress)?;
    }

    // The rig refuses a run that it cannot execute exactly, and says why.
    let accepted = rig.run(PAPER_RUN)?;
    let record = rig.wait_run(&accepted, &mut progress)?;
    drop(progress);
    out.flush().into_diagnostic()?;
    print_record(&record);
    match record.outcome {
        RunOutcome::Complete => Ok(()),
        outcome => Err(miette!("the run did not complete: {outcome:?}")),
    }
}

fn print_record(record: &RunRecord) {
    println!("outcome    {:?}", record.outcome);
    println!("strokes    {}", record.strokes);
    println!("duration   {} s", decimal::seconds(record.ticks));
    println!(
        "steps      {} commanded, {} counted at the pin",
        record.commanded_edges, record.counted_edges
    );
    println!("residual   {} steps at worst", record.worst_residual_steps);
    println!("plan       {:016x}", record.plan_hash);
}
