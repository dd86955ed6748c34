//! Folders of campaigns that somebody else made: nothing outside of them is read or written, nothing that was forged is
//! taken up or missed, and no command hangs.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::sync::{Barrier, mpsc};
use std::thread;
use std::time::Duration;

use crate::campaign::{SMALL, at, campaign, findings};
use crate::campaign_report::made;
use crate::support::offline::{retrograde, text};
use jiff::Timestamp;
use lab::campaign::chance::Chance;
use lab::campaign::contents::Campaign;
use lab::campaign::files::{ATTEMPTS, TRIALS};
use lab::campaign::folder::Folder;
use lab::campaign::manifest;

/// A word that stands in every file outside of the folder.
const SECRET: &str = "not-for-the-folder";
/// Time for a command that must not hang.
const SOON: Duration = Duration::from_secs(120);

fn seal(folder: &Path) {
    let new = manifest::of_folder(folder).expect("read").text();
    fs::write(folder.join(manifest::NAME), new).expect("written");
}

fn edit(file: &Path, change: impl Fn(&str) -> String) {
    let before = fs::read_to_string(file).expect("there");
    let after = change(&before);
    assert_ne!(after, before, "{}", file.display());
    fs::write(file, after).expect("written");
}

/// Changes the record of the first trial's first run.
fn edit_run(folder: &Path, change: impl Fn(&str) -> String) {
    let campaign = Campaign::read(folder).expect("read");
    edit(&campaign.run_sidecar(1, 1).expect("a run"), change);
}

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

// Forgeries.

/// Resumes at the given time, and tells what was asked.
fn resumed(path: &Path, now: Timestamp, accepts: bool) -> (Result<(), String>, Vec<String>) {
    let mut asked = vec![];
    let mut answer = |question: &str| {
        asked.push(question.to_owned());
        accepts
    };
    let result = Folder::resume(path, now, &mut answer);
    (result.map(drop).map_err(|error| error.why), asked)
}

#[test]
fn a_row_without_a_hash_is_asked_about_and_more_are_refused() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    drop(campaign(&path));
    let ledger = path.join(TRIALS);
    let sealed = fs::read_to_string(&ledger).expect("there");
    let last = sealed.lines().last().expect("a row");
    let number: u32 = last
        .split(',')
        .next()
        .expect("a number")
        .parse()
        .expect("one");
    let row = |more: u32, year: &str| {
        let time = last.split(',').nth(1).expect("a time");
        let row = last.replacen(&number.to_string(), &(number + more).to_string(), 1);
        row.replace(time, &time.replace("2026", year)) + "\n"
    };
    let after = at(1_000);
    for (rows, accepts, why) in [
        (
            row(1, "2026") + &row(2, "2026"),
            true,
            "2 rows are not in SHA256SUMS",
        ),
        (
            row(1, "1999"),
            true,
            "a row that is not in SHA256SUMS is of 1999",
        ),
        (row(1, "2031"), true, "its last row is of 2031"),
        (
            row(1, "2026"),
            false,
            "it has a row that is not in SHA256SUMS",
        ),
    ] {
        let forged = sealed.clone() + &rows;
        fs::write(&ledger, &forged).expect("written");
        let (result, _) = resumed(&path, after, accepts);
        let refused = result.expect_err(why);
        assert!(refused.contains(why), "{refused}");
        assert_eq!(fs::read_to_string(&ledger).expect("there"), forged);
    }
    fs::write(&ledger, sealed.clone() + &row(1, "2026")).expect("written");
    let (result, asked) = resumed(&path, after, true);
    result.expect("accepted");
    assert_eq!(asked.len(), 1);
    assert!(asked[0].contains(row(1, "2026").trim()), "{asked:?}");
    assert_eq!(findings(&path), Vec::<String>::new());
    // A clock that is far behind would write rows in the wrong order.
    let (result, _) = resumed(&path, at(-200_000), true);
    assert!(
        result
            .expect_err("behind")
            .contains("this computer's clock says")
    );
}

/// Rows that a crash cannot have left are neither taken up by an edit nor sealed by it. A single one is shown, and
/// nobody is at a terminal here who could say that it is theirs.
#[test]
fn an_edit_takes_up_no_forged_row() {
    let (_place, folder) = made();
    let ledger = folder.join(TRIALS);
    let sealed = fs::read_to_string(&ledger).expect("there");
    let list = fs::read(folder.join(manifest::NAME)).expect("there");
    let rows = sealed.lines().count();
    let row = |more: usize| {
        let number = rows - 1 + more;
        format!("{number},2026-01-21T12:55:00Z,note,1,,,,,,,,forged,board\n")
    };
    let (one, three) = (row(1), [1, 2, 3].map(row).concat());
    for (rows, why) in [(&one, one.trim()), (&three, "3 rows are not in SHA256SUMS")] {
        let forged = sealed.clone() + rows;
        fs::write(&ledger, &forged).expect("written");
        for edit in [
            &["undo", "1"][..],
            &["exclude", "1", "torn"],
            &["skip", "14"],
        ] {
            let args = [&["campaign", "edit", text(&folder)], edit].concat();
            let (code, _, err) = retrograde(&args);
            assert_ne!(code, 0, "{edit:?}");
            assert!(err.contains(why), "{edit:?}: {err}");
        }
        assert_eq!(fs::read_to_string(&ledger).expect("there"), forged);
        assert_eq!(fs::read(folder.join(manifest::NAME)).expect("there"), list);
        assert_ne!(findings(&folder), Vec::<String>::new());
    }
}

/// Each forgery is sealed with a new manifest, so that only the files themselves tell.
#[test]
fn what_was_forged_and_sealed_is_found() {
    type Forge = fn(&Path);
    let run_of = |folder: &Path, trial: u32| -> PathBuf {
        let campaign = Campaign::read(folder).expect("read");
        campaign.run_sidecar(trial, 1).expect("a run")
    };
    let cases: [(&str, Forge); 5] = [
        ("two attempts exchanged", |folder| {
            let [one, other, aside] =
                ["001-1", "002-1", "aside"].map(|name| folder.join(ATTEMPTS).join(name));
            fs::rename(&one, &aside).expect("moved");
            fs::rename(&other, &one).expect("moved");
            fs::rename(&aside, &other).expect("moved");
        }),
        ("a displacement's readings", |folder| {
            edit(&folder.join("readings.csv"), |text| {
                text.replace("22.4", "22.8")
            });
        }),
        ("a last row of the year 1999", |folder| {
            edit(&folder.join(TRIALS), |text| {
                let last = text.rfind("2026-").expect("a time");
                text[..last].to_owned() + &text[last..].replacen("2026-", "1999-", 1)
            });
        }),
        ("a start in 1999", |folder| {
            edit_run(folder, |text| {
                text.replacen("\"started_utc\": \"2026", "\"started_utc\": \"1999", 1)
            });
        }),
        ("another origin", |folder| {
            edit_run(folder, |text| {
                text.replace("\"origin\": \"board\"", "\"origin\": \"virtual\"")
            });
        }),
    ];
    for (what, forge) in cases {
        let (_place, folder) = made();
        assert_eq!(findings(&folder), Vec::<String>::new());
        forge(&folder);
        seal(&folder);
        assert_ne!(findings(&folder), Vec::<String>::new(), "{what}");
    }
    // Places in the telemetry that the counted and the commanded steps do not reach.
    let places: [&[(usize, &str)]; 2] = [&[(2, "50"), (5, "40000")], &[(6, "40000")]];
    for place in places {
        let (_place, folder) = made();
        let csv = run_of(&folder, 1).with_extension("csv");
        edit(&csv, |text| {
            let mut rows: Vec<Vec<&str>> =
                text.lines().map(|line| line.split(',').collect()).collect();
            let middle = rows.len() / 2;
            for (column, value) in place {
                rows[middle][*column] = value;
            }
            rows.iter().map(|row| row.join(",") + "\n").collect()
        });
        seal(&folder);
        assert_ne!(findings(&folder), Vec::<String>::new(), "{place:?}");
    }
}

/// Whoever has the tool can change a folder so that all its files agree. Only a seal that lies elsewhere tells.
#[test]
fn a_seal_tells_what_the_files_cannot() {
    let (_place, folder) = made();
    let verify = |more: &[&str]| retrograde(&[&["--json", "verify", text(&folder)], more].concat());
    let sealed = || {
        let (code, said, err) = verify(&[]);
        assert_eq!(code, 0, "{said}{err}");
        let said: serde_json::Value = serde_json::from_str(&said).expect("JSON");
        said["seal"].as_str().expect("a seal").to_owned()
    };
    let before = sealed();
    assert_eq!(verify(&["--seal", &before]).0, 0);
    // Typed from paper it may be in capitals; one of which digits are missing accuses nobody.
    let typed = format!(" {} ", before.to_uppercase());
    assert_eq!(verify(&["--seal", &typed]).0, 0);
    let other = format!("{}g", &before[1..]);
    for wrong in ["", "5d0f...", &before[1..], &other] {
        let (code, said, err) = verify(&["--seal", wrong]);
        assert_eq!(code, 2, "{said}{err}");
        assert!(said.contains("64 hexadecimal digits"), "{said}");
    }
    edit_run(&folder, |text| {
        text.replacen("\"note\": null", "\"note\": \"it was dry\"", 1)
    });
    seal(&folder);
    assert_ne!(sealed(), before);
    let (code, said, _) = verify(&["--seal", &before]);
    assert_eq!(code, 1, "{said}");
    assert!(said.contains("is not the one that was sealed"), "{said}");
    fs::remove_file(folder.join(manifest::NAME)).expect("removed");
    assert_eq!(verify(&["--seal", &before]).0, 1);
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
    seal(&folder);
    let error = Campaign::read(&folder).expect_err("a link");
    assert!(error.path.ends_with("trials/001-1"), "{error:?}");
    for command in [
        &["verify"][..],
        &["report", "--force"],
        &["fit"],
        &["campaign", "status"],
    ] {
        let args = [command, &[text(&folder)]].concat();
        let (code, _, err) = retrograde(&args);
        assert_ne!(code, 0, "{args:?}");
        assert!(
            ["verify", "fit"].contains(&command[0]) || err.contains("nothing is read through it"),
            "{args:?}: {err}"
        );
    }
}

/// Links in the place of a report's files, of their parts, and of its folder. `verify` does not look at a report.
#[test]
fn a_report_writes_through_no_link() {
    let (place, folder) = made();
    let at = |name: &str| place.path().join(name);
    fs::write(at("victim"), SECRET).expect("written");
    fs::create_dir(at("elsewhere")).expect("a folder");
    let report = folder.join("report");
    fs::create_dir(&report).expect("a folder");
    for name in [
        "report.html",
        "report.html.part",
        "figure7.svg.part",
        "trials.csv",
    ] {
        symlink(at("victim"), report.join(name)).expect("a link");
    }
    for name in ["trials.csv.part", "attempts.csv", "readings.csv.part"] {
        symlink(at("new"), report.join(name)).expect("a link");
    }
    let args = ["report", text(&folder), "--force"];
    let (code, said, err) = retrograde(&args);
    assert_eq!(code, 0, "{said}{err}");
    assert_eq!(fs::read_to_string(at("victim")).expect("there"), SECRET);
    assert!(!at("new").exists());
    assert!(
        report
            .join("report.html")
            .symlink_metadata()
            .expect("a page")
            .is_file()
    );
    fs::remove_dir_all(&report).expect("removed");
    symlink(at("elsewhere"), &report).expect("a link");
    for args in [&args[..2], &args] {
        let (code, _, err) = retrograde(args);
        assert_ne!(code, 0, "{args:?}");
        assert!(err.contains("nothing is written through it"), "{err}");
    }
    assert_eq!(entries(&at("elsewhere")), Vec::<PathBuf>::new());
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
        ("pipe.csv", "it is no plain file"),
    ] {
        let named = |name: &str| format!("\"telemetry\": \"{name}\"");
        let forged = record.replace(&named(&name), &named(elsewhere));
        assert_ne!(forged, record);
        fs::write(&sidecar, forged).expect("written");
        for place in [text(&folder), text(attempt)] {
            for command in ["verify", "list", "report"] {
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
    let was_folder = path.is_dir();
    let kind = chance.below(7);
    let what = match kind {
        // A copy of the file lies outside, so that a reader that follows the link finds nothing wrong.
        0 | 1 => {
            let copy = outside.join("copy");
            if was_folder {
                fs::rename(&path, &copy).expect("moved");
                fs::write(
                    copy.join("conditions.json"),
                    format!("{{\"note\": \"{SECRET}\"}}"),
                )
                .expect("written");
            } else {
                fs::rename(&path, &copy).expect("moved");
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
            for part in [
                "report.html.part",
                "report",
                "SHA256SUMS.part",
                "trials.csv.part",
            ] {
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
        let mut commands = vec![
            vec!["verify".to_owned(), at.clone()],
            vec!["list".to_owned(), at.clone()],
            vec!["campaign".to_owned(), "status".to_owned(), at.clone()],
        ];
        // Figures take longest.
        if number % 4 == 0 {
            commands.push(vec!["report".to_owned(), at.clone(), "--force".to_owned()]);
        }
        let mut codes = vec![];
        for command in commands {
            let name = command[0].clone();
            let (code, said) = run(command);
            assert!(!said.contains(SECRET), "{number}, {what}, {name}: {said}");
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
