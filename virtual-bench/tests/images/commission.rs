//! Commissioning with the images: it passes in one go, resumes where it was interrupted, and names the defect of a
//! machine.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use capsule_plant::Shunt;
use client::Device;
use client::address::Address;
use client::link::{Link, OpenError};
use device::mark::Mark;
use host_tool::cli;
use jiff::Timestamp;
use lab::commissioning::halt::Halt;
use lab::commissioning::image;
use lab::commissioning::operator::{Act, Operator, Part, Reading, RemoteFixture};
use lab::commissioning::record::{Commissioning, StepOutcome};
use lab::commissioning::step;
use lab::operations::connector::{Candidate, Connector, LinkPurpose, Ports};
use object::{Object as _, ObjectSection as _};
use protocol::capsule::CapsuleState;
use protocol::rig::GetRigHealth;
use protocol::system::DeviceKind;
use virtual_bench::bench::{Bench, BenchOptions};
use virtual_bench::boards::rig::RigBoard;
use virtual_bench::boards::{capsule, rig};
use virtual_bench::emulator::Streams;
use virtual_bench::fixture::{Fixture, Machine, Plug};
use virtual_bench::link::VirtualLink;
use virtual_bench::plants::capsule::Parameters;
use virtual_bench::plants::rig::{Action, Rig, RigOptions, Switch};
use virtual_bench::plants::wire::Fault;
use virtual_bench::serve::Server;

/// One machine in a fixture.
struct Workshop {
    machine: Machine,
    plug: Plug,
}

impl Workshop {
    fn new(machine: Machine) -> Self {
        Self {
            machine,
            plug: Plug::default(),
        }
    }

    fn now_ns(&self) -> u64 {
        match &self.machine {
            Machine::Rig(bench) => bench.now_ns(),
            Machine::Capsule(bench) => bench.now_ns(),
        }
    }

    fn link(&self) -> Box<dyn Link> {
        let plug = self.plug.clone();
        match &self.machine {
            Machine::Rig(bench) => Box::new(VirtualLink::new(bench, "virtual rig").with_plug(plug)),
            Machine::Capsule(bench) => {
                Box::new(VirtualLink::new(bench, "virtual capsule").with_plug(plug))
            }
        }
    }

    /// Each session needs a nonce of its own.
    fn session(&self) -> u32 {
        (self.now_ns() / 1_000) as u32 + 7
    }

    fn lend(&self) -> Fixture {
        Fixture::new(self.machine.clone(), self.plug.clone())
    }
}

impl Connector for Workshop {
    fn open(
        &self,
        _: DeviceKind,
        _: &Address,
        _: u32,
        _: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        Ok(self.link())
    }
    fn candidates(&self) -> Vec<Candidate> {
        Ports.candidates()
    }
    fn nonce(&self) -> u32 {
        self.session()
    }
    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
    fn fixture(&self, _: DeviceKind, _: Option<&Address>) -> Option<Box<dyn Operator>> {
        Some(Box::new(self.lend()))
    }
}

/// DMA streams that are hard to please are no defect.
fn rig_bench(options: RigOptions) -> Bench<RigBoard> {
    let board = RigBoard::new(Rig::new(options));
    let mut options = BenchOptions::new(rig::image());
    options.chip.streams = Streams {
        keeps_count: true,
        keeps_address: true,
        fifo_errors: true,
    };
    Bench::start(board, options).expect("the image boots")
}

fn act(bench: &Bench<RigBoard>, action: Action) {
    let acted = bench.visit(|visit| {
        let now_ns = visit.now_ns();
        visit.board().rig.act(action, now_ns);
    });
    acted.expect("the bench runs");
}

/// Exit code, and what was printed on both streams.
fn retrograde(workshop: &Workshop, arguments: &[&str]) -> (u8, String) {
    let (mut out, mut err) = (vec![], vec![]);
    let arguments = ["retrograde"].iter().chain(arguments).map(OsString::from);
    let places = ["--rig", "virtual", "--capsule", "virtual"].map(OsString::from);
    let line = arguments.chain(places);
    let code = cli::run_on(line, workshop, &mut out, &mut err, None);
    out.extend(err);
    (code, String::from_utf8_lossy(&out).into_owned())
}

/// `commission --yes` with few strokes, and the record at `record`.
fn commission(workshop: &Workshop, machine: &str, record: &Path, more: &[&str]) -> (u8, String) {
    let image = rig::image();
    let image = image.to_str().expect("UTF-8");
    let record = record.to_str().expect("UTF-8");
    let line = [
        "commission",
        machine,
        "--yes",
        "--strokes",
        "200",
        "--cycles",
        "1",
        "--clock-s",
        "1",
        "--record",
        record,
    ];
    let image = ["--image", image];
    let named = more.contains(&"--image");
    let image = if named { &[][..] } else { &image[..] };
    retrograde(workshop, &[&line, image, more].concat())
}

fn folder() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let record = folder.path().join("record.json");
    (folder, record)
}

fn read(record: &Path) -> Commissioning {
    let read = Commissioning::read(record).expect("a record");
    read.expect("it was written")
}

/// Names of the steps that were begun, in order.
fn begun(text: &str) -> Vec<String> {
    text.lines()
        .filter_map(|line| line.strip_prefix('[')?.split_once("] "))
        .filter_map(|(_, rest)| rest.split_once(':'))
        .map(|(name, _)| name.to_owned())
        .collect()
}

fn names(kind: DeviceKind) -> Vec<String> {
    step::steps(kind)
        .iter()
        .map(|step| step.name.to_owned())
        .collect()
}

fn fits_the_screen(text: &str) {
    // A terminal wraps the path, and the error at the end.
    let mut lines = text.lines().take_while(|line| !line.starts_with("error"));
    let long = lines.find(|line| line.chars().count() > 80 && !line.contains('/'));
    assert_eq!(long, None);
}

#[test]
fn a_good_rig_passes_in_one_go() {
    let (_folder, record) = folder();
    // A shield at 5 V is no fault of EN.
    let workshop = Workshop::new(Machine::Rig(rig_bench(RigOptions {
        enable_pull_up_mv: Some(5_000),
        ..RigOptions::WITH_BOTH_JUMPERS
    })));
    let (code, text) = commission(&workshop, "rig", &record, &[]);
    assert_eq!(code, 0, "{text}");
    fits_the_screen(&text);
    assert_eq!(begun(&text), names(DeviceKind::Rig), "{text}");
    let found = read(&record);
    assert!(found.complete);
    for result in &found.steps {
        assert_eq!(result.outcome, StepOutcome::Passed, "{result:?}");
    }
    // 200 strokes of 1 mm at 800 steps.
    let strokes = found.result("read-back").expect("a result");
    assert_eq!(strokes.measured["counted_edges"], 160_000);
    let travel = found.result("travel").expect("a result");
    assert_eq!(travel.measured["measured_um"], 40_000);
    let enable = found.result("enable").expect("a result");
    assert_eq!(enable.measured["shield_logic"], "5 V");
    // Steps that passed are not repeated.
    let (code, text) = commission(&workshop, "rig", &record, &[]);
    assert_eq!(code, 0, "{text}");
    assert!(begun(&text).is_empty(), "{text}");
}

#[test]
fn a_good_capsule_passes_in_one_go() {
    let (_folder, record) = folder();
    let bench = capsule::start(Parameters::nominal()).expect("the image boots");
    let workshop = Workshop::new(Machine::Capsule(bench));
    let (code, text) = commission(&workshop, "capsule", &record, &[]);
    assert_eq!(code, 0, "{text}");
    fits_the_screen(&text);
    assert!(read(&record).complete);
    let mut device = Device::connect(workshop.link(), DeviceKind::Capsule, 1).expect("it answers");
    let status = device.capsule_status().expect("status");
    assert_eq!(
        (status.state, status.referenced),
        (CapsuleState::Unfolded, true)
    );
    let (code, text) = commission(&workshop, "capsule", &record, &[]);
    assert_eq!((code, begun(&text).len()), (0, 0), "{text}");
    // Once more, now that it is calibrated: its motions are references then.
    let another = record.with_file_name("another.json");
    let (code, text) = commission(&workshop, "capsule", &another, &[]);
    assert_eq!(code, 0, "{text}");
}

/// The amplifier shows both directions, but its shunt lies below the bridge: it sees the pulses only.
#[test]
fn a_shunt_below_the_bridge_is_named() {
    let (_folder, record) = folder();
    let below = Parameters {
        shunt: Shunt::Below {
            filtered_first: true,
        },
        sense_offset_mv: 1_650.0,
        ..Parameters::nominal()
    };
    let bench = capsule::start(below).expect("the image boots");
    let (code, text) = commission(
        &Workshop::new(Machine::Capsule(bench)),
        "capsule",
        &record,
        &[],
    );
    assert_ne!(code, 0, "{text}");
    assert_eq!(
        begun(&text).last().map(String::as_str),
        Some("held"),
        "{text}"
    );
    let flat = text.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(flat.contains("in series with the motor"), "{text}");
}

/// A short rig: 30 mm of stroke, the far limit at 31 mm, the carriage anywhere.
fn short() -> RigOptions {
    RigOptions {
        carriage: 20 * 800,
        limit: 31 * 800,
        stops: (-3 * 800, 33 * 800),
        ..RigOptions::default()
    }
}

/// Settings of a short rig that homes quickly.
fn set_short(workshop: &Workshop) {
    for (key, value) in [
        ("stroke_um", "30000"),
        ("seek_um_s", "40000"),
        ("locate_um_s", "5000"),
        ("homing_accel_um_s2", "1000000"),
        ("pull_off_um", "1000"),
    ] {
        let (code, text) = retrograde(workshop, &["settings", "set", key, value]);
        assert_eq!(code, 0, "{text}");
    }
}

fn is_named(bench: Bench<RigBoard>, more: &[&str], step: &str, says: &str) {
    let (_folder, record) = folder();
    let workshop = Workshop::new(Machine::Rig(bench));
    set_short(&workshop);
    let (code, text) = commission(&workshop, "rig", &record, more);
    assert_eq!(code, 6, "{text}");
    assert_eq!(
        begun(&text).last().map(String::as_str),
        Some(step),
        "{text}"
    );
    let found = read(&record);
    let result = found.result(step).expect("a result");
    assert_eq!(result.outcome, StepOutcome::Failed, "{text}");
    let reason = result.reason.as_deref().unwrap_or_default();
    assert!(
        reason.contains(says),
        "{reason} does not say {says:?}\n{text}"
    );
    fits_the_screen(&text);
}

/// Each defect, the step that stops at it, and what it says.
#[test]
fn a_defect_is_named() {
    let with = |change: fn(&mut RigOptions)| {
        let mut options = short();
        change(&mut options);
        options
    };
    // A driver that is strapped for 1/32 or 1/8, a screw of 5 mm.
    let [thirty_two, eight, five_mm] =
        [1_600, 400, 640].map(|steps| short().with_steps_per_mm(steps));
    let stuck = |open| Some(Action::Stick(Switch::Home, Some(open)));
    // It opens and closes for as long, again and again.
    let noise = |ns| Some(Action::Noise(Switch::EStop, Some(ns)));
    let swapped = with(|rig| rig.swapped_switches = true);
    let reversed = with(|rig| rig.reversed = true);
    let bare = with(|rig| rig.enable_pull_up_mv = None);
    let two_pull_ups = with(|rig| rig.enable_pull_up_mv = Some(4_300));
    let too_much = with(|rig| rig.enable_pull_up_mv = Some(12_000));
    let no_jumper = Some(Action::ReadBack(Fault::Whole(false)));
    let jitter = Some(Action::Capture(Fault::Jitter(20)));
    let captures = with(|rig| rig.capture_jumper = true);
    let lead = "12.5 mm instead of 10, so the screw has a lead of about 5000 um";
    for (options, action, step, says) in [
        (swapped, None, "home-flag", "swapped switches"),
        (thirty_two, None, "travel", "strapped for 32"),
        (eight, None, "travel", "strapped for 8"),
        (five_mm, None, "travel", lead),
        (short(), no_jumper, "pulses", "jumper D2-A0 is missing"),
        (reversed, None, "home", "the motor is reversed"),
        (short(), stuck(false), "home-flag", "the home flag is dead"),
        (
            short(),
            stuck(true),
            "home-flag",
            "open in the middle of the travel",
        ),
        (short(), noise(3_000_000), "quiet", "noise on its wire"),
        (short(), noise(5_000_000), "quiet", "noise on its wire"),
        (bare, None, "enable", "EN has no pull-up"),
        (
            two_pull_ups,
            None,
            "enable",
            "two pull-ups to different supplies",
        ),
        (too_much, None, "enable", "more than the 5.5 V"),
        (captures, jitter, "edge-timing", "by 20 ns"),
    ] {
        let bench = rig_bench(options);
        action.into_iter().for_each(|action| act(&bench, action));
        is_named(bench, &[], step, says);
    }
}

#[test]
fn a_missing_clock_is_named() {
    let mut options = BenchOptions::new(rig::image());
    options.chip.hse_after_ns = None;
    let bench = Bench::start(RigBoard::new(Rig::new(short())), options).expect("the image boots");
    is_named(bench, &[], "clock", "the board gets no 8 MHz clock");
}

#[test]
fn another_image_is_named() {
    let (folder, _) = folder();
    let stale = folder.path().join("stale.elf");
    let mut bytes = std::fs::read(rig::image()).expect("an image");
    let elf = object::File::parse(&*bytes).expect("an ELF file");
    let code = elf.section_by_name(".text").expect("code");
    let (at, _) = code.file_range().expect("bytes");
    bytes[usize::try_from(at).expect("within the file")] ^= 1;
    std::fs::write(&stale, bytes).expect("written");
    for (file, says) in [
        (capsule::image(), "is the capsule's image"),
        (stale, "stale image"),
    ] {
        let file = file.to_str().expect("UTF-8");
        is_named(rig_bench(short()), &["--image", file], "image", says);
    }
}

/// The file's fingerprint equals the one that the image computes over its flash, and its mark what the image answers.
#[test]
fn a_file_says_the_same_as_its_image() {
    let mut rig = crate::common::rig();
    let identity = rig.device.identity().copied().expect("it has answered");
    let of_rig = Mark {
        machine: DeviceKind::Rig,
        protocol: identity.protocol,
        schema_key: identity.schema_key,
        revision: identity.revision,
    };
    let machine = DeviceKind::Capsule;
    let of_capsule = Mark { machine, ..of_rig };
    let marks = [rig::image(), capsule::image()].map(|file| image::mark(&file).expect("a mark"));
    assert_eq!(marks, [of_rig, of_capsule]);
    let health = rig.device.call(GetRigHealth).expect("the rig answers");
    let file = image::fingerprint(&rig::image()).expect("an image");
    assert_eq!(format!("{file:08x}"), format!("{:08x}", health.image_hash));
}

#[test]
fn a_fixture_behind_a_port_does_what_it_is_asked() {
    let bench = rig_bench(short());
    let server = Server::listen(0).expect("a port");
    let place = format!("127.0.0.1:{}", server.port());
    let fixture = Fixture::new(Machine::Rig(bench.clone()), Plug::default()).served();
    std::thread::spawn(move || server.serve_fixture(&fixture));
    let mut fixture = RemoteFixture::connect(&place).expect("they listen");
    let mut say = |_: &str| {};
    let mut watch = || Ok(false);
    let mut act = |part, on| fixture.act(Act { part, on }, true, &mut say, &mut watch);
    act(Part::Supply, false).expect("done");
    act(Part::Carriage, true).expect("done");
    act(Part::HomeFlag, true).expect("done");
    bench.advance_us(10).expect("the bench runs");
    let open = bench.visit(|visit| visit.board().rig.is_open(Switch::Home));
    assert!(open.expect("the bench runs"));
    assert_eq!(
        fixture.read(Reading::Carriage, &mut say).expect("measured"),
        15_000
    );
    let no = fixture.read(Reading::Battery, &mut say);
    assert!(matches!(no, Err(Halt::NotShown(why)) if why.contains("cannot")));
}
