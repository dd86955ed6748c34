//! `ack`: acknowledges latched faults.

use client::error::ClientError;
use client::identity;
use lab::operations::arguments::Which;
use lab::operations::connector::LinkPurpose;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use protocol::error::Refusal;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

pub(crate) fn acknowledge(
    which: &Which,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let (mut acknowledged, mut nothing) = (vec![], None);
    let mut failed = None;
    // Try both machines: one without a fault must not prevent the other from being acknowledged.
    for kind in finder.machines(which)? {
        let name = identity::kind_name(kind);
        let result = finder
            .connect(kind, LinkPurpose::Observe)
            .and_then(|mut device| {
                device.acknowledge()?;
                Ok(device.place())
            });
        match result {
            Ok(place) => {
                screen.say(&format!(
                    "{name} at {place}: fault acknowledged; nothing moved"
                ));
                acknowledged.push(name);
            }
            Err(Failure::Client(ClientError::Refused {
                place,
                request,
                impact,
                refusal: refusal @ Refusal::NothingToAcknowledge,
            })) => {
                screen.say(&format!("{name} at {place}: {refusal}"));
                nothing.get_or_insert(ClientError::Refused {
                    place,
                    request,
                    impact,
                    refusal,
                });
            }
            Err(failure) => {
                screen.say(&format!("{name}: {failure}"));
                failed.get_or_insert(failure);
            }
        }
    }
    match (failed, nothing) {
        (Some(failure), _) => Err(failure),
        (None, Some(nothing)) if acknowledged.is_empty() => Err(nothing.into()),
        (None, _) => Ok(json!({ "acknowledged": acknowledged })),
    }
}
