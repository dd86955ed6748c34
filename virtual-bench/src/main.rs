//! `virtual-bench`: the machines without the machines.

use std::process::ExitCode;
use std::thread;

use clap::{Parser, Subcommand};
use virtual_bench::bench::{Bench, BenchError};
use virtual_bench::boards;
use virtual_bench::emulator::Wiring;
use virtual_bench::link::VirtualLink;
use virtual_bench::plants::capsule::CapsuleOptions;
use virtual_bench::plants::rig::RigOptions;
use virtual_bench::serve::Server;

#[derive(Parser)]
#[command(about, version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Serves the machines on TCP of this computer at the pace of the wall clock, until interrupted.
    Serve {
        /// Port of the rig; 0 takes a free one.
        #[arg(long, value_name = "PORT")]
        rig: Option<u16>,
        /// Port of the capsule; 0 takes a free one.
        #[arg(long, value_name = "PORT")]
        capsule: Option<u16>,
    },
}

fn main() -> ExitCode {
    let Command::Serve { rig, capsule } = Arguments::parse().command;
    match serve(rig, capsule) {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!("{why}");
            ExitCode::FAILURE
        }
    }
}

fn serve(rig: Option<u16>, capsule: Option<u16>) -> Result<(), BenchError> {
    let (rig, capsule) = match (rig, capsule) {
        (None, None) => (Some(7001), Some(7002)),
        chosen => chosen,
    };
    let mut serving = Vec::new();
    if let Some(port) = rig {
        let bench = boards::rig::start(RigOptions::default())?;
        serving.push(serve_one(bench, "rig", port)?);
    }
    if let Some(port) = capsule {
        let bench = boards::capsule::start(CapsuleOptions::default())?;
        serving.push(serve_one(bench, "capsule", port)?);
    }
    for server in serving {
        server
            .join()
            .map_err(|_| BenchError::Ended("a server failed".into()))??;
    }
    Ok(())
}

fn serve_one<W: Wiring>(
    bench: Bench<W>,
    name: &'static str,
    port: u16,
) -> Result<thread::JoinHandle<Result<(), BenchError>>, BenchError> {
    let server = Server::listen(port)?;
    eprintln!("{name}: --{name} tcp:127.0.0.1:{}", server.port());
    Ok(thread::spawn(move || {
        let mut link = VirtualLink::new(&bench, name);
        server.serve(&mut link)
    }))
}
