//! Surveys every configured place for `devices`.

use std::panic::resume_unwind;
use std::thread;

use client::address::Address;
use client::identity::{self, IdentityRecord};
use client::matches;
use client::named::{Named, NamedError};
use lab::operations::connector::Purpose;
use lab::operations::failure::{Failure, wrong_name};
use lab::operations::places::{KINDS, Places, past_owners};
use protocol::settings::GetName;
use protocol::system::{DeviceKind, Identity};
use serde_json::{Value, json};

/// A configured place and the answer from it.
pub(crate) struct Configured {
    kind: DeviceKind,
    name: Option<String>,
    address: Address,
    answer: Result<(Identity, Option<String>), Failure>,
}

impl Configured {
    pub(crate) fn line(&self) -> String {
        let kind = identity::kind_name(self.kind);
        let name = self.name.as_deref().unwrap_or("(no name)");
        let answer = match &self.answer {
            Ok((identity, carried)) => {
                let mut text = identity::line(identity);
                if identity.device != self.kind {
                    text.push_str(&format!("; it is no {kind}"));
                }
                if let (Some(name), Some(carried)) = (&self.name, carried)
                    && name != carried
                {
                    let place = self.address.to_string();
                    text.push_str(&format!("; {}", wrong_name(name, &place, carried)));
                }
                text
            }
            Err(failure) => failure.to_string(),
        };
        format!("{name}: {kind} at {}: {answer}", self.address)
    }

    pub(crate) fn json(&self) -> Value {
        let answer = self.answer.as_ref();
        let carried = answer.ok().and_then(|(_, carried)| carried.clone());
        json!({
            "name": self.name,
            "kind": identity::kind_name(self.kind),
            "address": self.address.to_string(),
            "carried_name": carried,
            "identity": answer.ok().map(|(identity, _)| IdentityRecord::new(identity, &self.address.to_string())),
            "error": answer.err().map(ToString::to_string),
        })
    }
}

/// Asks at every configured place, at all of them at once. Moves nothing. Also returns the error if the file of names
/// cannot be read.
pub(crate) fn survey(places: &Places<'_>) -> (Vec<Configured>, Option<NamedError>) {
    let (named, error) = match Named::read() {
        Ok(named) => (named, None),
        Err(error) => (Named::default(), Some(error)),
    };
    let mut asked: Vec<(DeviceKind, Option<String>, Address)> = vec![];
    for kind in KINDS {
        let all = named.of(kind).iter();
        asked.extend(all.map(|(name, address)| (kind, Some(name.clone()), address.clone())));
        if let Some(address @ (Address::Serial(_) | Address::Tcp(_))) = places.address(kind)
            && !named.of(kind).values().any(|named| named == address)
        {
            asked.push((kind, None, address.clone()));
        }
    }
    let configured = thread::scope(|scope| {
        let asking: Vec<_> = asked
            .into_iter()
            .map(|(kind, name, address)| {
                scope.spawn(move || Configured {
                    answer: past_owners(|| ask(kind, &address, places)),
                    kind,
                    name,
                    address,
                })
            })
            .collect();
        asking
            .into_iter()
            .map(|one| one.join().unwrap_or_else(|panic| resume_unwind(panic)))
            .collect()
    });
    (configured, error)
}

fn ask(
    kind: DeviceKind,
    address: &Address,
    places: &Places<'_>,
) -> Result<(Identity, Option<String>), Failure> {
    let mut device = places.open(kind, address, Purpose::Look)?;
    let identity = device.hello(places.connector.nonce())?;
    let carried = match identity.device {
        DeviceKind::Rig if matches(&identity) => Some(device.call(GetName)?.name),
        _ => None,
    };
    Ok((identity, carried.map(|name| name.as_str().to_owned())))
}
