//! The result of an order: the carriage's position, the files, the reason of a failure.

use lab::operations::failure::Failure;
use protocol::rig::RigStatus;
use serde_json::{Value, json};

pub fn place(status: &RigStatus) -> Value {
    json!({ "position_um": status.position_um, "position_steps": status.position_steps })
}

pub fn files(csv: &std::path::Path, sidecar: &std::path::Path) -> Value {
    let name = |path: &std::path::Path| {
        path.file_name()
            .map(|name| name.to_string_lossy().into_owned())
    };
    json!({ "csv": name(csv), "sidecar": name(sidecar) })
}

/// Failure of an order that arrives without a connection.
pub fn lost(failure: &Failure) -> Failure {
    Failure::Unreached {
        why: format!("nothing was sent, there is no contact: {failure}"),
        help: failure.remedy(),
    }
}

/// Failure of an order that is older than a stop.
pub fn overtaken() -> Failure {
    Failure::refused(
        "a stop came after this order",
        "nothing was moved by this order; look at the machine, then order it again",
    )
}

/// Failure of an order when the server shuts down.
pub fn server_ends() -> Failure {
    Failure::refused(
        "the server ends",
        "nothing was moved by this order; start the server again",
    )
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use lab::operations::failure::NO_DEVICE;

    use super::*;

    #[test]
    fn an_order_without_a_contact_has_the_remedy_of_the_contact() {
        let failure = lost(&Failure::refused("it is away", "plug it in"));
        assert_eq!(failure.exit_code(), NO_DEVICE);
        assert_eq!(
            failure.in_one_line(),
            "nothing was sent, there is no contact: it is away; plug it in"
        );
    }

    #[test]
    fn files_are_named_without_their_folder() {
        let (csv, sidecar) = (Path::new("/out/run-1.csv"), Path::new("/out/run-1.json"));
        let expected = json!({ "csv": "run-1.csv", "sidecar": "run-1.json" });
        assert_eq!(files(csv, sidecar), expected);
    }
}
