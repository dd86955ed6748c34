//! The last known place of the carriage when its rig is lost during a motion: one sentence for the error.

use std::fmt;

use crate::decimal;

/// The rig's last answer, and the possible course of its motion since.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LastSeen {
    /// Position of the carriage, um, and age of the answer that gave it, us; none if the rig was not homed then.
    pub at: Option<(i32, u64)>,
    /// Possible course of the motion since.
    pub since: Since,
}

/// Possible course of the motion since the last answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Since {
    /// The rig brakes by itself when it has not heard from this tool for this long, ms.
    Brakes {
        /// The rig's `link_timeout_ms`.
        after_ms: u32,
    },
    /// The run goes on to its end without this tool, as it was started.
    Finishes,
    /// The rig has confirmed a stop.
    Stopped,
    /// The rig was reset, which ends every motion, or another program commands it.
    Taken,
}

impl LastSeen {
    /// The last known place, in words.
    pub(crate) fn place(&self) -> String {
        match self.at {
            Some((position_um, _)) => format!(
                "the carriage was at {} mm when the rig last answered",
                decimal::fixed(position_um.into(), 3)
            ),
            None => "where the carriage is was not known, because the rig was not homed".to_owned(),
        }
    }
}

impl fmt::Display for LastSeen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.at {
            Some((_, age_us)) => write!(
                f,
                "{}, {} s before, ",
                self.place(),
                decimal::fixed((age_us / 100_000).cast_signed(), 1)
            )?,
            None => write!(f, "{}, ", self.place())?,
        }
        match self.since {
            Since::Brakes { after_ms } => write!(
                f,
                "and it may still be moving: the rig brakes once it has not heard from this tool for {} s",
                decimal::write(after_ms.into(), 3)
            )?,
            Since::Finishes => f.write_str(
                "and it may still be moving: this run goes on to its end without this tool",
            )?,
            Since::Stopped => f.write_str("and the rig has confirmed a stop since")?,
            Since::Taken => f.write_str(
                "and it is not moving if the rig was reset, but may be if another program commands it",
            )?,
        }
        f.write_str("; `retrograde info rig` says where it is now")
    }
}

/// Alarm for a machine of which nothing is known.
pub(crate) const MAY_MOVE: &str = ": it MAY BE MOVING";

/// The sentence as the end of an error's text; empty if nothing could move.
pub(crate) fn after(seen: Option<&LastSeen>) -> String {
    seen.map(|seen| format!("; {seen}")).unwrap_or_default()
}

/// Like `after`, for a machine that was ordered to move: if nothing is known, says that it may be moving.
pub(crate) fn or_moving(seen: Option<&LastSeen>) -> String {
    match seen {
        Some(_) => after(seen),
        None => MAY_MOVE.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_says_position_age_motion_and_command_in_one_sentence() {
        let at = Some((43_210, 860_000));
        for (at, since, text) in [
            (
                at,
                Since::Brakes { after_ms: 1_000 },
                "the carriage was at 43.210 mm when the rig last answered, 0.8 s before, and it may still be moving: the rig brakes once it has not heard from this tool for 1 s",
            ),
            (
                Some((-5, 0)),
                Since::Finishes,
                "the carriage was at -0.005 mm when the rig last answered, 0.0 s before, and it may still be moving: this run goes on to its end without this tool",
            ),
            (
                None,
                Since::Stopped,
                "where the carriage is was not known, because the rig was not homed, and the rig has confirmed a stop since",
            ),
            (
                at,
                Since::Taken,
                "the carriage was at 43.210 mm when the rig last answered, 0.8 s before, and it is not moving if the rig was reset, but may be if another program commands it",
            ),
        ] {
            let said = LastSeen { at, since }.to_string();
            assert_eq!(
                said,
                format!("{text}; `retrograde info rig` says where it is now")
            );
        }
    }
}
