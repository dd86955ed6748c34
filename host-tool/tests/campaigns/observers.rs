//! Other processes that look at a machine while a campaign waits for an answer.

use std::sync::Mutex;
use std::sync::mpsc::channel;

use crate::campaign_run::{Place, small_plan};
use crate::support::asked::Asked;
use crate::support::mishap::Opened;
use client::link::Link;
use client::link::owner::Question;
use protocol::capsule::GetCapsuleStatus;
use protocol::system::DeviceKind;
use protocol::table::{Endpoint as _, Reply, Response};
use simulated_machines::machine::{Script, World, link};

#[test]
fn a_capsule_answers_other_processes_while_a_campaign_waits() {
    let mut rig = Script::new(DeviceKind::Rig);
    // The person answers once the rig is gone: until then the campaign waits.
    rig.world = vec![(3_000_000, World::Reset)];
    let (answers, answered) = channel();
    let question = Question::new(GetCapsuleStatus.into_request(), move |reply| {
        answers.send(reply).expect("heard");
    });
    let asked = Mutex::new(Some(question));
    let bench = Opened(|kind| match kind {
        DeviceKind::Rig => link(rig.clone()).0 as Box<dyn Link>,
        DeviceKind::Capsule => {
            let capsule = link(Script::new(kind)).0;
            let question = asked.lock().expect("free").take();
            Box::new(Asked::at(0, capsule, question.expect("opened once")))
        }
    });
    let at = Place::of(&small_plan(&[]));
    let lines = vec![("you can still answer", "q")];
    at.answered(&bench, 130, lines);
    let reply = answered
        .try_recv()
        .expect("it was taken")
        .expect("an answer");
    assert!(
        matches!(reply, Reply::Accepted(Response::GetCapsuleStatus(_))),
        "{reply:?}"
    );
}
