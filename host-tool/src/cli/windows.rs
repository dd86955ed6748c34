//! What a command may do when another process owns the line.

use client::Device;
use client::error::ClientError;

use crate::cli::args::{CampaignSubcommand, CapsuleSubcommand, SettingsSubcommand, Subcommand};

/// Refuses a command for the line's owner before anything is sent or recorded.
///
/// # Errors
/// [`ClientError::Owned`] names the owner.
pub(crate) fn admit(subcommand: &Subcommand, device: &Device) -> Result<(), ClientError> {
    match (device.owner(), for_owner(subcommand)) {
        (Some(owner), Some(request)) => Err(ClientError::Owned {
            place: device.place(),
            request,
            owner: Box::new(owner.clone()),
        }),
        _ => Ok(()),
    }
}

/// The command gives the rig a name, or asks for it.
pub(crate) fn is_naming(subcommand: &Subcommand) -> bool {
    matches!(
        subcommand,
        Subcommand::Settings {
            subcommand: SettingsSubcommand::Name { .. },
            ..
        }
    )
}

/// The command, if it moves something, writes settings, or needs the whole line.
pub(crate) fn for_owner(subcommand: &Subcommand) -> Option<&'static str> {
    Some(match subcommand {
        Subcommand::Home => "home",
        Subcommand::Run(_) => "run",
        Subcommand::Commission(_) => "commission",
        Subcommand::Campaign { subcommand } => match subcommand {
            CampaignSubcommand::Run(_) => "campaign run",
            CampaignSubcommand::Resume(_) => "campaign resume",
            CampaignSubcommand::New(_)
            | CampaignSubcommand::Status(_)
            | CampaignSubcommand::Edit(_) => return None,
        },
        Subcommand::Capsule { subcommand } => match subcommand {
            CapsuleSubcommand::Reference(_) => "capsule reference",
            CapsuleSubcommand::Calibrate(_) => "capsule calibrate",
            CapsuleSubcommand::Check(_) => "capsule check",
            // While readings are added it would fill the line, and not come to an end.
            CapsuleSubcommand::Trace(_) => "capsule trace",
            CapsuleSubcommand::Cycle(_) => "capsule cycle",
            CapsuleSubcommand::Identify(_) => "capsule identify",
        },
        Subcommand::Fold(_) => "fold",
        Subcommand::Unfold(_) => "unfold",
        Subcommand::Jog(_) => "jog",
        Subcommand::Move(_) => "move",
        Subcommand::Settings { subcommand, .. } => match subcommand {
            SettingsSubcommand::Set { .. } => "settings set",
            SettingsSubcommand::Import { .. } => "settings import",
            SettingsSubcommand::Name { name: Some(_) } => "settings name",
            SettingsSubcommand::Reset { .. } => "settings reset",
            SettingsSubcommand::List
            | SettingsSubcommand::Get { .. }
            | SettingsSubcommand::Export { .. }
            | SettingsSubcommand::Name { name: None } => return None,
        },
        Subcommand::Devices
        | Subcommand::Doctor(_)
        | Subcommand::Info(_)
        | Subcommand::Stop(_)
        | Subcommand::Estop(_)
        | Subcommand::Ack(_)
        | Subcommand::Hold
        | Subcommand::Resume
        | Subcommand::Health
        | Subcommand::Serve(_)
        | Subcommand::Watch(_)
        | Subcommand::Plan(_)
        | Subcommand::Design(_)
        | Subcommand::Simulate(_)
        | Subcommand::Fit(_)
        | Subcommand::PlanExperiment(_)
        | Subcommand::List(_)
        | Subcommand::Report(_)
        | Subcommand::Verify(_)
        | Subcommand::Records { .. }
        | Subcommand::Flash(_)
        | Subcommand::Completions { .. }
        | Subcommand::Man { .. } => return None,
    })
}
