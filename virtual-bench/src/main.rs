//! `virtual-bench`: the program.

use std::ffi::OsString;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::thread;

use capsule_plant::cases::Kind;
use clap::Parser;
use jiff::Timestamp;
use virtual_bench::bench::{Bench, BenchError};
use virtual_bench::boards;
use virtual_bench::connector::BenchPorts;
use virtual_bench::demo::{self, DemoOptions};
use virtual_bench::emulator::Wiring;
use virtual_bench::figures;
use virtual_bench::hands::{BenchHands, Machine, Plug};
use virtual_bench::peers;
use virtual_bench::plants::capsule::Parameters;
use virtual_bench::plants::rig::RigOptions;
use virtual_bench::population;
use virtual_bench::serve::Server;
use virtual_bench::torture;
use virtual_bench::unmeasured::FigureError;
use virtual_bench::warm;
#[cfg(unix)]
use virtual_bench::webpage::{self, By};

#[derive(Parser)]
#[command(about, version)]
struct Arguments {
    #[command(subcommand)]
    subcommand: Subcommand,
}

/// Peers that are not among the images.
#[derive(clap::Args)]
struct PeerSources {
    /// Folder of Klipper's sources, whose step compressor then stands in the table, too.
    #[arg(long, value_name = "DIR")]
    klipper: Option<PathBuf>,
}

#[derive(clap::Subcommand)]
enum Subcommand {
    /// Executes the paper's experiment on both images and judges it from the pins.
    Demo {
        /// Folder for the records and the report.
        #[arg(long, value_name = "DIR", default_value = "demo-data")]
        out: PathBuf,
    },
    /// Measures the performance of the rig's image.
    Bench {
        #[command(flatten)]
        peers: PeerSources,
        /// Write the tables of cycles and peers into this page, too: docs/performance.md. Needs `--klipper`, so that no
        /// row of the page is lost.
        #[arg(long, value_name = "FILE", requires = "klipper")]
        page: Option<PathBuf>,
    },
    /// Only the last table of `bench`: the step generator beside its peers.
    Peers {
        #[command(flatten)]
        peers: PeerSources,
    },
    /// Tries the capsule's image on seeded capsules with one defect each, and prints what it called them.
    Capsules {
        /// Cases of each defect.
        #[arg(default_value_t = population::CASES)]
        cases: u64,
        /// Only these defects, as the table names them.
        only: Vec<Kind>,
    },
    /// Tortures both images with seeded random scenarios, and prints how to repeat the first that breaks a rule.
    Torture {
        /// Seed of the first scenario; the next ones have the seeds after it.
        #[arg(long, value_parser = torture::seed_of)]
        seed: u64,
        /// Minutes of virtual time; 0 for one scenario.
        #[arg(long, default_value_t = 0)]
        minutes: u64,
    },
    /// Measures the side door with the rig's image, in real time: emergency stops by a second process among a crowd.
    #[cfg(unix)]
    Door {
        /// Emergency stops.
        #[arg(default_value_t = virtual_bench::sidedoor::STOPS)]
        stops: u32,
        /// Instead, kill the process of a run this often while others look on.
        #[arg(long, value_name = "KILLS", conflicts_with = "stops")]
        killed: Option<u32>,
    },
    /// Measures `retrograde serve` with the rig's image, in real time: emergency stops over HTTP among a crowd, and a run
    /// with 50 readers.
    #[cfg(unix)]
    Page {
        /// Emergency stops.
        #[arg(default_value_t = virtual_bench::sidedoor::STOPS)]
        stops: u32,
        /// Instead, stop by mouse and key on the page in this Chromium, without a window.
        #[arg(long, value_name = "PROGRAM")]
        browser: Option<PathBuf>,
        /// Instead, stop with the package for Python in this interpreter.
        #[arg(long, value_name = "PROGRAM", conflicts_with = "browser")]
        python: Option<PathBuf>,
    },
    /// Serves the machines on local TCP ports in real time, until interrupted.
    Serve {
        /// Port of the rig; 0 for a free one.
        #[arg(long, value_name = "PORT")]
        rig: Option<u16>,
        /// Port of the capsule; 0 for a free one.
        #[arg(long, value_name = "PORT")]
        capsule: Option<u16>,
        /// Also serve hands at each machine, for `retrograde commission --yes --hands`: on this port at the rig, on
        /// the next one at the capsule; 0 for free ones.
        #[arg(long, value_name = "PORT", value_parser = clap::value_parser!(u16).range(..=65_534))]
        hands: Option<u16>,
    },
    /// Any command of the host tool, also behind the word `retrograde`, as its own `serve` has to be; which here also takes `--rig virtual` and `--capsule virtual`.
    #[command(external_subcommand)]
    Retrograde(Vec<OsString>),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().subcommand {
        Subcommand::Demo { out } => {
            let now = Timestamp::now();
            demo::run(&DemoOptions { out, now }, std::io::stderr().is_terminal())
                .map_err(miette::Report::from)
        }
        Subcommand::Bench { peers, page } => {
            let mut say = |line: &str| drop(writeln!(std::io::stdout(), "{line}"));
            figures::run(peers.klipper.as_deref(), page.as_deref(), &mut say)
                .map_err(miette::Report::from)
        }
        Subcommand::Peers { peers } => peers::table(None, peers.klipper.as_deref())
            .map(|table| drop(writeln!(std::io::stdout(), "{table}")))
            .map_err(miette::Report::from),
        Subcommand::Capsules { cases, only } => population::run(cases, &only, &mut |line| {
            drop(writeln!(std::io::stdout(), "{line}"))
        })
        .map_err(miette::Report::from),
        Subcommand::Torture { seed, minutes } => {
            let mut say = |line| drop(writeln!(std::io::stdout(), "{line}"));
            torture::run(seed, minutes, &mut say)
                .map(drop)
                .map_err(miette::Report::from)
        }
        #[cfg(unix)]
        Subcommand::Door { stops, killed } => {
            let mut say = |line| drop(writeln!(std::io::stdout(), "{line}"));
            match killed {
                Some(kills) => virtual_bench::killed::run(kills, &mut say),
                None => virtual_bench::sidedoor::run(stops, &mut say),
            }
        }
        .map_err(miette::Report::from),
        #[cfg(unix)]
        Subcommand::Page {
            stops,
            browser,
            python,
        } => {
            let by = match (browser, python) {
                (Some(program), _) => By::Page(program),
                (None, Some(program)) => By::Python(program),
                (None, None) => By::Http,
            };
            webpage::run(stops, &by, &mut |line| {
                drop(writeln!(std::io::stdout(), "{line}"))
            })
        }
        .map_err(miette::Report::from),
        Subcommand::Serve {
            rig,
            capsule,
            hands,
        } => serve(rig, capsule, hands).map_err(|why| miette::miette!("{why}")),
        Subcommand::Retrograde(arguments) => {
            let program = OsString::from("virtual-bench");
            // `serve` is this program's own; the tool's is `virtual-bench retrograde serve`.
            let own = arguments.first().is_some_and(|word| word == "retrograde");
            return host_tool::cli::run(
                [program]
                    .into_iter()
                    .chain(arguments.into_iter().skip(usize::from(own))),
                &BenchPorts::default(),
            );
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!("{why:?}");
            ExitCode::FAILURE
        }
    }
}

fn serve(rig: Option<u16>, capsule: Option<u16>, hands: Option<u16>) -> Result<(), FigureError> {
    let (rig, capsule) = match (rig, capsule) {
        (None, None) => (Some(7001), Some(7002)),
        chosen => chosen,
    };
    let warm = [
        rig.map(|_| thread::spawn(warm::rig)),
        capsule.map(|_| thread::spawn(warm::capsule)),
    ];
    for machine in warm.into_iter().flatten() {
        machine.join().map_err(|_| panicked())??;
    }
    let mut serving = Vec::new();
    if let Some(port) = rig {
        let bench = boards::rig::start(RigOptions::WITH_BOTH_JUMPERS)?;
        let plug = Plug::default();
        if let Some(port) = hands {
            lend_hands(Machine::Rig(bench.clone()), &plug, "rig", port)?;
        }
        serving.push(serve_one(bench, "rig", port, plug)?);
    }
    if let Some(port) = capsule {
        let bench = boards::capsule::start(Parameters::nominal())?;
        let plug = Plug::default();
        if let Some(port) = hands {
            let port = if port == 0 { 0 } else { port + 1 };
            lend_hands(Machine::Capsule(bench.clone()), &plug, "capsule", port)?;
        }
        serving.push(serve_one(bench, "capsule", port, plug)?);
    }
    for server in serving {
        server.join().map_err(|_| panicked())??;
    }
    Ok(())
}

fn panicked() -> BenchError {
    BenchError::Ended("a machine's thread failed".into())
}

fn serve_one<W: Wiring>(
    bench: Bench<W>,
    name: &'static str,
    port: u16,
    plug: Plug,
) -> Result<thread::JoinHandle<Result<(), BenchError>>, BenchError> {
    let server = Server::listen(port)?;
    eprintln!("{name}: --{name} tcp:127.0.0.1:{}", server.port());
    Ok(thread::spawn(move || server.serve(&bench, name, &plug)))
}

fn lend_hands(
    machine: Machine,
    plug: &Plug,
    name: &'static str,
    port: u16,
) -> Result<(), BenchError> {
    let server = Server::listen(port)?;
    eprintln!(
        "hands at the {name}: --yes --hands 127.0.0.1:{}",
        server.port()
    );
    let hands = BenchHands::new(machine, plug.clone()).served();
    thread::spawn(move || server.serve_hands(&hands));
    Ok(())
}
