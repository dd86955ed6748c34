//! Machines by name, and what `devices` shows of every place that the user has configured.

use std::panic::resume_unwind;
use std::thread;

use client::identity::{self, IdentityRecord};
use client::link::address::Address;
use client::named::{self, Named, NamedError};
use client::{Device, matches};
use protocol::settings::GetName;
use protocol::system::{DeviceKind, Identity};
use serde_json::{Value, json};

use crate::cli::args::Cli;
use crate::cli::failure::Failure;
use crate::cli::finding::{Finder, KINDS, past_owners};
use crate::connector::Purpose;

/// The names by which the user has called the machines.
#[derive(Clone, Debug, Default)]
pub struct Names {
    rig: Option<String>,
    capsule: Option<String>,
}

impl Names {
    pub(crate) fn of(&self, kind: DeviceKind) -> Option<&str> {
        match kind {
            DeviceKind::Rig => self.rig.as_deref(),
            DeviceKind::Capsule => self.capsule.as_deref(),
        }
    }
}

/// Puts addresses in the place of names.
///
/// # Errors
/// A name was given, and the file cannot be used.
pub(crate) fn resolve(cli: &mut Cli) -> Result<(), Failure> {
    for kind in KINDS {
        let (given, name) = match kind {
            DeviceKind::Rig => (&mut cli.rig, &mut cli.names.rig),
            DeviceKind::Capsule => (&mut cli.capsule, &mut cli.names.capsule),
        };
        let Some(Address::Serial(text)) = given else {
            continue;
        };
        if !named::may_be_a_name(text) {
            continue;
        }
        let named = Named::read().map_err(|error| unusable(&error))?;
        if let Some(address) = named.address(kind, text) {
            *name = Some(std::mem::take(text));
            *given = Some(address.clone());
        }
    }
    Ok(())
}

fn unusable(error: &NamedError) -> Failure {
    Failure::Input {
        why: error.to_string(),
        help:
            "mend the file, or give the address itself: `--rig /dev/ttyACM0`, `--rig tcp:HOST:PORT`"
                .to_owned(),
    }
}

impl Finder<'_> {
    /// Makes sure that a rig that was called by name carries this name. A capsule carries none.
    pub(crate) fn require_name(&self, device: &mut Device) -> Result<(), Failure> {
        let Some(identity) = device.identity().copied().filter(matches) else {
            return Ok(());
        };
        let name = self.cli.names.of(identity.device);
        let Some(name) = name.filter(|_| identity.device == DeviceKind::Rig) else {
            return Ok(());
        };
        let carried = device.call(GetName)?.name;
        if carried == name {
            return Ok(());
        }
        Err(Failure::WrongName {
            place: device.place(),
            name: name.to_owned(),
            carried: carried.as_str().to_owned(),
        })
    }
}

/// What is wrong about a name.
pub(crate) fn wrong_name(name: &str, place: &str, carried: &str) -> String {
    match carried {
        "" => format!("the rig at {place} carries no name, and should be `{name}`"),
        carried => format!("the rig at {place} is called `{carried}`, not `{name}`"),
    }
}

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

/// Asks at every place that the user has configured, at all at once. Moves nothing.
/// Also returns why there are no names.
pub(crate) fn survey(finder: &Finder<'_>) -> (Vec<Configured>, Option<NamedError>) {
    let (named, error) = match Named::read() {
        Ok(named) => (named, None),
        Err(error) => (Named::default(), Some(error)),
    };
    let mut places: Vec<(DeviceKind, Option<String>, Address)> = vec![];
    for kind in KINDS {
        let all = named.of(kind).iter();
        places.extend(all.map(|(name, address)| (kind, Some(name.clone()), address.clone())));
        if let Some(address @ (Address::Serial(_) | Address::Tcp(_))) = finder.address(kind)
            && !named.of(kind).values().any(|named| named == address)
        {
            places.push((kind, None, address.clone()));
        }
    }
    let configured = thread::scope(|scope| {
        let asking: Vec<_> = places
            .into_iter()
            .map(|(kind, name, address)| {
                scope.spawn(move || Configured {
                    answer: past_owners(|| ask(kind, &address, finder)),
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
    finder: &Finder<'_>,
) -> Result<(Identity, Option<String>), Failure> {
    let link = finder
        .connector
        .open(kind, address, finder.cli.baud, Purpose::Look)?;
    let nonce = finder.connector.nonce();
    let mut device = Device::new(link, nonce);
    let identity = device.hello(nonce)?;
    let carried = match identity.device {
        DeviceKind::Rig if matches(&identity) => Some(device.call(GetName)?.name),
        _ => None,
    };
    Ok((identity, carried.map(|name| name.as_str().to_owned())))
}
