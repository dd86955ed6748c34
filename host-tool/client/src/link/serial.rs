//! A serial port of a machine, opened exclusively.

use std::path::Path;
use std::{fs, io};

use serialport::{ClearBuffer, ErrorKind, SerialPortType};

use crate::link::halves::{Halves, READ, WRITE};
use crate::link::{OpenError, Reason};
use crate::named;

/// Baud rate of both firmwares.
pub const DEFAULT_BAUD: u32 = 115_200;

/// USB vendor of the ST-LINK on every Nucleo board.
const STMICROELECTRONICS: u16 = 0x0483;

/// Opens a port exclusively. Sends nothing.
///
/// # Errors
/// [`OpenError`], which distinguishes missing, forbidden and busy ports and names the remedy.
pub fn open(path: &str, baud: u32) -> Result<Halves, OpenError> {
    let halves = || {
        let port = serialport::new(path, baud).timeout(WRITE).open()?;
        // Discard old bytes: they belong to another session.
        let _ = port.clear(ClearBuffer::Input);
        let mut reader = port.try_clone()?;
        reader.set_timeout(READ)?;
        Ok(Halves {
            reader: Box::new(reader),
            writer: Box::new(port),
            end: "the port is gone",
        })
    };
    halves().map_err(|error| explain(path, &error))
}

/// A serial port of this computer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Port {
    /// Name to open it by.
    pub path: String,
    pub description: String,
    /// Belongs to an ST-LINK, so that Hello cannot disturb another instrument.
    pub stlink: bool,
}

/// All serial ports, by name.
#[must_use]
pub fn ports() -> Vec<Port> {
    // A container may lack the folder that the search reads, and it would panic.
    if cfg!(target_os = "linux") && !Path::new("/sys/class/tty").is_dir() {
        return vec![];
    }
    let mut ports: Vec<Port> = serialport::available_ports()
        .unwrap_or_default()
        .into_iter()
        .map(|info| match info.port_type {
            SerialPortType::UsbPort(usb) => Port {
                path: info.port_name,
                description: [
                    usb.product.unwrap_or_else(|| "USB".to_owned()),
                    usb.serial_number.unwrap_or_default(),
                ]
                .join(" ")
                .trim()
                .to_owned(),
                stlink: usb.vid == STMICROELECTRONICS,
            },
            _ => Port {
                path: info.port_name,
                description: "not a USB port".to_owned(),
                stlink: false,
            },
        })
        .collect();
    ports.sort_by(|a, b| a.path.cmp(&b.path));
    ports
}

fn explain(path: &str, error: &serialport::Error) -> OpenError {
    let exists = Path::new(path).exists();
    let (reason, why, remedy) = match error.kind() {
        ErrorKind::Io(io::ErrorKind::PermissionDenied) => (
            Reason::Permission,
            "no permission".to_owned(),
            match group(path) {
                // A user cannot join this group.
                Some(group) if group == "root" => "the port belongs to the administrator alone: a udev rule that gives it to a group of yours (`dialout`), or `sudo setfacl -m u:$USER:rw` on the port until it is unplugged".to_owned(),
                Some(group) => format!(
                    "the port belongs to the group `{group}`: run `sudo usermod -aG {group} $USER`, then log out and in again"
                ),
                None => "give your user read and write access to the port".to_owned(),
            },
        ),
        ErrorKind::NoDevice if exists => (
            Reason::Busy,
            match owner(path) {
                Some(owner) => format!("in use by {owner}"),
                None => "in use by another program".to_owned(),
            },
            "close that program (a serial monitor, another `retrograde`, ModemManager), then try again".to_owned(),
        ),
        _ if exists && !is_a_device(path) => (
            Reason::NoPort,
            "it is not a serial port".to_owned(),
            "give a serial port, such as /dev/ttyACM0; `retrograde doctor` lists the ports"
                .to_owned(),
        ),
        _ if !exists => (
            Reason::Absent,
            "there is no such port".to_owned(),
            "check the cable; `retrograde doctor` lists the ports".to_owned(),
        ),
        _ => (
            Reason::Other,
            error.to_string(),
            "unplug the board, plug it in again, and try `retrograde doctor`".to_owned(),
        ),
    };
    OpenError {
        place: path.to_owned(),
        reason,
        why,
        remedy,
    }
}

/// Whether a path may be a port: neither a file nor a folder, nor a device that is not a terminal.
fn is_a_device(path: &str) -> bool {
    use std::io::IsTerminal;
    use std::os::unix::fs::FileTypeExt;
    let device = fs::metadata(path).is_ok_and(|found| found.file_type().is_char_device());
    // A device that cannot be opened may still be a port.
    device && named::open_to_read(path.as_ref()).map_or(true, |file| file.is_terminal())
}

/// Name of the group that owns a file.
fn group(path: &str) -> Option<String> {
    use std::os::unix::fs::MetadataExt;
    let gid = fs::metadata(path).ok()?.gid().to_string();
    let groups = fs::read_to_string("/etc/group").ok()?;
    groups.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)? == gid).then(|| name.to_owned())
    })
}

/// The process that has a file open, as far as this user can see it (Linux).
fn owner(path: &str) -> Option<String> {
    let wanted = fs::canonicalize(path).ok()?;
    fs::read_dir("/proc").ok()?.flatten().find_map(|process| {
        let id = process.file_name().to_str()?.parse::<u32>().ok()?;
        let open = fs::read_dir(process.path().join("fd"))
            .ok()?
            .flatten()
            .any(|fd| fs::read_link(fd.path()).is_ok_and(|target| target == wanted));
        if !open || id == std::process::id() {
            return None;
        }
        let name = fs::read_to_string(process.path().join("comm")).ok()?;
        Some(format!("{} (process {id})", name.trim()))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn a_port_that_is_forbidden_or_in_use_says_what_to_do_and_who_has_it() {
        use std::io::{BufRead, BufReader, Write};
        use std::process::{Command, Stdio};
        let file = tempfile::NamedTempFile::new().expect("a file");
        let path = file.path().to_str().expect("UTF-8");
        let explained = |kind| explain(path, &serialport::Error::new(kind, ""));
        let forbidden = explained(ErrorKind::Io(io::ErrorKind::PermissionDenied));
        assert_eq!(forbidden.reason, Reason::Permission);
        assert!(!forbidden.remedy.is_empty());
        // Another process opens it.
        let mut other = Command::new("sh")
            .args(["-c", "exec 3< \"$0\"; echo open; read line", path])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("a shell");
        let mut said = String::new();
        let out = other.stdout.take().expect("piped");
        let _ = BufReader::new(out).read_line(&mut said).expect("a line");
        let _ours = fs::File::open(path).expect("there");
        let busy = explained(ErrorKind::NoDevice);
        assert_eq!(busy.reason, Reason::Busy);
        let who = format!("(process {})", other.id());
        assert!(busy.why.contains(&who), "{busy}");
        let mut input = other.stdin.take().expect("piped");
        input.write_all(b"\n").expect("typed");
        other.wait().expect("ended");
        assert_eq!(
            explained(ErrorKind::NoDevice).why,
            "in use by another program"
        );
    }

    /// A port, and the end where a machine would be.
    #[cfg(target_os = "linux")]
    fn plugged_in() -> (String, fs::File) {
        use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};
        let machine = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a terminal");
        unlockpt(&machine).expect("mine");
        let path = ptsname(&machine, vec![]).expect("a name");
        (path.into_string().expect("UTF-8"), machine.into())
    }

    /// The reason why a path cannot be opened as a port, if the system says this.
    #[cfg(target_os = "linux")]
    fn reason(path: &str, kind: ErrorKind) -> OpenError {
        explain(path, &serialport::Error::new(kind, ""))
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_path_that_is_no_port_is_told_from_a_port_that_fails() {
        let (port, _machine) = plugged_in();
        let file = tempfile::NamedTempFile::new().expect("a file");
        let file = file.path().to_str().expect("UTF-8");
        for (path, expected) in [
            (&*port, Reason::Other),
            (file, Reason::NoPort),
            ("/dev", Reason::NoPort),
            ("/dev/null", Reason::NoPort),
            ("/dev/retrograde-no-such-port", Reason::Absent),
        ] {
            let found = reason(path, ErrorKind::Unknown);
            assert_eq!(found.reason, expected, "{found:?}");
            assert_eq!(is_a_device(path), expected == Reason::Other, "{path}");
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn who_may_not_open_a_port_learns_what_to_do() {
        let forbidden =
            |path: &str| reason(path, ErrorKind::Io(io::ErrorKind::PermissionDenied)).remedy;
        let alone = forbidden("/dev/null");
        assert!(alone.contains("the administrator alone"), "{alone}");
        let missing = forbidden("/dev/retrograde-no-such-port");
        assert_eq!(missing, "give your user read and write access to the port");
    }
}
