//! `flash` examines the image first and asks the board afterwards. A program in place of `probe-rs` records its
//! arguments.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::support::bench::Bench;
use crate::support::tool;
use client::address::Address;
use client::door::lock::Doorway;
use client::link::{Link, OpenError};
use lab::operations::connector::{Candidate, Connector, Purpose};
use protocol::system::DeviceKind;
use serde_json::Value;

/// A 32-bit ELF file with two segments and symbols.
struct Elf {
    machine: u16,
    kind: u16,
    vectors_at: u32,
    code_at: u32,
    stack: u32,
    reset: u32,
    crate_name: &'static str,
    /// Fingerprint of the code.
    fingerprint: u32,
}

/// Words of code with this fingerprint. The last word is chosen to give it.
fn code(fingerprint: u32) -> [u32; 8] {
    const PRIME: u32 = 0x0100_0193;
    // Newton's iteration doubles the number of correct bits each time; an odd number is its own inverse modulo 8.
    let inverse = (0..4).fold(PRIME, |inverse, _| {
        inverse.wrapping_mul(2_u32.wrapping_sub(PRIME.wrapping_mul(inverse)))
    });
    let mut code = [0x4770_4770; 8];
    let before = code[..7].iter().fold(0x811C_9DC5_u32, |hash, word| {
        (hash ^ word).wrapping_mul(PRIME)
    });
    code[7] = before ^ fingerprint.wrapping_mul(inverse);
    code
}

impl Elf {
    fn of(crate_name: &'static str) -> Self {
        Self {
            machine: 40,
            kind: 2,
            vectors_at: 0x0800_0000,
            code_at: 0x0801_0000,
            stack: 0x2001_FC00,
            reset: 0x0801_0001,
            crate_name,
            fingerprint: 0x1234_5678,
        }
    }

    fn rig() -> Self {
        Self::of("_ZN12firmware_rig5board4main17h0E")
    }

    fn write(&self, path: &Path) {
        let half = |value: u16| value.to_le_bytes().to_vec();
        let word = |value: u32| value.to_le_bytes().to_vec();
        let words = |values: &[u32]| values.iter().copied().flat_map(word).collect::<Vec<_>>();
        let code = words(&code(self.fingerprint));
        let vectors = words(&[self.stack, self.reset]);
        let (vectors_from, code_from) = (0x100, 0x110);
        let code_end = self.code_at + code.len() as u32;
        let mut names = vec![0];
        let mut symbols = words(&[0; 4]);
        for (name, value) in [
            ("__stext", self.code_at),
            ("__sdata", 0x2000_0000),
            ("__edata", 0x2000_0000),
            ("__sidata", code_end),
            (self.crate_name, self.code_at),
        ] {
            symbols.extend(words(&[names.len() as u32, value, 0]));
            // A global function at a fixed address.
            symbols.extend([0x12, 0]);
            symbols.extend(half(0xFFF1));
            names.extend(name.as_bytes());
            names.push(0);
        }
        let symbols_from = 0x200_u32;
        let names_from = symbols_from + symbols.len() as u32;
        let sections_from = (names_from + names.len() as u32).next_multiple_of(4);
        let mut file = b"\x7fELF\x01\x01\x01\0\0\0\0\0\0\0\0\0".to_vec();
        file.extend([half(self.kind), half(self.machine)].concat());
        file.extend(words(&[1, self.reset, 52, sections_from, 0]));
        file.extend([52, 32, 2, 40, 3, 2].map(half).concat());
        for (from, at, part) in [
            (vectors_from, self.vectors_at, &vectors),
            (code_from, self.code_at, &code),
        ] {
            let length = part.len() as u32;
            file.extend(words(&[1, from, at, at, length, length, 5, 4]));
        }
        let mut put = |from: u32, bytes: &[u8]| {
            assert!(file.len() <= from as usize);
            file.resize(from as usize, 0);
            file.extend(bytes);
        };
        put(vectors_from, &vectors);
        put(code_from, &code);
        put(symbols_from, &symbols);
        put(names_from, &names);
        let section = |kind, from, length, link, info, entry| {
            words(&[0, kind, 0, 0, from, length, link, info, 1, entry])
        };
        let table = [
            section(0, 0, 0, 0, 0, 0),
            section(2, symbols_from, symbols.len() as u32, 2, 1, 16),
            section(3, names_from, names.len() as u32, 0, 0, 0),
        ];
        put(sections_from, &table.concat());
        fs::write(path, file).expect("written");
    }
}

/// A machine, a folder for images, and the program in place of `probe-rs`.
struct Bay {
    bench: Bench,
}

impl Bay {
    fn new(kind: DeviceKind) -> Self {
        let bench = Bench::on_tcp(kind);
        let program = bench.folder.path().join("probe-rs");
        let text = format!(
            "#!/bin/sh\necho \"$@\" >> '{}/told'\n",
            bench.folder.path().display()
        );
        fs::write(&program, text).expect("written");
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).expect("mine");
        Self { bench }
    }

    fn image(&self, elf: &Elf) -> PathBuf {
        let path = self.bench.folder.path().join("image");
        elf.write(&path);
        path
    }

    fn flash(&self, machine: &str, image: &Path, more: &[&str]) -> (Option<i32>, String, String) {
        let image = image.to_str().expect("UTF-8");
        let args = [&["flash", machine, "--image", image], more].concat();
        let mut command = self.bench.command(&args);
        let path = std::env::var("PATH").expect("a path");
        let folder = self.bench.folder.path().display();
        command.env("PATH", format!("{folder}:{path}"));
        crate::support::bench::read(command.output().expect("starts"))
    }

    /// Arguments that `probe-rs` was given.
    fn told(&self) -> String {
        fs::read_to_string(self.bench.folder.path().join("told")).unwrap_or_default()
    }
}

#[test]
fn what_is_no_image_of_this_machine_is_refused_before_a_probe_is_touched() {
    let bay = Bay::new(DeviceKind::Rig);
    let folder = bay.bench.folder.path();
    for (elf, says) in [
        (
            Elf {
                machine: 62,
                ..Elf::rig()
            },
            "another processor",
        ),
        (
            Elf {
                kind: 1,
                ..Elf::rig()
            },
            "another processor",
        ),
        (
            Elf {
                vectors_at: 0,
                ..Elf::rig()
            },
            "outside this chip's flash",
        ),
        (
            Elf {
                code_at: 0x0807_FFF0,
                ..Elf::rig()
            },
            "outside this chip's flash",
        ),
        (
            Elf {
                code_at: 0x0800_4000,
                ..Elf::rig()
            },
            "where the settings are kept",
        ),
        (
            Elf {
                code_at: 0x0800_FFF0,
                ..Elf::rig()
            },
            "where the settings are kept",
        ),
        (
            Elf {
                stack: 0x2002_0008,
                ..Elf::rig()
            },
            "cannot start this chip",
        ),
        (
            Elf {
                stack: 0x2001_FC04,
                ..Elf::rig()
            },
            "cannot start this chip",
        ),
        (
            Elf {
                reset: 0x0801_0000,
                ..Elf::rig()
            },
            "cannot start this chip",
        ),
        (
            Elf {
                reset: 0x0802_0001,
                ..Elf::rig()
            },
            "cannot start this chip",
        ),
        (
            Elf {
                vectors_at: 0x0800_0100,
                ..Elf::rig()
            },
            "cannot start this chip",
        ),
        (
            Elf::of("_ZN16firmware_capsule5board4main17h0E"),
            "the image of the capsule, not of the rig",
        ),
        (Elf::of("main"), "neither the image of the rig nor"),
    ] {
        let image = bay.image(&elf);
        let (code, _, err) = bay.flash("rig", &image, &[]);
        assert_eq!(code, Some(2), "{says}: {err}");
        assert!(err.contains(says), "{says}: {err}");
        assert!(err.contains("nothing was flashed"), "{says}: {err}");
    }
    let cut = folder.join("cut");
    let whole = fs::read(bay.image(&Elf::rig())).expect("an image");
    fs::write(&cut, &whole[..200]).expect("written");
    for path in [
        "/etc/passwd",
        "/dev/zero",
        "/",
        env!("CARGO_BIN_EXE_retrograde"),
        cut.to_str().expect("UTF-8"),
    ] {
        let (code, _, err) = bay.flash("rig", Path::new(path), &[]);
        assert_eq!(code, Some(2), "{path}: {err}");
        assert!(err.contains("cannot be flashed"), "{path}: {err}");
    }
    assert_eq!(bay.told(), "");
}

#[test]
fn a_dry_run_looks_and_touches_nothing() {
    let bay = Bay::new(DeviceKind::Rig);
    let image = bay.image(&Elf::rig());
    let (code, out, err) = bay.flash("rig", &image, &["--dry-run", "--json"]);
    assert_eq!(code, Some(0), "{err}");
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!(
        (&json["dry_run"], &json["bytes"]),
        (&true.into(), &40.into())
    );
    assert_eq!((bay.told(), bay.bench.connections()), (String::new(), 0));
}

#[test]
fn a_capsule_is_flashed_and_says_who_it_is() {
    let bay = Bay::new(DeviceKind::Capsule);
    let image = bay.image(&Elf::of("_ZN16firmware_capsule5board4main17h0E"));
    let (code, out, err) = bay.flash("capsule", &image, &["--probe", "0483:374b:1"]);
    assert_eq!(code, Some(0), "{err}");
    assert!(out.contains("Flashed. capsule"), "{out}");
    let told = bay.told();
    let lines: Vec<_> = told.lines().collect();
    assert_eq!(lines.len(), 2, "{told}");
    assert!(
        lines[0].starts_with("download --chip STM32F411RETx "),
        "{told}"
    );
    assert!(lines[1].starts_with("reset --chip STM32F411RETx"), "{told}");
    assert!(
        lines
            .iter()
            .all(|line| line.ends_with("--probe 0483:374b:1"))
    );
}

#[test]
fn a_rig_is_flashed_when_it_runs_the_image_afterwards() {
    let bay = Bay::new(DeviceKind::Rig);
    let (_, out, err) = bay.bench.retrograde(&["--json", "health"]);
    let json: Value = serde_json::from_str(&out).expect(&err);
    let running = json["health"]["image_hash"].as_u64().expect("a number");
    let image = bay.image(&Elf {
        fingerprint: running as u32,
        ..Elf::rig()
    });
    let (code, out, err) = bay.flash("rig", &image, &["--json"]);
    assert_eq!(code, Some(0), "{err}");
    let json: Value = serde_json::from_str(&out).expect("one object");
    assert_eq!(json["fingerprint"], format!("{running:08x}"));
    assert_eq!(json["identity"]["device"], "rig");
    assert_eq!(bay.told().lines().count(), 2);
}

#[test]
fn a_rig_that_runs_another_image_afterwards_is_not_called_flashed() {
    let bay = Bay::new(DeviceKind::Rig);
    let image = bay.image(&Elf::rig());
    let (code, _, err) = bay.flash("rig", &image, &[]);
    assert_eq!(code, Some(1), "{err}");
    assert!(err.contains("the machine here runs image"), "{err}");
}

#[test]
fn a_machine_that_is_at_work_is_not_flashed() {
    let bay = Bay::new(DeviceKind::Rig);
    let mut run = bay.bench.run(&[]);
    let image = bay.image(&Elf::rig());
    let (code, _, err) = bay.flash("rig", &image, &[]);
    assert_eq!(code, Some(3), "{err}");
    assert!(err.contains(&format!("process {}", run.id())), "{err}");
    assert_eq!(bay.told(), "");
    run.kill().expect("killed");
    run.wait().expect("ended");
}

/// Its run goes on without a process that owns the line; flashing resets the board, and "Nothing moves." was said first.
#[test]
fn a_machine_whose_run_goes_on_without_its_host_is_not_flashed() {
    let mut bay = Bay::new(DeviceKind::Rig);
    let mut run = bay
        .bench
        .run(&["--on-link-loss", "finish", "--duration-s", "60"]);
    run.kill().expect("killed");
    run.wait().expect("ended");
    let image = bay.image(&Elf::rig());
    let (code, out, err) = bay.flash("rig", &image, &[]);
    assert_eq!(code, Some(3), "{out}{err}");
    assert!(err.contains("is not at rest: Running"), "{err}");
    assert!(err.contains("`retrograde stop rig`"), "{err}");
    assert!(!out.contains("Nothing moves"), "{out}");
    assert_eq!(bay.told(), "");
    let (code, out, err) = bay.bench.retrograde(&["stop", "rig"]);
    assert_eq!(code, Some(0), "{out}{err}");
    let begin = Instant::now();
    while !bay.bench.retrograde(&["info", "rig"]).1.contains("Ready") {
        assert!(begin.elapsed() < Duration::from_secs(60), "it moves on");
    }
    bay.flash("rig", &image, &[]);
    assert_eq!(bay.told().lines().count(), 2);
    // A board that does not answer may be flashed: that may be what it needs.
    bay.bench.address = "tcp:127.0.0.1:1".to_owned();
    let (_, _, err) = bay.flash("rig", &image, &[]);
    assert_eq!(bay.told().lines().count(), 4, "{err}");
}

/// Lines at unknown places, of which another process has one.
struct Somewhere {
    folder: tempfile::TempDir,
    lines: Vec<Address>,
}

impl Connector for Somewhere {
    fn open(
        &self,
        _: DeviceKind,
        _: &Address,
        _: u32,
        _: Purpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        unreachable!("nothing is asked")
    }

    fn doorway(&self, address: &Address) -> Option<Doorway> {
        Doorway::within(self.folder.path(), address)
    }

    fn candidates(&self) -> Vec<Candidate> {
        let candidate = |address: &Address| Candidate {
            address: address.clone(),
            kind: None,
            description: String::new(),
            may_ask: true,
        };
        self.lines.iter().map(candidate).collect()
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> jiff::Timestamp {
        jiff::Timestamp::UNIX_EPOCH
    }
}

/// Without an address the machine may be at any of these lines.
#[test]
fn nothing_is_flashed_while_a_machine_somewhere_is_at_work() {
    let image = tempfile::NamedTempFile::new().expect("a file");
    Elf::rig().write(image.path());
    let somewhere = Somewhere {
        folder: tempfile::tempdir().expect("a folder"),
        lines: [7_001, 7_002]
            .map(|port| Address::Tcp(format!("127.0.0.1:{port}")))
            .to_vec(),
    };
    let flash = |args: &[&str]| {
        let path = image.path().to_str().expect("UTF-8");
        let flash = ["flash", "rig", "--dry-run", "--image", path];
        let (code, _, err) = tool::run(&somewhere, &[&flash[..], args].concat());
        (code, err)
    };
    assert_eq!(flash(&[]).0, 0);
    let busy = somewhere.doorway(&somewhere.lines[1]).expect("a line");
    let owned = busy.claim().expect("possible").expect("free");
    for args in [
        &[][..],
        &["--rig", "auto"],
        &["--rig", "tcp:127.0.0.1:7002"],
    ] {
        let (code, err) = flash(args);
        assert_eq!(code, 3, "{args:?}: {err}");
        assert!(err.contains("7002 belongs to"), "{args:?}: {err}");
    }
    assert_eq!(flash(&["--rig", "tcp:127.0.0.1:7001"]).0, 0);
    drop(owned);
    assert_eq!(flash(&[]).0, 0);
}

/// `probe-rs` repeats what the board says: a terminal must not obey it.
#[test]
fn what_the_probe_says_reaches_the_terminal_cleaned() {
    let bay = Bay::new(DeviceKind::Rig);
    let program = bay.bench.folder.path().join("probe-rs");
    let text = "#!/bin/sh\nprintf 'log \\033]0;mine\\007\\033[2J\\nError: no \\033[31mboard\\n' >&2\nexit 1\n";
    fs::write(&program, text).expect("written");
    let image = bay.image(&Elf::rig());
    let (code, _, err) = bay.flash("rig", &image, &[]);
    assert_eq!(code, Some(1), "{err}");
    assert!(!err.contains('\u{1b}') && !err.contains('\u{7}'), "{err:?}");
    assert!(
        err.contains("log <U+001B>]0;mine<U+0007><U+001B>[2J\n"),
        "{err}"
    );
    assert!(err.contains("failed: Error: no <U+001B>[31mboard"), "{err}");
}
