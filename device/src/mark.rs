//! The mark of an image: which machine it is for and what it speaks, in a section of its own at a fixed place. Whoever
//! has the file reads it without symbols, whose names depend on the compiler.

use crate::identity::REVISION;
use protocol::{
    VERSION,
    system::{DeviceKind, Revision, Version},
    table::SCHEMA_KEY,
};

/// Section of the image; `memory.x` puts it behind the vector table.
pub const SECTION: &str = ".retrograde";

/// How a mark begins; another layout begins otherwise.
const MAGIC: [u8; 8] = *b"retrogr1";

/// Bytes of a mark: magic, machine, dirty, major, minor, commit and schema key, both with the lowest byte first.
pub const BYTES: usize = 24;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mark {
    pub machine: DeviceKind,
    pub protocol: Version,
    pub schema_key: u64,
    pub revision: Revision,
}

/// The mark of an image that is built from these sources.
#[must_use]
pub const fn bytes(machine: DeviceKind) -> [u8; BYTES] {
    let mut bytes = [0; BYTES];
    let (head, rest) = bytes.split_at_mut(8);
    head.copy_from_slice(&MAGIC);
    let (small, rest) = rest.split_at_mut(4);
    let [dirty, is_capsule] = [
        REVISION.dirty as u8,
        matches!(machine, DeviceKind::Capsule) as u8,
    ];
    small.copy_from_slice(&[is_capsule, dirty, VERSION.major, VERSION.minor]);
    let (commit, key) = rest.split_at_mut(4);
    commit.copy_from_slice(&REVISION.commit.to_le_bytes());
    key.copy_from_slice(&SCHEMA_KEY.to_le_bytes());
    bytes
}

/// The mark in the contents of the section [`SECTION`]; none if it is none of ours.
#[must_use]
pub fn parse(section: &[u8]) -> Option<Mark> {
    let (magic, rest) = section.split_first_chunk()?;
    let (&[machine, dirty, major, minor], rest) = rest.split_first_chunk()?;
    let (commit, rest) = rest.split_first_chunk()?;
    Some(Mark {
        machine: match machine {
            0 => DeviceKind::Rig,
            1 => DeviceKind::Capsule,
            _ => return None,
        },
        protocol: Version { major, minor },
        schema_key: u64::from_le_bytes(*rest.first_chunk()?),
        revision: Revision {
            commit: u32::from_le_bytes(*commit),
            dirty: dirty != 0,
        },
    })
    .filter(|_| *magic == MAGIC)
}

/// Puts the mark of a machine into its image.
#[macro_export]
macro_rules! mark {
    ($machine:expr) => {
        #[used]
        #[unsafe(link_section = ".retrograde")]
        static MARK: [u8; $crate::mark::BYTES] = $crate::mark::bytes($machine);
    };
}
