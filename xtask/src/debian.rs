//! Debian's Rust. Debian has no standard library for the ARM target, but ships the sources from which cargo builds
//! `core`.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::process::{Failure, Result, first_line, image_cargo, root, run};
use crate::version::{OLDEST, Version};

/// A matched set: compiler, cargo, the sources of `core`, the linter, and a linker for ARM.
const PACKAGES: [&str; 5] = [
    "rustc-web",
    "cargo-web",
    "rust-web-src",
    "rust-web-clippy",
    "lld",
];

/// Files that a usable set must have.
const FILES: [&str; 5] = [
    "bin/rustc",
    "bin/cargo",
    "bin/cargo-clippy",
    "bin/clippy-driver",
    "lib/rustlib/src/rust/library/Cargo.lock",
];

/// Debian's Rust below some `usr` folder: the system's own, or one unpacked in `target/toolchain`.
pub(crate) struct Debian {
    usr: PathBuf,
    linker: PathBuf,
    version: Version,
}

impl Debian {
    /// The set on this machine, if there is one.
    pub(crate) fn present() -> Option<Self> {
        [PathBuf::from("/usr"), unpacked().join("usr")]
            .into_iter()
            .find_map(|usr| Self::at(usr).ok())
    }

    /// Downloads the set. Root installs it; any other user unpacks it below `target/`, where it changes
    /// nothing on the system and `cargo clean` removes it.
    ///
    /// # Errors
    /// The system is not Debian, the network is down, or Debian's Rust is too old.
    pub(crate) fn fetch() -> Result<Self> {
        if first_line(Command::new("apt-get").arg("--version")).is_none() {
            let what = "this machine has no apt-get, so Debian's packages are not available";
            return Err(Failure::new(what, "use rustup, or a Debian machine"));
        }
        if first_line(Command::new("id").arg("-u")).as_deref() == Some("0") {
            println!("Installing {} with apt-get.", PACKAGES.join(", "));
            match install().and_then(|()| Self::at(PathBuf::from("/usr"))) {
                Ok(debian) => return Ok(debian),
                Err(failure) => println!("{failure}"),
            }
        }
        println!(
            "Unpacking {} below target/toolchain (190 MB to download, 1.1 GB on disk, once).",
            PACKAGES.join(", ")
        );
        unpack()?;
        Self::at(unpacked().join("usr"))
    }

    fn at(usr: PathBuf) -> Result<Self> {
        if let Some(missing) = FILES.iter().find(|file| !usr.join(file).exists()) {
            let what = format!("{} is missing", usr.join(missing).display());
            return Err(Failure::new(what, "delete target/toolchain and try again"));
        }
        // If the system has the linker, the unpacked set contains only a dangling link to it.
        let linker = [usr.as_path(), Path::new("/usr")]
            .map(|place| place.join("bin/ld.lld"))
            .into_iter()
            .find(|linker| linker.exists())
            .ok_or_else(|| Failure::new("ld.lld is missing", "install Debian's package lld"))?;
        let mut rustc = Command::new(usr.join("bin/rustc"));
        match Version::of(rustc.env("LD_LIBRARY_PATH", libraries(&usr))) {
            Some(version) if version >= OLDEST => Ok(Self {
                usr,
                linker,
                version,
            }),
            Some(version) => Err(Failure::new(
                format!("Debian's Rust is {version}, this workspace needs {OLDEST}"),
                "add Debian's security archive to /etc/apt, which has a newer one, or use rustup",
            )),
            None => Err(Failure::new(
                format!("{} does not run", usr.join("bin/rustc").display()),
                "delete target/toolchain and try again, or use rustup",
            )),
        }
    }

    /// Folders of the sources of `core`: both the path that the compiler uses, and the one with links resolved.
    pub(crate) fn sources(&self) -> impl Iterator<Item = PathBuf> {
        let named = self.usr.join("lib/rustlib/src/rust");
        let real = fs::canonicalize(&named).ok();
        std::iter::once(named).chain(real)
    }

    /// A cargo command that also builds `core`.
    pub(crate) fn cargo(&self, subcommand: &str) -> Command {
        let program = |name: &str| self.usr.join("bin").join(name);
        // `cargo clippy` would look in ~/.cargo/bin first and find the driver of another compiler.
        let entry = match subcommand {
            "clippy" => "cargo-clippy",
            _ => "cargo",
        };
        let mut command = image_cargo(program(entry), subcommand);
        command
            .env_remove("RUSTUP_TOOLCHAIN")
            .env("CARGO", program("cargo"))
            .env("RUSTC", program("rustc"))
            .env("LD_LIBRARY_PATH", libraries(&self.usr))
            .env("CARGO_TARGET_THUMBV7EM_NONE_EABIHF_LINKER", &self.linker)
            // `build-std` is unstable; Debian ships no nightly.
            .env("RUSTC_BOOTSTRAP", "1")
            .args(["-Z", "build-std=core"]);
        command
    }
}

impl fmt::Display for Debian {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { usr, version, .. } = self;
        let place = usr.strip_prefix(root()).unwrap_or(usr).display();
        write!(
            out,
            "Debian's Rust {version} in {place}, with `core` built from its sources"
        )
    }
}

fn unpacked() -> PathBuf {
    root().join("target/toolchain")
}

/// Folder of the set's shared libraries, as Debian's multiarch names it.
fn libraries(usr: &Path) -> PathBuf {
    usr.join(format!("lib/{}-linux-gnu", std::env::consts::ARCH))
}

fn install() -> Result<()> {
    let remedy = "see what apt-get says above";
    // Old package lists may offer an older Rust, so update them. If the update fails, try with the old lists.
    if let Err(failure) = run(Command::new("apt-get").args(["-q", "update"]), remedy) {
        println!("{failure}");
    }
    let mut apt = Command::new("apt-get");
    apt.env("DEBIAN_FRONTEND", "noninteractive");
    apt.args(["-q", "-y", "-o", "DPkg::Lock::Timeout=60", "install"]);
    // `--no-remove`: never remove a Rust that the user has installed.
    apt.args(["--no-remove", "--no-install-recommends"]);
    run(apt.args(PACKAGES), remedy)
}

/// Downloads the packages and their missing dependencies, into folders of our own because only root may
/// write to the system's.
fn unpack() -> Result<()> {
    let remedy = "see what apt-get says above; a Debian mirror has to be reachable";
    let partial = root().join("target/toolchain.partial");
    let apt_state = partial.join("apt");
    let trouble = |error: std::io::Error| {
        let what = format!("cannot prepare {}: {error}", partial.display());
        Failure::new(what, "free some disk space, or make target/ writable")
    };
    if partial.exists() {
        fs::remove_dir_all(&partial).map_err(trouble)?;
    }
    for folder in ["apt/lists/partial", "apt/archives/partial"] {
        fs::create_dir_all(partial.join(folder)).map_err(trouble)?;
    }

    let apt = || {
        let mut command = Command::new("apt-get");
        command.args(["-q", "-o", "Debug::NoLocking=1"]);
        command.args(["-o", "APT::Sandbox::User=root"]);
        for (option, folder) in [
            ("Dir::State::Lists", "lists"),
            ("Dir::Cache", "."),
            ("Dir::Cache::Archives", "archives"),
        ] {
            let place = apt_state.join(folder);
            command.args(["-o", &format!("{option}={}", place.display())]);
        }
        command
    };
    run(apt().arg("update"), remedy)?;
    let mut download = apt();
    // `--reinstall`: download packages that the system has as well, because the set is used as a whole.
    download.args(["--download-only", "-y", "--reinstall"]);
    download.arg("--no-install-recommends");
    run(download.arg("install").args(PACKAGES), remedy)?;

    let archives = fs::read_dir(apt_state.join("archives")).map_err(trouble)?;
    for archive in archives.flatten().map(|entry| entry.path()) {
        if archive.extension().is_some_and(|end| end == "deb") {
            let mut dpkg = Command::new("dpkg-deb");
            dpkg.arg("-x").args([&archive, &partial]);
            if !dpkg.status().is_ok_and(|status| status.success()) {
                let what = format!("{} cannot be unpacked", archive.display());
                return Err(Failure::new(
                    what,
                    "see what dpkg-deb says above; free disk space?",
                ));
            }
        }
    }
    fs::remove_dir_all(&apt_state).map_err(trouble)?;
    if unpacked().exists() {
        fs::remove_dir_all(unpacked()).map_err(trouble)?;
    }
    // Last, so that a partly unpacked set is never taken for a complete one.
    fs::rename(&partial, unpacked()).map_err(trouble)
}
