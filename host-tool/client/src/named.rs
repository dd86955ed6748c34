//! Names of machines: a file maps them to addresses, so that nobody has to remember ports.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use protocol::settings::MAX_NAME;
use protocol::system::DeviceKind;
use serde::Deserialize;

use crate::address::Address;
use crate::limited;

/// Environment variable that names another file.
const FILE_VARIABLE: &str = "RETROGRADE_CONFIG";

/// The reason why the file cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {why}", file.display())]
pub struct NamedError {
    /// The file.
    pub file: PathBuf,
    /// The reason.
    pub why: String,
}

/// The machines of the file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Named {
    rigs: BTreeMap<String, Address>,
    capsules: BTreeMap<String, Address>,
}

/// The file as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    #[serde(default)]
    rigs: BTreeMap<String, String>,
    #[serde(default)]
    capsules: BTreeMap<String, String>,
}

impl Named {
    /// Reads the user's file; no machine has a name if there is none.
    ///
    /// # Errors
    /// [`NamedError`] if the file cannot be read or its contents are invalid.
    pub fn read() -> Result<Self, NamedError> {
        file().map_or_else(|| Ok(Self::default()), |file| Self::read_from(&file))
    }

    /// Like [`Named::read`], from another file.
    ///
    /// # Errors
    /// As [`Named::read`].
    pub fn read_from(file: &Path) -> Result<Self, NamedError> {
        let error = |why: String| NamedError {
            file: file.to_owned(),
            why,
        };
        let text = match limited::read_text(file, limited::BY_HAND) {
            Ok(text) => text,
            Err(io) if io.kind() == std::io::ErrorKind::NotFound => return Ok(Self::default()),
            Err(io) => return Err(error(io.to_string())),
        };
        let written: Written =
            toml::from_str(&text).map_err(|why| error(why.to_string().trim().to_owned()))?;
        Ok(Self {
            rigs: addresses(written.rigs).map_err(error)?,
            capsules: addresses(written.capsules).map_err(error)?,
        })
    }

    /// Address of the machine of this kind and name.
    #[must_use]
    pub fn address(&self, kind: DeviceKind, name: &str) -> Option<&Address> {
        self.of(kind).get(name)
    }

    /// All machines of a kind, by name.
    #[must_use]
    pub fn of(&self, kind: DeviceKind) -> &BTreeMap<String, Address> {
        match kind {
            DeviceKind::Rig => &self.rigs,
            DeviceKind::Capsule => &self.capsules,
        }
    }
}

fn addresses(written: BTreeMap<String, String>) -> Result<BTreeMap<String, Address>, String> {
    let read = |(name, text): (String, String)| {
        if !may_be_a_name(&name) {
            return Err(format!(
                "`{name}` cannot be a name: use 1 to {MAX_NAME} letters, digits, spaces, `-` and `_`, and neither `auto`, `virtual`, nor a port such as COM3"
            ));
        }
        match text.parse() {
            Ok(Address::Auto | Address::Virtual) => Err(format!(
                "{name} = \"{text}\" says no place: give a serial port, or tcp:HOST:PORT"
            )),
            Ok(address) => Ok((name, address)),
            Err(why) => Err(format!("{name}: {why}")),
        }
    };
    written.into_iter().map(read).collect()
}

/// Whether a text can only be the name of a machine.
#[must_use]
pub fn may_be_a_name(text: &str) -> bool {
    let fits = !text.is_empty() && text.len() <= MAX_NAME;
    let letters = text
        .chars()
        .all(|c| c.is_alphanumeric() || ['-', '_', ' '].contains(&c));
    let number = text
        .get(..3)
        .filter(|start| start.eq_ignore_ascii_case("com"))
        .map(|_| &text[3..]);
    let port = number.is_some_and(|number| number.bytes().all(|byte| byte.is_ascii_digit()));
    fits && text.trim() == text && letters && !port && !["auto", "virtual"].contains(&text)
}

/// Path of the file, which need not exist; `None` if the system does not say where such files are.
#[must_use]
pub fn file() -> Option<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    if let Some(file) = set(FILE_VARIABLE) {
        return Some(file.into());
    }
    let folder = if cfg!(windows) {
        set("APPDATA").map(PathBuf::from)
    } else {
        let home = |home: OsString| PathBuf::from(home).join(".config");
        set("XDG_CONFIG_HOME")
            .map(PathBuf::from)
            .or_else(|| set("HOME").map(home))
    };
    folder.map(|folder| folder.join("retrograde").join("machines.toml"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Named, String> {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("machines.toml");
        std::fs::write(&file, text).expect("written");
        Named::read_from(&file).map_err(|error| error.to_string())
    }

    #[test]
    fn names_lead_to_addresses_each_kind_for_itself() {
        let named = read(
            "# ours\n[rigs]\nleft-bench = \"/dev/ttyACM0\"\n\"bänkle 2\" = \"COM3\"\n[capsules]\nleft-bench = \"tcp:10.0.0.5:7002\"\n",
        )
        .expect("good");
        let at = |kind, name| named.address(kind, name).map(ToString::to_string);
        let (rig, capsule) = (DeviceKind::Rig, DeviceKind::Capsule);
        assert_eq!(at(rig, "left-bench"), Some("/dev/ttyACM0".to_owned()));
        assert_eq!(at(rig, "bänkle 2"), Some("COM3".to_owned()));
        let blue = Some("tcp:10.0.0.5:7002".to_owned());
        assert_eq!(at(capsule, "left-bench"), blue);
        assert_eq!(at(capsule, "bänkle 2"), None);
        assert_eq!(read(""), Ok(Named::default()));
        let nowhere = Path::new("/retrograde/no/such/file");
        assert_eq!(Named::read_from(nowhere).expect("none"), Named::default());
    }

    #[test]
    fn what_cannot_be_is_refused_with_the_file_and_the_reason() {
        for (text, says) in [
            ("[rigs]\nleft", "line 2"),
            ("[rig]\nleft = \"/dev/ttyACM0\"", "unknown field `rig`"),
            ("[rigs]\nleft = 7", "string"),
            ("[rigs]\nleft = \"a\"\nleft = \"b\"", "duplicate key"),
            ("[rigs]\n\"a/b\" = \"/dev/x\"", "cannot be a name"),
            ("[rigs]\nauto = \"/dev/x\"", "cannot be a name"),
            ("[rigs]\ncom3 = \"/dev/x\"", "cannot be a name"),
            ("[rigs]\na-name-of-25-bytes-xxxxxxx = \"/dev/x\"", "1 to 24"),
            ("[rigs]\nleft = \"virtual\"", "says no place"),
            ("[rigs]\nleft = \"tcp:host\"", "no host or no port"),
            ("[rigs]\nleft = \"\"", "empty"),
        ] {
            let why = read(text).expect_err(text);
            assert!(
                why.contains(says) && why.contains("machines.toml"),
                "{text}: {why}"
            );
        }
        assert!(Named::read_from(Path::new("/dev/zero")).is_err());
    }

    #[test]
    fn no_port_is_taken_for_a_name() {
        for port in [
            "/dev/ttyACM0",
            "COM3",
            "com12",
            "COM",
            "tcp:a:1",
            "auto",
            "virtual",
            "",
            " a",
            "\\\\.\\COM10",
        ] {
            assert!(!may_be_a_name(port), "{port}");
        }
        for name in ["left-bench", "rig_2", "a b", "comet", "7", "Комета"] {
            assert!(may_be_a_name(name), "{name}");
        }
    }
}
