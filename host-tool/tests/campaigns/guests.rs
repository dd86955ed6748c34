//! Other processes that look at a machine while a campaign waits for an answer.

use std::sync::Mutex;
use std::sync::mpsc::channel;

use crate::campaign_run::{converse, path, place, small_plan};
use crate::support::asked::Asked;
use crate::support::tool::Memory;
use client::address::Address;
use client::link::owner::Question;
use client::link::{Link, OpenError};
use jiff::Timestamp;
use lab::operations::connector::{Connector, Purpose};
use protocol::capsule::GetCapsuleStatus;
use protocol::system::DeviceKind;
use protocol::table::{Endpoint as _, Reply, Response};
use simulated_machines::machine::{Script, World};

/// A bench at whose capsule's door another process has asked something.
struct Bench(Memory, Mutex<Option<Question>>);

impl Connector for Bench {
    fn open(
        &self,
        kind: DeviceKind,
        address: &Address,
        baud: u32,
        purpose: Purpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        let link = self.0.open(kind, address, baud, purpose)?;
        let mut asked = self.1.lock().expect("free");
        Ok(match asked.take_if(|_| kind == DeviceKind::Capsule) {
            Some(question) => Box::new(Asked::at(0, link, question)),
            None => link,
        })
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

#[test]
fn a_capsule_answers_other_processes_while_a_campaign_waits() {
    let mut rig = Script::new(DeviceKind::Rig);
    // The person answers once the rig is gone: until then the campaign waits.
    rig.world = vec![(3_000_000, World::Reset)];
    let (answers, answered) = channel();
    let question = Question::new(GetCapsuleStatus.into_request(), move |reply| {
        answers.send(reply).expect("heard");
    });
    let memory = Memory::with(vec![rig, Script::new(DeviceKind::Capsule)]);
    let bench = Bench(memory, Mutex::new(Some(question)));
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let lines = vec![("waited for even so", "q")];
    let (code, shown) = converse(&bench, &["run", &plan, "--out", &out], lines);
    assert_eq!(code, 130, "{shown}");
    let reply = answered
        .try_recv()
        .expect("it was taken")
        .expect("an answer");
    assert!(
        matches!(reply, Reply::Accepted(Response::GetCapsuleStatus(_))),
        "{reply:?}"
    );
}
