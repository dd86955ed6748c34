//! `doctor`: identifies each place, and gives a remedy for each problem. Examines all places at once, each for little
//! more than a second. Moves nothing.

use std::panic::resume_unwind;
use std::thread;

use client::address::Address;
use client::diagnosis::Sign;
use client::error::ClientError;
use client::identity::{self, IdentityRecord};
use client::link::{OpenError, Reason};
use lab::commissioning::image;
use lab::operations::arguments::Which;
use lab::operations::connector::{Candidate, LinkPurpose};
use lab::operations::failure::{DONE, FAILED, FAULT, Failure, MISMATCH, NO_DEVICE};
use lab::operations::finder::{Finder, KINDS, past_owners};
use protocol::system::{DeviceKind, Identity, Version};
use protocol::table::SCHEMA_KEY;
use serde_json::{Value, json};

use crate::cli::screen::Screen;

struct Location {
    /// The machine expected there, if the user named one.
    wanted: Option<DeviceKind>,
    candidate: Candidate,
}

#[derive(Debug)]
pub struct Finding {
    /// The place, with the expected machine.
    place: String,
    /// Keyword for programs.
    code: &'static str,
    text: String,
    /// Remedy; none if nothing is wrong.
    remedy: Option<String>,
    /// The machine that answered.
    found: Option<Identity>,
    exit_code: u8,
}

impl Finding {
    fn fine(place: String, code: &'static str, text: String) -> Self {
        Self {
            place,
            code,
            text,
            remedy: None,
            found: None,
            exit_code: 0,
        }
    }

    fn wrong(place: String, failure: &Failure) -> Self {
        Self {
            code: code(failure),
            text: failure.to_string(),
            remedy: Some(failure.remedy()).filter(|remedy| !remedy.is_empty()),
            exit_code: failure.exit_code(),
            ..Self::fine(place, "", String::new())
        }
    }

    pub(crate) fn line(&self) -> String {
        let mut text = format!("{}: {}: {}", self.place, self.code, self.text);
        if let Some(remedy) = &self.remedy {
            text.push_str("\n  remedy: ");
            text.push_str(&remedy.replace('\n', "\n          "));
        }
        text
    }

    pub(crate) fn json(&self) -> Value {
        json!({
            "place": self.place,
            "finding": self.code,
            "text": self.text,
            "remedy": self.remedy,
            "machine": self.found.map(|found| identity::kind_name(found.device)),
            "identity": self.found.map(|found| IdentityRecord::new(&found, &self.place)),
        })
    }
}

fn code(failure: &Failure) -> &'static str {
    match failure {
        Failure::Open(OpenError { reason, .. }) => match reason {
            Reason::Permission => "no_permission",
            Reason::Busy => "busy",
            Reason::OwnerSilent => "owner_silent",
            Reason::Absent => "absent",
            Reason::NoPort => "no_port",
            Reason::Unreachable => "unreachable",
            Reason::Other => "not_opened",
        },
        Failure::Client(error) => match error {
            ClientError::NoAnswer { sign, .. } => match sign {
                Sign::Silence => "silence",
                Sign::Echo => "echo",
                Sign::Deaf => "deaf",
                Sign::Web => "web_server",
                Sign::Ssh => "ssh_server",
                Sign::Text(_) => "other_instrument",
                Sign::Noise(_) => "no_frames",
            },
            ClientError::WrongMachine { wanted, found, .. } if found.device != *wanted => {
                "wrong_kind"
            }
            ClientError::WrongMachine { .. } => "other_firmware",
            ClientError::Owned { .. } => "owner_silent",
            _ => "lost",
        },
        Failure::NotFound { .. } => "absent",
        Failure::Ambiguous { .. } => "several",
        _ => "failed",
    }
}

pub(crate) fn doctor(
    which: &Which,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let examined = locations(which, finder);
    let mut findings: Vec<Finding> = thread::scope(|scope| {
        let examinations: Vec<_> = examined
            .iter()
            .map(|place| {
                let thread = thread::Builder::new();
                (
                    place,
                    thread.spawn_scoped(scope, || diagnose(place, finder)),
                )
            })
            .collect();
        examinations
            .into_iter()
            .flat_map(|(place, examination)| match examination {
                Ok(examination) => examination
                    .join()
                    .unwrap_or_else(|panic| resume_unwind(panic)),
                // No thread could be started: examine one place after the other.
                Err(_) => diagnose(place, finder),
            })
            .collect()
    });
    findings.extend(together(which, finder, &findings));
    findings.extend(KINDS.into_iter().filter_map(image_beside));
    for finding in &findings {
        screen.say(&finding.line());
    }
    let value = json!({ "findings": findings.iter().map(Finding::json).collect::<Vec<_>>() });
    if findings.iter().any(|finding| finding.exit_code != 0) {
        let codes = findings.iter().map(|finding| finding.exit_code);
        // A missing machine outweighs a problem that a machine reports.
        let code = codes.filter(|code| *code != DONE).min().unwrap_or(FAILED);
        let help = "each finding above has its remedy";
        return Err(Failure::new("retrograde::doctor", code, summary(&findings), help).with(value));
    }
    Ok(value)
}

/// The places named by the user, or else all ports.
fn locations(which: &Which, finder: &Finder<'_>) -> Vec<Location> {
    let wanted = |kind: &DeviceKind| which.machine.is_none_or(|machine| *kind == machine.into());
    let mut all = vec![];
    let mut searched = false;
    for kind in KINDS.into_iter().filter(wanted) {
        match finder.address(kind) {
            Some(address) if *address != Address::Auto => all.push(Location {
                wanted: Some(kind),
                candidate: Candidate {
                    address: address.clone(),
                    kind: Some(kind),
                    description: String::new(),
                    may_ask: true,
                },
            }),
            Some(_) => searched = true,
            None => {}
        }
    }
    if searched || all.is_empty() {
        let found = finder.connector.candidates().into_iter();
        all.extend(found.map(|candidate| Location {
            wanted: None,
            candidate,
        }));
    }
    all
}

/// Examines one place and the machine there.
fn diagnose(place: &Location, finder: &Finder<'_>) -> Vec<Finding> {
    let candidate = &place.candidate;
    let name = match place.wanted {
        Some(kind) => format!("{} at {}", identity::kind_name(kind), candidate.address),
        None => format!("{} ({})", candidate.address, candidate.description),
    };
    if !candidate.may_ask {
        let text = "not an ST-LINK: another instrument may be there, so it was not asked; `--rig` or `--capsule` with this port asks it";
        return vec![Finding::fine(name, "not_asked", text.to_owned())];
    }
    match past_owners(|| examine(place, finder)) {
        Ok((identity, text, trouble)) => {
            let found = Some(identity);
            vec![match trouble {
                None => Finding {
                    found,
                    ..Finding::fine(name, "fine", text)
                },
                Some((code, trouble, remedy)) => Finding {
                    remedy: Some(remedy.to_owned()),
                    exit_code: FAULT,
                    found,
                    ..Finding::fine(name, code, format!("{trouble}; it is {text}"))
                },
            }]
        }
        Err(failure) => vec![Finding::wrong(name, &failure)],
    }
}

/// A problem that a machine reports itself: keyword, text and remedy.
type Trouble = Option<(&'static str, String, &'static str)>;

fn examine(place: &Location, finder: &Finder<'_>) -> Result<(Identity, String, Trouble), Failure> {
    let address = &place.candidate.address;
    let kind = place.candidate.kind.unwrap_or(DeviceKind::Rig);
    let mut device = finder.open(kind, address, LinkPurpose::Glance)?;
    device.ask_once(true);
    let identity = device.hello(finder.connector.nonce())?;
    device.require(place.wanted.unwrap_or(identity.device))?;
    let mut text = identity::line(&identity);
    if let Some(flash) = image::to_flash(&identity) {
        text.push_str(&format!("; {flash}"));
    }
    if let Some(owner) = device.owner() {
        text.push_str(&format!("; the line belongs to {owner}"));
    }
    let (fault, restarted) = match identity.device {
        DeviceKind::Rig => {
            let status = device.rig_status()?;
            let fault = status.fault.map(|fault| fault.to_string());
            (fault, status.needs_acknowledge)
        }
        DeviceKind::Capsule => {
            let status = device.capsule_status()?;
            let fault = status.fault.map(|fault| fault.to_string());
            (fault, status.needs_acknowledge)
        }
    };
    let trouble = match fault {
        Some(fault) => Some((
            "fault",
            fault,
            "once the cause is removed: `retrograde ack`",
        )),
        None if restarted => Some((
            "restarted",
            format!("it restarted after a failure: {}", device.last_words()?),
            "keep the last words, then `retrograde ack`",
        )),
        None => None,
    };
    Ok((identity, text, trouble))
}

/// The image that came with this tool, if there is one.
fn image_beside(kind: DeviceKind) -> Option<Finding> {
    let path = image::beside(kind)?;
    let mark = image::mark(&path).map_err(|why| why.to_string());
    let found = mark.and_then(|mark| {
        let firmware = identity::revision(&mark.revision);
        let machine = identity::kind_name(mark.machine);
        let Version { major, minor } = mark.protocol;
        let text = format!("{machine}, firmware {firmware}, protocol {major}.{minor}");
        let is_ours = mark.machine == kind && mark.schema_key == SCHEMA_KEY;
        if is_ours { Ok(text) } else { Err(text) }
    });
    let name = path.display().to_string();
    Some(match found {
        Ok(text) => Finding::fine(name, "image", text),
        Err(text) => Finding {
            remedy: Some("take the tool and both images from one release".to_owned()),
            exit_code: MISMATCH,
            ..Finding::fine(name, "other_image", text)
        },
    })
}

fn together(which: &Which, finder: &Finder<'_>, findings: &[Finding]) -> Vec<Finding> {
    let found = |kind| {
        let found = findings.iter().map(|finding| finding.found);
        found
            .filter(|found| found.is_some_and(|found| found.device == kind))
            .count()
    };
    let mut more = vec![];
    for kind in KINDS {
        let asked = match (which.machine, finder.address(kind)) {
            (Some(machine), _) if kind != machine.into() => false,
            (_, Some(Address::Auto) | None) => true,
            (_, Some(_)) => false,
        };
        let name = identity::kind_name(kind);
        if asked && found(kind) > 1 {
            more.push(Finding {
                remedy: Some(format!(
                    "say which one: `--{name} WHERE`, or RETROGRADE_{}",
                    name.to_uppercase()
                )),
                exit_code: NO_DEVICE,
                ..Finding::fine(
                    name.to_owned(),
                    "several",
                    format!(
                        "{} {name}s answer, and commands will not pick one",
                        found(kind)
                    ),
                )
            });
        }
    }
    let was_asked = findings.iter().any(|finding| finding.code != "not_asked");
    if !was_asked {
        let there = "no port with an ST-LINK, and no address was given".to_owned();
        let wanted = which.machine.map(DeviceKind::from);
        let name = wanted.map_or("any machine", identity::kind_name).to_owned();
        more.push(Finding::wrong(
            name,
            &Failure::NotFound {
                wanted: None,
                there,
            },
        ));
    }
    more
}

fn summary(findings: &[Finding]) -> String {
    let wrong = findings.iter().filter(|finding| finding.exit_code != 0);
    let list: Vec<_> = wrong
        .map(|finding| format!("{}: {}", finding.place, finding.code))
        .collect();
    format!("not everything is well: {}", list.join(", "))
}
