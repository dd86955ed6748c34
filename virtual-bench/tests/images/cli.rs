//! The command line with the rig's image: an impossible request is refused with a helpful text, and no edge leaves the
//! pin.

use client::address::Address;
use client::link::{Link, OpenError};

use crate::common::RigRun;
use host_tool::cli;
use jiff::Timestamp;
use lab::operations::connector::{Candidate, Connector, Ports, Purpose};
use protocol::system::DeviceKind;
use virtual_bench::bench::Bench;
use virtual_bench::boards::rig::RigBoard;
use virtual_bench::link::VirtualLink;

/// Every command line reaches the same rig.
struct OneRig(Bench<RigBoard>);

impl Connector for OneRig {
    fn open(
        &self,
        _: DeviceKind,
        _: &Address,
        _: u32,
        _: Purpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        Ok(Box::new(VirtualLink::new(&self.0, "virtual rig")))
    }
    fn candidates(&self) -> Vec<Candidate> {
        Ports.candidates()
    }
    fn nonce(&self) -> u32 {
        // Each command line is a session of its own.
        (self.0.now_ns() / 1_000) as u32
    }
    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

/// Exit code, and what was printed on both streams.
fn retrograde(rig: &RigRun, arguments: &[&str]) -> (u8, String) {
    let connector = OneRig(rig.bench.clone());
    let (mut out, mut err) = (vec![], vec![]);
    let arguments = ["retrograde", "--rig", "virtual"]
        .iter()
        .chain(arguments)
        .map(std::ffi::OsString::from);
    let code = cli::run_on(arguments, &connector, &mut out, &mut err, None);
    out.extend(err);
    (code, String::from_utf8_lossy(&out).into_owned())
}

#[test]
fn a_refused_command_line_says_why_and_moves_nothing() {
    let data = tempfile::tempdir().expect("a folder");
    let folder = data.path().to_str().expect("a name");
    let rig = crate::common::rig();
    let run = |rig: &RigRun, arguments: &[&str]| {
        let arguments: Vec<&str> = ["run", "--out", folder]
            .iter()
            .chain(arguments)
            .copied()
            .collect();
        retrograde(rig, &arguments)
    };
    let (code, text) = run(&rig, &[]);
    assert!(code != 0 && text.contains("home first"), "{code} {text}");
    assert_eq!(rig.edge_count(), 0);

    let (code, text) = retrograde(&rig, &["home"]);
    assert_eq!(code, 0, "{text}");
    let edges = rig.edge_count();
    for (arguments, says) in [
        (&["--stroke-mm", "131"][..], "130"),
        (&["--cycles", "0"], "cycles"),
        (&["--duration-s", "10"], "31.43"),
        (&["--duration-s", "10", "--accel-mm-s2", "2000"], "49 mm/s"),
        (&["--stroke-mm", "NaN"], "NaN"),
        (&["--stroke-mm", "inf"], "inf"),
        (&["--duration-s", "1e999"], "1e999"),
        (
            &["--duration-s", "99999999999999999999999"],
            "99999999999999999999999",
        ),
        (&["--stroke-mm=-5"], "-5"),
        (&["--accel-mm-s2", "0"], "accel"),
    ] {
        let (code, text) = run(&rig, arguments);
        assert!(code != 0, "{arguments:?} was accepted: {text}");
        assert!(
            text.contains(says),
            "{arguments:?}: the text does not say {says:?}: {text}"
        );
        assert_eq!(rig.edge_count(), edges, "{arguments:?} moved the carriage");
    }
    // The rig still works.
    let (code, text) = run(
        &rig,
        &["--cycles", "1", "--stroke-mm", "5", "--duration-s", "2"],
    );
    assert_eq!(code, 0, "{text}");
    assert_eq!(rig.edge_count(), edges + 8_000, "{text}");
    rig.check_clean(0);
}
