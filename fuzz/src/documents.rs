//! Target: files that somebody else may have written, one of each kind that the tool reads: plan, settings, model,
//! owner of a line, commissioning, fetched record.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use calibration::prior::unknowns;
use client::address::Address;
use client::door::lock::{Doorway, OwnerFile};
use client::identity::Origin;
use client::link::owner::Owner;
use client::subject::Subject;
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::campaign::order::order;
use lab::campaign::plan::CampaignPlan;
use lab::commissioning::record::{Commissioning, StepOutcome, StepResult};
use lab::trials::fetched;
use locomotion::model::Model;
use protocol::settings::SettingKey;
use protocol::system::DeviceKind;
use report::science::model_file;
use report::science::posterior::{FORMAT, Posterior};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use simulated_machines::machine::{Log, Script, link};
use tempfile::TempDir;

use crate::bench::{Bench, absent};
use crate::command;
use crate::host::RUN;
use crate::script::steps;
use crate::text::Change;

/// Most changes of a script that are tried.
const MOST_CHANGES: usize = 8;

/// A kind of file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Kind {
    /// Plan of a campaign.
    Plan,
    /// Settings to import.
    Settings,
    /// Model with a posterior.
    Model,
    /// File of the owner of a line, for other processes.
    Owner,
    /// Record of a commissioning.
    Commissioning,
    /// A machine's own record, as fetched.
    Fetched,
}

/// One file of each kind.
struct Samples {
    place: TempDir,
    texts: [Vec<u8>; 6],
}

/// Runs a script.
///
/// # Panics
/// A file makes the tool panic, is taken up in part, or is read as another one than is written again.
pub fn target(data: &[u8]) {
    static SAMPLES: OnceLock<Mutex<Samples>> = OnceLock::new();
    let Ok((kind, data)) = postcard::take_from_bytes::<Kind>(data) else {
        return;
    };
    let samples = SAMPLES.get_or_init(|| Mutex::new(Samples::new()));
    // The lock reserves the folder until the script ends.
    let samples = samples.lock().unwrap_or_else(PoisonError::into_inner);
    let mut bytes = samples.texts[kind as usize].clone();
    for change in steps::<Change>(data).take(MOST_CHANGES) {
        change.make(&mut bytes);
    }
    let folder = samples.place.path();
    match kind {
        Kind::Plan => plan(folder, &bytes),
        Kind::Settings => settings(folder, &bytes),
        Kind::Model => model(folder, &bytes),
        Kind::Owner => owner(folder, &bytes),
        Kind::Commissioning => commissioning(folder, &bytes),
        Kind::Fetched => fetched_record(folder, &bytes),
    }
}

fn file(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let file = folder.join(name);
    fs::write(&file, bytes).expect("a folder");
    file
}

fn of(path: &Path) -> &str {
    path.to_str().expect("UTF-8")
}

/// Runs a command line that needs no machine.
fn alone(args: &[&str]) -> (u8, String) {
    command::run(args, &Bench(|_| Err(absent())))
}

fn plan(folder: &Path, bytes: &[u8]) {
    let file = file(folder, "plan.toml", bytes);
    let text = std::str::from_utf8(bytes).unwrap_or("not a plan");
    if let Ok(plan) = CampaignPlan::parse(text, &file) {
        assert!(!order(&plan).is_empty() && plan.run_s().is_finite());
        return;
    }
    let out = folder.join("campaign");
    let args = ["campaign", "new", of(&file), "--out", of(&out)];
    let (code, said) = alone(&args);
    assert_ne!(code, 0, "{said}");
    assert!(!out.exists(), "made of a plan that cannot be read");
}

/// Either all settings are those of the file afterwards, or none has changed.
fn settings(folder: &Path, bytes: &[u8]) {
    let file = file(folder, "settings.json", bytes);
    let log: Mutex<Option<Arc<Mutex<Log>>>> = Mutex::default();
    let bench = Bench(|_| {
        let (link, new) = link(rig());
        *log.lock().unwrap_or_else(PoisonError::into_inner) = Some(new);
        Ok(link)
    });
    let args = ["--rig", "/bench", "settings", "import", of(&file)];
    let (code, said) = command::run(&args, &bench);
    let log = log.lock().unwrap_or_else(PoisonError::into_inner);
    let Some(log) = &*log else {
        assert_ne!(code, 0, "{said}");
        return;
    };
    let log = log.lock().unwrap_or_else(PoisonError::into_inner);
    if code != 0 {
        assert_eq!((log.settings(), log.name()), untouched(), "{said}");
        return;
    }
    let wanted: Value = serde_json::from_slice(bytes).expect("JSON");
    assert_eq!(wanted["name"], log.name());
    for (key, value) in SettingKey::ALL.iter().zip(log.settings()) {
        if let Some(wanted) = wanted["settings"].get(key.name()) {
            assert_eq!(wanted.as_u64(), Some(value.into()), "{}", key.name());
        }
    }
}

fn model(folder: &Path, bytes: &[u8]) {
    let text = std::str::from_utf8(bytes).unwrap_or("not a model");
    let built = model_file::read(text).ok().and_then(|read| {
        let body = read.body.as_deref().unwrap_or("one");
        let model = model_file::build(body, &read.choices).ok()?;
        model.check().ok()?;
        Some((model, read.posterior))
    });
    let Some((model, posterior)) = built else {
        let (file, out) = (file(folder, "model.toml", bytes), folder.join("simulation"));
        let args = ["simulate", "--model", of(&file), "--out", of(&out)];
        let (code, said) = alone(&args);
        assert_ne!(code, 0, "{said}");
        return;
    };
    command::check(&client::visible::lines(&model_file::origin(
        &model,
        posterior.as_ref(),
    )));
    let written = model_file::write(&model, posterior.as_ref());
    let again = model_file::read(&written).expect("what was written");
    let body = again.body.as_deref().unwrap_or("one");
    let model = model_file::build(body, &again.choices).expect("what was written");
    let once_more = model_file::write(&model, again.posterior.as_ref());
    assert_eq!(once_more, written);
}

/// Whatever an owner has left, the line can be taken, and nothing is printed of it that a terminal obeys.
fn owner(folder: &Path, bytes: &[u8]) {
    let line = file(folder, "line", b"");
    let address = Address::Serial(of(&line).to_owned());
    let doorway = Doorway::within(folder, &address).expect("a line");
    let lock = doorway.claim().expect("a folder").expect("free");
    // The name is that of a hash, so it is found by being the only one.
    lock.announce().expect("a folder");
    let is_owner = |path: &PathBuf| path.extension().is_some_and(|end| end == "owner");
    let entries = fs::read_dir(folder).expect("a folder").flatten();
    let path = entries.map(|entry| entry.path()).find(is_owner);
    let path = path.expect("announced");
    drop(lock);
    fs::write(&path, bytes).expect("a folder");
    if let Some(owner) = doorway.owner() {
        command::check(&client::visible::lines(&owner.to_string()));
    }
    let left = doorway.owner_file().and_then(|file| file.recording);
    let lock = doorway.claim().expect("a folder").expect("free");
    assert_eq!(lock.left_record(), left);
    lock.left_has_ended();
    drop(lock);
    assert!(doorway.owner().is_none(), "it has left");
}

fn commissioning(folder: &Path, bytes: &[u8]) {
    let file = file(folder, "commissioning.json", bytes);
    match Commissioning::read(&file) {
        Ok(Some(record)) => {
            record.write(&file).expect("a folder");
            let again = Commissioning::read(&file).expect("what was written");
            assert_eq!(again, Some(record));
        }
        Ok(None) => panic!("the file is there"),
        Err(error) => command::check(&client::visible::lines(&error.to_string())),
    }
}

/// A fetched record is no trial, whatever it says; it lies in the folder of trials.
fn fetched_record(folder: &Path, bytes: &[u8]) {
    let folder = folder.join("records");
    fs::create_dir_all(&folder).expect("a folder");
    let file = file(&folder, "fetched-rig-19700101T000000Z.json", bytes);
    // With this beside it, it would be read like a trial.
    fs::write(file.with_extension("csv"), "").expect("a folder");
    let command = ["list", "verify", "report"][bytes.len() % 3];
    alone(&[command, of(&folder)]);
}

fn rig() -> Script {
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = true;
    script
}

/// Settings and name of a rig that nobody has touched.
fn untouched() -> (Vec<u32>, String) {
    static UNTOUCHED: OnceLock<(Vec<u32>, String)> = OnceLock::new();
    let before = UNTOUCHED.get_or_init(|| {
        let (_link, log) = link(rig());
        let log = log.lock().unwrap_or_else(PoisonError::into_inner);
        (log.settings(), log.name())
    });
    before.clone()
}

impl Samples {
    fn new() -> Self {
        let place = tempfile::tempdir().expect("a folder");
        let owner = OwnerFile {
            owner: Owner::this_process(),
            port: Some(7_000),
            token: "secret".to_owned(),
            recording: Some(place.path().join("run.json")),
        };
        let mut script = rig();
        script.few_steps = true;
        let mut device = Device::connect(link(script).0, DeviceKind::Rig, 1).expect("a rig");
        let accepted = device.home().expect("a rig");
        let homed = device.wait_homing(&accepted, &mut Unobserved);
        homed.expect("a rig");
        let accepted = device.run(RUN).expect("homed");
        let done = device.wait_run(&accepted, &mut Unobserved);
        done.expect("a run");
        let subject = Subject::of(&mut device).expect("a rig");
        let mut commissioning = Commissioning::new(&subject, Timestamp::UNIX_EPOCH);
        commissioning.steps.push(StepResult {
            step: "enable".to_owned(),
            shows: "the driver is off".to_owned(),
            outcome: StepOutcome::Failed,
            reason: Some("it is on".to_owned()),
            measured: serde_json::Map::new(),
            date_utc: Timestamp::UNIX_EPOCH,
            image: None,
            settings: subject.settings.clone(),
        });
        let fetched = fetched::fetch(&mut device, Timestamp::UNIX_EPOCH);
        let fetched = fetched.expect("a rig").expect("a run");
        let texts = [
            include_bytes!("../plan.toml").to_vec(),
            exported(),
            model_file::write(&Model::ONE, Some(&posterior())).into_bytes(),
            json(&owner),
            json(&commissioning),
            json(&fetched),
        ];
        Self { place, texts }
    }
}

fn json(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec_pretty(value).expect("JSON")
}

/// The settings of a rig, as an export writes them.
fn exported() -> Vec<u8> {
    let (values, _) = untouched();
    let settings = SettingKey::ALL.iter().zip(values);
    let settings: serde_json::Map<String, Value> = settings
        .filter(|(key, _)| key.is_of(DeviceKind::Rig))
        .map(|(key, value)| (key.name().to_owned(), value.into()))
        .collect();
    let file = serde_json::json!({ "name": "left bench", "settings": settings });
    json(&file)
}

fn posterior() -> Posterior {
    let names = unknowns().map(|unknown| unknown.key.to_owned());
    let parameters: Vec<_> = Model::ONE.parameters().collect();
    let of_body = |name: &String| {
        let row = parameters.iter().find(|row| row.name == name);
        row.map_or(0.1, |row| row.value)
    };
    Posterior {
        format: FORMAT,
        origin: Origin::Board,
        made_by: "retrograde".to_owned(),
        seed: 1,
        sampler: "none".to_owned(),
        r_hat: 1.0,
        ess: 100.0,
        reliable: false,
        reasons: vec!["it was made up".to_owned()],
        doubts: vec!["all".to_owned()],
        chi_square: Some(1.0),
        degrees: Some(3),
        point: 1,
        samples: vec![names.iter().map(of_body).collect()],
        parameters: names.to_vec(),
        source: vec![],
    }
}
