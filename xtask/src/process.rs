//! Child processes and their environment.

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

/// A failure, with advice for the user.
#[derive(Debug)]
pub(crate) struct Failure {
    what: String,
    remedy: String,
}

impl Failure {
    pub(crate) fn new(what: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self {
            what: what.into(),
            remedy: remedy.into(),
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "error: {}\n remedy: {}", self.what, self.remedy)
    }
}

pub(crate) type Result<T> = std::result::Result<T, Failure>;

/// Variables that change the output of a compiler. `cargo run` or the user's shell sets them for the host;
/// an image must not depend on them.
const COMPILER_VARIABLES: [&str; 15] = [
    "CARGO",
    "CARGO_BUILD_RUSTC",
    "CARGO_BUILD_RUSTFLAGS",
    "CARGO_BUILD_TARGET",
    "CARGO_ENCODED_RUSTFLAGS",
    "CARGO_INCREMENTAL",
    "CARGO_TARGET_DIR",
    "CARGO_TARGET_THUMBV7EM_NONE_EABIHF_LINKER",
    "CARGO_TARGET_THUMBV7EM_NONE_EABIHF_RUSTFLAGS",
    "LD_LIBRARY_PATH",
    "RUSTC",
    "RUSTC_WORKSPACE_WRAPPER",
    "RUSTC_WRAPPER",
    "RUSTDOC",
    "RUSTFLAGS",
];

/// The folder of the workspace.
pub(crate) fn root() -> PathBuf {
    // Cargo sets the variable at run time. The compiled-in value is for calling the binary directly.
    let package = std::env::var_os("CARGO_MANIFEST_DIR")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")), PathBuf::from);
    package.parent().unwrap_or(Path::new(".")).to_path_buf()
}

/// The folder that cargo builds in for the host, wherever that is set.
pub(crate) fn target() -> PathBuf {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    let asked = || {
        let mut cargo = host_cargo("metadata");
        let output = output_of(cargo.args(["--no-deps", "--format-version", "1"]))?;
        let (_, rest) = output.split_once("\"target_directory\":\"")?;
        Some(PathBuf::from(rest.split('"').next()?))
    };
    FOLDER
        .get_or_init(|| asked().unwrap_or_else(|| root().join("target")))
        .clone()
}

/// A command of the cargo that runs this program, for the host.
pub(crate) fn host_cargo(subcommand: &str) -> Command {
    let mut command = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.arg(subcommand).current_dir(root());
    // Incremental data would take a third of the folder.
    if std::env::var_os("CARGO_INCREMENTAL").is_none() {
        command.env("CARGO_INCREMENTAL", "0");
    }
    forget_own_package(&mut command);
    command
}

/// As [`host_cargo`] for the images, without the variables meant for the host's compiler.
pub(crate) fn image_cargo(subcommand: &str) -> Command {
    let mut command = host_cargo(subcommand);
    for variable in COMPILER_VARIABLES {
        command.env_remove(variable);
    }
    command
}

/// Removes the variables in which `cargo run` describes `xtask`: build scripts of other packages watch some of them and
/// would run again without a reason.
fn forget_own_package(command: &mut Command) {
    for (name, _) in std::env::vars_os() {
        let text = name.to_string_lossy();
        if [
            "CARGO_PKG_",
            "CARGO_MANIFEST_",
            "CARGO_BIN_",
            "CARGO_CRATE_",
        ]
        .iter()
        .any(|prefix| text.starts_with(prefix))
        {
            command.env_remove(&name);
        }
    }
}

/// Prints a command and runs it on the same terminal.
///
/// # Errors
/// It cannot be started or does not end with code 0; `remedy` says what the user can do.
pub(crate) fn run(command: &mut Command, remedy: &str) -> Result<()> {
    let text = spelled(command);
    println!("$ {text}");
    let why = match command.status() {
        Ok(status) if status.success() => return Ok(()),
        Ok(status) => format!("{text} ended with {status}"),
        Err(error) => format!("{text} does not start: {error}"),
    };
    Err(Failure::new(why, remedy))
}

/// As [`run`], and returns the lines of its standard output.
///
/// # Errors
/// As [`run`].
pub(crate) fn lines_of(command: &mut Command, remedy: &str) -> Result<Vec<String>> {
    let text = spelled(command);
    println!("$ {text}");
    let failure = |reason: String| Failure::new(format!("{text} {reason}"), remedy);
    let output = Command::output(command.stderr(Stdio::inherit()));
    let output = output.map_err(|error| failure(format!("does not start: {error}")))?;
    if !output.status.success() {
        return Err(failure(format!("ended with {}", output.status)));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    Ok(text.lines().map(str::to_owned).collect())
}

/// The first line of a command's output, if it succeeds.
pub(crate) fn first_line(command: &mut Command) -> Option<String> {
    let text = output_of(command)?;
    text.lines().next().map(|line| line.trim().to_owned())
}

/// A command's output, if it succeeds.
fn output_of(command: &mut Command) -> Option<String> {
    let output = command.stdin(Stdio::null()).stderr(Stdio::null());
    let output = output.output().ok().filter(|done| done.status.success())?;
    String::from_utf8(output.stdout).ok()
}

/// The command as a person would type it in the workspace's folder: program names without paths, short paths.
fn spelled(command: &Command) -> String {
    let program = Path::new(command.get_program());
    let shown = program.file_name().unwrap_or(program.as_os_str());
    let mut words = vec![shown.to_string_lossy().into_owned()];
    words.extend(
        command
            .get_args()
            .map(|word| word.to_string_lossy().into_owned()),
    );
    words
        .join(" ")
        .replace(&format!("{}/", root().display()), "")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failing_child_carries_the_remedy() {
        let failure = run(&mut Command::new("false"), "read its output").unwrap_err();
        assert!(failure.to_string().contains("remedy: read its output"));
    }
}
