//! The files of a trial: their names, their rows, and the counts in the sidecar.

use super::*;
use protocol::capsule::{CapsuleState, CapsuleTelemetry};

#[test]
fn a_row_that_was_cut_short_is_taken_off() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("run.csv");
    for (text, rows, left) in [
        ("", 0, ""),
        ("time_us,sta", 0, ""),
        ("time_us,state\n", 0, "time_us,state\n"),
        ("a,b\n1,2\n3,", 1, "a,b\n1,2\n"),
        ("a,b\n1,2\n3,4\n", 2, "a,b\n1,2\n3,4\n"),
    ] {
        fs::write(&path, text).expect("written");
        assert_eq!(keep_whole_rows(&path).expect("read"), rows, "{text:?}");
        assert_eq!(fs::read_to_string(&path).expect("read"), left);
    }
}

#[test]
fn a_name_is_new_if_neither_file_has_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let created = || {
        let (path, _) = create_new(folder.path(), "run").expect("created");
        path.file_name()
            .expect("a name")
            .to_string_lossy()
            .into_owned()
    };
    assert_eq!(created(), "run.csv");
    assert_eq!(created(), "run-2.csv");
    fs::write(folder.path().join("run-3.json"), "{}").expect("written");
    assert_eq!(created(), "run-4.csv");
    // A file where the folder should be is told at once, not after all names.
    let lost = create_new(&folder.path().join("run.csv"), "run").expect_err("no folder");
    assert!(lost.path.ends_with("run.csv"), "{lost}");
}

/// A virtual machine that says nothing of itself.
pub(crate) fn device() -> IdentityRecord {
    IdentityRecord {
        device: "capsule".to_owned(),
        origin: Origin::Virtual,
        uid: String::new(),
        firmware: String::new(),
        profile: String::new(),
        protocol: String::new(),
        schema_key: String::new(),
        boot_id: 1,
        reset_cause: String::new(),
    }
}

/// The recording of a fold.
pub(crate) fn fold_in(folder: &Path) -> Recording {
    Recording {
        folder: folder.to_owned(),
        stem: "fold".to_owned(),
        now: Timestamp::UNIX_EPOCH,
        note: None,
        telemetry_ms: 20,
    }
}

fn recorder_in(folder: &Path) -> Recorder {
    let recording = fold_in(folder);
    let action = Action::Actuation {
        actuation: ActuationKind::Fold,
        accepted: None,
        record: None,
    };
    let trial = TrialRecord::new(action, device(), BTreeMap::new(), &recording);
    Recorder::create(trial, &recording).expect("created")
}

#[test]
fn the_sidecar_counts_the_rows_and_the_samples_that_are_missing() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut recorder = recorder_in(folder.path());
    assert!(!recorder.has_begun());
    recorder.begun(&Begun::Actuation(ActuationAccepted {
        actuation: 3,
        timeout_ms: 6_000,
    }));
    assert!(recorder.has_begun());
    for (time_us, missed) in [(20_000, 0), (80_000, 2), (160_000, 3)] {
        let sample = CapsuleTelemetry {
            time_us,
            state: CapsuleState::Folding,
            thread_um: 1_000,
            current_ma: 20,
            battery_mv: 3_700,
            drive_mv: 2_000,
        };
        recorder.telemetry(&Telemetry::Capsule(sample), missed);
    }
    let sidecar = recorder.sidecar().to_owned();
    let lost = Ending::Lost("gone".to_owned());
    let trial = recorder.finish(lost, 0).expect("written");
    assert_eq!((trial.samples, trial.missed_samples), (3, 5));
    assert_eq!(trial.status, Status::Unknown);
    assert_eq!(trial.error.as_deref(), Some("gone"));
    let read = TrialRecord::read(&sidecar).expect("a sidecar");
    assert_eq!((read.samples, read.missed_samples), (3, 5));
    let rows: Vec<CapsuleSample> = read.samples(&sidecar).expect("rows");
    let missed: Vec<_> = rows.iter().map(|row| row.missed).collect();
    assert_eq!(missed, [0, 2, 3]);
}

#[test]
fn steps_are_places_to_the_nearest_nanometre() {
    let screw = |lead_um, steps_per_rev| Screw {
        lead_um,
        steps_per_rev,
        stroke_um: 20_000,
    };
    let thirds = screw(1_000, 3);
    assert_eq!(
        [-1, 1, 2].map(|steps| thirds.nm(steps)),
        [-333_333, 333_333, 666_667]
    );
    let usual = screw(4_000, 1_600);
    assert_eq!((usual.nm(3), usual.steps(1_001)), (7_500, 400));
    assert!((usual.mm(800.0) - 2.0).abs() < 1e-12);
}

#[test]
fn a_record_of_a_later_format_is_not_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("fold.json");
    let recording = fold_in(folder.path());
    let action = Action::Actuation {
        actuation: ActuationKind::Fold,
        accepted: None,
        record: None,
    };
    let mut trial = TrialRecord::new(action, device(), BTreeMap::new(), &recording);
    trial.telemetry = "fold.csv".to_owned();
    for (format, why) in [
        (FORMAT, None),
        (FORMAT + 1, Some("format 3, this tool reads 2")),
    ] {
        trial.format = format;
        fs::write(&path, serde_json::to_string(&trial).expect("text")).expect("written");
        let read = TrialRecord::read(&path).map_err(|error| error.why);
        assert_eq!(read.err().as_deref(), why);
    }
}

/// Regression: the fault of a run hid that its telemetry was cut.
#[test]
fn a_fault_does_not_hide_that_rows_are_missing() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut recorder = recorder_in(folder.path());
    let sidecar = recorder.sidecar().to_owned();
    recorder.failed = Some(RecordError::write(
        recorder.csv(),
        io::ErrorKind::StorageFull,
    ));
    let lost = Ending::Lost("gone".to_owned());
    assert!(recorder.finish(lost, 0).is_err());
    let error = TrialRecord::read(&sidecar)
        .expect("a sidecar")
        .error
        .expect("two");
    for said in [
        "gone; ",
        "the telemetry was not recorded whole",
        "no storage space",
    ] {
        assert!(error.contains(said), "{error}");
    }
}

/// Regression: what was recorded was too long for its own reader.
#[test]
fn no_record_grows_beyond_what_is_read() {
    let longest = RigSample {
        time_us: u64::MAX,
        state: "acknowledge".to_owned(),
        position_mm: decimal::write_signed(i64::from(i32::MIN) * 1_000_000, 6),
        speed_mm_s: decimal::write_signed(i32::MIN.into(), 3),
        stroke: u32::MAX,
        position_steps: i32::MIN,
        commanded_steps: i32::MIN,
        residual_steps: i32::MIN,
        home_flag_open: false,
        far_limit_open: false,
        estop_loop_open: false,
        missed: u16::MAX,
        origin: Origin::Virtual,
    };
    let mut csv = csv::WriterBuilder::new()
        .has_headers(false)
        .from_writer(vec![]);
    csv.serialize(&longest).expect("memory");
    let row = csv.into_inner().expect("memory").len() as u64;
    assert!(row <= plain::ROW, "{row}");

    let folder = tempfile::tempdir().expect("a folder");
    let mut recorder = recorder_in(folder.path());
    recorder.trial.samples = plain::ROWS - 1;
    recorder.row(&longest);
    assert!(recorder.news().is_none());
    recorder.row(&longest);
    let told = recorder.news().expect("one too many").to_string();
    assert!(told.contains("10000000 rows"), "{told}");
    let sidecar = recorder.sidecar().to_owned();
    assert!(recorder.finish(Ending::Lost("gone".to_owned()), 0).is_err());
    let read = TrialRecord::read(&sidecar).expect("a sidecar");
    assert_eq!(read.samples, 1);
    assert!(read.not_whole().is_some());
}

/// The manual has the schema of a sidecar and, in `$defs`, of the rows of both CSV files, as the types say it that write
/// them. `INSTA_UPDATE=always cargo test -p lab schema` writes it anew.
#[test]
fn the_manual_has_the_schema_of_records() {
    let settings = schemars::generate::SchemaSettings::draft2020_12();
    let mut generator = settings.for_serialize().into_generator();
    generator.subschema_for::<RigSample>();
    generator.subschema_for::<CapsuleSample>();
    let schema = json(&generator.into_root_schema_for::<TrialRecord>()).expect("JSON");
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../docs/records.schema.json"
    );
    if std::env::var("INSTA_UPDATE").is_ok_and(|what| what == "always") {
        fs::write(path, &schema).expect("written");
    }
    let kept = fs::read(path).unwrap_or_default();
    assert!(
        kept == schema,
        "docs/records.schema.json is not as the code writes records"
    );
}
