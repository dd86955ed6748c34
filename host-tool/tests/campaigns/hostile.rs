//! Folders of campaigns that somebody else made: nothing outside of them is read or written, nothing that was forged is
//! taken up or missed, and no command hangs.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::{Barrier, mpsc};
use std::thread;
use std::time::Duration;

use crate::campaign::{SMALL, findings, relist};
use crate::campaign_report::made;
use crate::support::offline::{retrograde, text};
use lab::campaign::chance::Chance;
use lab::campaign::contents::Campaign;
use lab::campaign::files::ATTEMPTS;
use lab::campaign::folder::Folder;
use lab::campaign::manifest;

/// A word that stands in every file outside of the folder.
const SECRET: &str = "not-for-the-folder";
/// Time for a command that must not hang.
const SOON: Duration = Duration::from_secs(120);

// Creation.

#[test]
fn three_that_make_one_campaign_at_once_make_one() {
    for _ in 0..20 {
        let place = tempfile::tempdir().expect("a folder");
        let path = place.path().join("small");
        let together = Barrier::new(3);
        let new = || {
            together.wait();
            Folder::create(&path, SMALL, Path::new("small.toml"))
        };
        let made: Vec<_> = thread::scope(|scope| {
            let all = [(); 3].map(|()| scope.spawn(new));
            all.map(|one| one.join().expect("no panic")).into()
        });
        let refused: Vec<_> = made.iter().filter_map(|one| one.as_ref().err()).collect();
        assert_eq!(refused.len(), 2, "{refused:?}");
        for error in refused {
            assert!(error.why.contains("it exists already"), "{error:?}");
        }
        drop(made);
        assert_eq!(findings(&path), Vec::<String>::new());
        let left = fs::read_dir(place.path()).expect("there").count();
        assert_eq!(left, 1, "no part is left");
    }
}

// Links, pipes and devices.

/// The folder of an attempt may be complete elsewhere: it is still not this campaign's.
#[test]
fn an_attempt_that_is_a_link_is_not_read() {
    let (place, folder) = made();
    let attempt = folder.join(ATTEMPTS).join("001-1");
    let elsewhere = place.path().join("elsewhere");
    fs::rename(&attempt, &elsewhere).expect("moved");
    symlink(&elsewhere, &attempt).expect("a link");
    relist(&folder);
    let error = Campaign::read(&folder).expect_err("a link");
    assert!(error.path.ends_with("trials/001-1"), "{error:?}");
    for command in [
        &["verify"][..],
        &["report", "--force"],
        &["campaign", "status"],
    ] {
        let args = [command, &[text(&folder)]].concat();
        let (code, _, err) = retrograde(&args);
        assert_ne!(code, 0, "{args:?}");
        assert!(
            command[0] == "verify" || err.contains("nothing is read through it"),
            "{args:?}: {err}"
        );
    }
}

/// A record names the file of its telemetry. It may name no file elsewhere, no device and no pipe.
#[test]
fn telemetry_is_read_beside_its_record_only() {
    let (place, folder) = made();
    let campaign = Campaign::read(&folder).expect("read");
    let sidecar = campaign.run_sidecar(1, 1).expect("a run");
    let (csv, attempt) = (
        sidecar.with_extension("csv"),
        sidecar.parent().expect("a folder"),
    );
    let name = csv
        .file_name()
        .expect("a name")
        .to_string_lossy()
        .into_owned();
    let outside = place.path().join("secret.csv");
    // The rows are right, so that a reader that opens them finds nothing wrong but the word.
    let rows = fs::read_to_string(&csv).expect("there");
    fs::write(&outside, rows + SECRET + "\n").expect("written");
    fifo(&attempt.join("pipe.csv"));
    let record = fs::read_to_string(&sidecar).expect("there");
    for (elsewhere, why) in [
        ("/dev/zero", "telemetry lies beside its sidecar"),
        ("../../../secret.csv", "telemetry lies beside its sidecar"),
        (text(&outside), "telemetry lies beside its sidecar"),
        ("pipe.csv", "it is not a regular file"),
    ] {
        let named = |name: &str| format!("\"telemetry\": \"{name}\"");
        let forged = record.replace(&named(&name), &named(elsewhere));
        assert_ne!(forged, record);
        fs::write(&sidecar, forged).expect("written");
        for place in [text(&folder), text(attempt)] {
            for command in ["verify", "report"] {
                let args = [command, place].map(str::to_owned);
                let (code, said) = run(args.to_vec());
                assert!(!said.contains(SECRET), "{elsewhere}, {command}: {said}");
                let tells = command == "verify" && place == text(attempt);
                assert!(
                    !tells || code != 0 && said.contains(why),
                    "{elsewhere}: {said}"
                );
            }
        }
    }
}

fn fifo(path: &Path) {
    let mode = rustix::fs::Mode::from_raw_mode(0o600);
    rustix::fs::mkfifoat(rustix::fs::CWD, path, mode).expect("a pipe");
}

/// Entries of a folder and below, files and folders.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let mut all = vec![];
    for entry in fs::read_dir(folder).expect("there").flatten() {
        all.push(entry.path());
        if entry.file_type().expect("a kind").is_dir() {
            all.extend(entries(&entry.path()));
        }
    }
    all.sort();
    all
}

/// Contents of all plain files below a folder.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let plain = |path: &PathBuf| path.symlink_metadata().is_ok_and(|found| found.is_file());
    let files = entries(folder).into_iter().filter(plain);
    files
        .map(|path| (path.clone(), fs::read(path).expect("read")))
        .collect()
}

fn remove(path: &Path) {
    match path.symlink_metadata().expect("there").is_dir() {
        true => fs::remove_dir_all(path).expect("removed"),
        false => fs::remove_file(path).expect("removed"),
    }
}

/// Puts something in the place of an entry that no tool of ours puts there. Returns the change in words.
fn spoil(chance: &mut Chance, folder: &Path, outside: &Path) -> String {
    let all = entries(folder);
    let path = all[chance.below(all.len())].clone();
    let name = path
        .strip_prefix(folder)
        .expect("below")
        .display()
        .to_string();
    let kind = chance.below(7);
    let what = match kind {
        // A copy of the file lies outside, so that a reader that follows the link finds nothing wrong.
        0 | 1 => {
            let copy = outside.join("copy");
            fs::rename(&path, &copy).expect("moved");
            if copy.is_dir() {
                let note = format!("{{\"note\": \"{SECRET}\"}}");
                fs::write(copy.join("conditions.json"), note).expect("written");
            }
            symlink(&copy, &path).expect("a link");
            "a link to its copy outside"
        }
        2 => {
            remove(&path);
            symlink(outside.join("secret.json"), &path).expect("a link");
            "a link to a file outside"
        }
        3 => {
            remove(&path);
            symlink("/dev/zero", &path).expect("a link");
            "a link to a device"
        }
        4 => {
            remove(&path);
            fifo(&path);
            "a pipe"
        }
        5 => {
            remove(&path);
            File::create_new(&path)
                .expect("new")
                .set_len(1 << 40)
                .expect("set");
            "a file of 1 TiB"
        }
        _ => {
            for part in "report.html.part report SHA256SUMS.part trials.csv.part".split(' ') {
                let link = folder.join(part);
                if !link.exists() && symlink(outside.join("secret.json"), &link).is_err() {
                    continue;
                }
            }
            return "links with names of ours".to_owned();
        }
    };
    format!("{name}: {what}")
}

/// Runs a command; fails if it hangs or panics. Returns its code and all that it printed.
fn run(args: Vec<String>) -> (u8, String) {
    let (done, wait) = mpsc::channel();
    let line = args.clone();
    thread::spawn(move || {
        let args: Vec<&str> = line.iter().map(String::as_str).collect();
        let (code, out, err) = retrograde(&args);
        let _ = done.send((code, out + &err));
    });
    wait.recv_timeout(SOON)
        .unwrap_or_else(|_| panic!("it hangs or panics: {args:?}"))
}

#[test]
fn a_hundred_hostile_folders_lead_nowhere_and_hang_nothing() {
    let mut chance = Chance::new(20_261_125);
    let mut refused = 0;
    for number in 0..100 {
        let (place, folder) = made();
        let outside = place.path().join("outside");
        fs::create_dir(&outside).expect("a folder");
        fs::write(outside.join("secret.json"), format!("{{\"{SECRET}\": 1}}")).expect("written");
        let mut what = spoil(&mut chance, &folder, &outside);
        if chance.below(2) == 0 {
            // Rebuilt by somebody who has the tool, as far as it can be.
            if let Ok(new) = manifest::of_folder(&folder) {
                let list = folder.join(manifest::NAME);
                if list.symlink_metadata().is_ok_and(|found| found.is_file()) {
                    fs::write(list, new.text()).expect("written");
                    what += ", sealed";
                }
            }
        }
        let before = contents(&outside);
        let at = text(&folder).to_owned();
        // Figures take longest.
        let reports = number % 4 == 0;
        let mut commands = vec!["verify", "campaign status"];
        commands.extend(reports.then_some("report --force"));
        let mut codes = vec![];
        for command in commands {
            let words = command.split(' ').map(str::to_owned);
            let (code, said) = run(words.chain([at.clone()]).collect());
            assert!(
                !said.contains(SECRET),
                "{number}, {what}, {command}: {said}"
            );
            codes.push(code);
        }
        // `report/` is not covered by the manifest, and a folder without it is whole.
        let harmless = what.starts_with("report") || what.starts_with("links");
        assert!(
            codes[0] != 0 || harmless,
            "{number}, {what}: verify is content"
        );
        refused += u32::from(codes[0] != 0);
        assert_eq!(contents(&outside), before, "{number}, {what}");
        let report = folder.join("report");
        let is_folder = report.symlink_metadata().is_ok_and(|found| found.is_dir());
        let pages = match is_folder {
            true => contents(&report),
            false => BTreeMap::new(),
        };
        for (path, bytes) in pages {
            let leaked = bytes
                .windows(SECRET.len())
                .any(|part| part == SECRET.as_bytes());
            assert!(!leaked, "{number}, {what}: {}", path.display());
        }
    }
    assert!(refused >= 70, "{refused}");
}
