//! Typed requests of a machine.

use std::collections::BTreeMap;

use protocol::capsule::{self, ActuationAccepted, ActuationRecord, CapsuleStatus};
use protocol::rig::{self, HomeAccepted, RigStatus, RunAccepted, RunRecord};
use protocol::settings::{GetSetting, SettingKey};
use protocol::system::{
    Acknowledge, DeviceKind, Events, GetEvents, GetLastWords, KeepAlive, SetTelemetry, Urgent,
};
use protocol::table::Endpoint;

use crate::device::Device;
use crate::error::ClientError;

impl Device {
    /// Sends any request of the protocol's table and unwraps its response.
    ///
    /// # Errors
    /// [`ClientError`]; [`crate::error::Missing::Outcome`] if a command was sent and not answered.
    pub fn call<E: Endpoint>(&mut self, request: E) -> Result<E::Response, ClientError> {
        let request = request.into_request();
        let name = request.name();
        let response = self.exchange(&request)?;
        E::from_response(response).ok_or_else(|| self.wrong_response(name))
    }

    pub(crate) fn wrong_response(&self, request: &'static str) -> ClientError {
        ClientError::NotUnderstood {
            place: self.place(),
            request,
            error: None,
        }
    }

    /// All settings of a machine of this kind by name.
    ///
    /// # Errors
    /// As [`Device::call`].
    pub fn settings(&mut self, kind: DeviceKind) -> Result<BTreeMap<String, u32>, ClientError> {
        let value = |key: SettingKey| {
            let value = self.call(GetSetting { key })?.value;
            Ok((key.name().to_owned(), value))
        };
        SettingKey::of(kind).map(value).collect()
    }

    /// Keeps the session alive: a moving device stops without requests.
    pub fn keep_alive(&mut self) -> Result<(), ClientError> {
        self.call(KeepAlive).map(|_| ())
    }

    /// Text of the last panic or processor fault; empty if there was none.
    pub fn last_words(&mut self) -> Result<String, ClientError> {
        Ok(self.call(GetLastWords)?.text.as_str().to_owned())
    }

    /// Sets the interval of telemetry in ms, 5..=1000, or 0 for none.
    pub fn set_telemetry(&mut self, period_ms: u16) -> Result<(), ClientError> {
        self.call(SetTelemetry { period_ms }).map(|_| ())
    }

    /// Fetches events from the device's ring, from index `from` on; not necessarily all.
    pub fn events(&mut self, from: u32) -> Result<Events, ClientError> {
        self.call(GetEvents { from })
    }

    /// Clears a latched fault after its cause was removed. Moves nothing.
    pub fn acknowledge(&mut self) -> Result<(), ClientError> {
        self.call(Acknowledge).map(|_| ())
    }

    pub fn rig_status(&mut self) -> Result<RigStatus, ClientError> {
        self.call(rig::GetRigStatus)
    }

    /// Begins homing; [`Device::wait_homing`] waits for its end.
    pub fn home(&mut self) -> Result<HomeAccepted, ClientError> {
        self.call(rig::Home)
    }

    /// Begins a run; [`Device::wait_run`] waits for its end. The device checks it, not the host.
    pub fn run(&mut self, run: rig::Run) -> Result<RunAccepted, ClientError> {
        self.call(run)
    }

    pub fn run_record(&mut self) -> Result<RunRecord, ClientError> {
        self.call(rig::GetRunRecord)
    }

    pub fn capsule_status(&mut self) -> Result<CapsuleStatus, ClientError> {
        self.call(capsule::GetCapsuleStatus)
    }

    /// Begins the search for the folded end of the thread; [`Device::wait_actuation`] waits for its end.
    pub fn reference(&mut self) -> Result<ActuationAccepted, ClientError> {
        self.call(capsule::Reference)
    }

    /// Begins to fold; [`Device::wait_actuation`] waits for its end.
    pub fn fold(&mut self) -> Result<ActuationAccepted, ClientError> {
        self.call(capsule::Fold)
    }

    /// Begins to unfold; [`Device::wait_actuation`] waits for its end.
    pub fn unfold(&mut self) -> Result<ActuationAccepted, ClientError> {
        self.call(capsule::Unfold)
    }

    pub fn actuation_record(&mut self) -> Result<ActuationRecord, ClientError> {
        self.call(capsule::GetActuationRecord)
    }

    /// Stops the machine, ahead of everything else. Needs no session and no matching protocol.
    ///
    /// # Errors
    /// [`crate::error::Missing::Stop`] if the device did not confirm, or the link's.
    pub fn urgent(&mut self, urgent: Urgent) -> Result<(), ClientError> {
        self.client.urgent(urgent);
        self.stop.unconfirmed = true;
        self.settle()
    }
}
