//! Reconnects to a machine that was unreachable while a question waited: unplugged, or switched off.

use client::Device;
use protocol::system::DeviceKind;
use serde_json::Value;

use crate::campaign::conduct::{Broken, Conduct, Connect, Machines, Next};
use crate::campaign::resumption;

/// Facts not compared: they change at each start of the machine, or are a remark of the tool.
const PASSING: [&str; 3] = ["boot_id", "reset_cause", "commissioning"];

impl Machines {
    /// Opens a new session with each machine that does not answer.
    fn reconnect(&mut self, connect: &mut Connect<'_>) -> Result<(), String> {
        let stopped = &mut self.stopped;
        let mut again = |device: &mut Device, kind| {
            // The old link keeps the line until it is dropped.
            device.hang_up();
            *stopped = (*stopped).max(device.interrupted());
            connect(kind).map(|new| *device = new)
        };
        if self.rig.rig_status().is_err() {
            again(&mut self.rig, DeviceKind::Rig)?;
        }
        if let Some(capsule) = &mut self.capsule
            && capsule.capsule_status().is_err()
        {
            again(capsule, DeviceKind::Capsule)?;
        }
        Ok(())
    }
}

impl Conduct<'_> {
    /// Whether motion is allowed after Enter: the machines answer, and no stop came while the question waited.
    pub(super) fn may_move(&mut self) -> Result<Next, Broken> {
        if !self.is_reached()? {
            return Ok(self.reread_or_quit());
        }
        // A stop is noticed with the next frame.
        self.machines.rig.rig_status()?;
        if let Some(capsule) = &mut self.machines.capsule {
            capsule.capsule_status()?;
        }
        self.report_stop()
    }

    /// Whether the machines answer. A machine that was unreachable gets a new session if the same one is back; homing
    /// is then needed again, as in a new session of the tool.
    ///
    /// # Errors
    /// Another machine answers, or one with another image or other settings, which would mix records of two machines.
    fn is_reached(&mut self) -> Result<bool, Broken> {
        if !self.gone {
            return Ok(true);
        }
        if let Err(why) = self.machines.reconnect(self.connect) {
            self.prompter
                .say(&format!("  {why}; Enter tries again, q quits"));
            return Ok(false);
        }
        let found = self.machines.facts()?;
        let differs = differences(&self.machines.known, &found, "");
        if !differs.is_empty() {
            return Err(Broken::NotReady {
                why: format!("what answers now is not as before: {}", differs.join(", ")),
                help: format!(
                    "reconnect the original machine, or continue with this one in a new session: {}",
                    resumption(&self.folder.campaign().folder)
                ),
            });
        }
        self.machines.known = found;
        for machine in self.machines.come_to_rest()? {
            self.prompter.say(&format!(
                "  the {machine} was moving without a host: it was stopped"
            ));
        }
        self.machines.homed = None;
        (self.gone, self.homed_in) = (false, None);
        self.prompter
            .say("  the machine is back, and the same: on with it");
        Ok(true)
    }
}

/// Differences between the facts of two sessions, in words.
fn differences(before: &Value, now: &Value, name: &str) -> Vec<String> {
    match (before, now) {
        (Value::Object(before), Value::Object(now)) => {
            let facts = before.iter().filter(|(key, _)| !PASSING.contains(&&***key));
            let differ = facts.flat_map(|(key, before)| {
                let name = format!("{name} {key}");
                differences(before, now.get(key).unwrap_or(&Value::Null), &name)
            });
            differ.collect()
        }
        _ if before == now => vec![],
        _ => vec![format!("{} is {now}, was {before}", name.trim())],
    }
}
