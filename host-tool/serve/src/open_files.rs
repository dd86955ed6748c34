//! Open files of this process. Each connection uses one, and a stop needs some of its own.

use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// Connections that may send any request. Further ones may only send stops.
const CONNECTIONS: u64 = 256;
/// Open files that the server requests from the system. The default of macOS is 256.
const WANTED: u64 = 2_048;
/// Open files reserved for the lines of the machines, for stops, and for the server's own files.
const KEPT: u64 = 64;
/// Minimum open files; with fewer the server does not start.
pub(crate) const LEAST: u64 = 2 * KEPT;

/// Raises this process's limit of open files if the system allows it, and returns the limit.
pub(crate) fn raised() -> u64 {
    let limit = getrlimit(Resource::Nofile);
    let now = limit.current.unwrap_or(WANTED);
    let wanted = limit.maximum.unwrap_or(WANTED).min(WANTED);
    let raised = Rlimit {
        current: Some(wanted),
        ..limit
    };
    match now < wanted && setrlimit(Resource::Nofile, raised).is_ok() {
        true => wanted,
        false => now,
    }
}

/// Limits of simultaneous connections: those that may send any request, and further ones for stops.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Connections {
    pub(crate) full: usize,
    pub(crate) further: usize,
}

impl Connections {
    /// The limits for this many open files. A connection may read a record, which is another open file.
    pub(crate) fn with(open_files: u64) -> Self {
        let free = open_files.saturating_sub(KEPT).min(WANTED);
        Self {
            full: CONNECTIONS.min(free / 4) as usize,
            further: (free / 2) as usize,
        }
    }

    /// Warning for the operator; none if there are enough open files.
    pub(crate) fn remark(self) -> Option<String> {
        ((self.full as u64) < CONNECTIONS).then(|| {
            format!(
                "This system allows few open files: only {} of {CONNECTIONS} connections can be served at once. `ulimit -n {WANTED}` before the start gives more.",
                self.full
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn connections_leave_open_files_to_stops() {
        for (open_files, full, further) in [
            (LEAST, 16, 32),
            (256, 48, 96),
            (WANTED, 256, 992),
            (u64::MAX, 256, 1_024),
        ] {
            let connections = Connections::with(open_files);
            assert_eq!(connections, Connections { full, further });
            assert!(2 * full as u64 + further as u64 + KEPT <= open_files);
            assert_eq!(connections.remark().is_none(), full == 256);
        }
    }
}
