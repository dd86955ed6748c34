//! A motion whose rig is lost: each command says what may have become of it.

use client::address::Address;
use client::link::owner::Owner;
use client::link::{Link, LinkError, OpenError};
use client::{Device, Unobserved};
use jiff::Timestamp;
use lab::operations::connector::{Connector, LinkPurpose};
use lab::operations::failure::Failure;
use lab::trials::experiment::PAPER_RUN;
use protocol::rig::Home;
use protocol::system::DeviceKind;
use simulated_machines::machine::{Script, World, link};

use crate::support::tool::{self, ready};

/// Fault of the cable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// It is pulled, and the system reports it.
    Pulled,
    /// It breaks silently.
    Silent,
    /// It belonged to another process, which gives it up.
    GivenUp,
}

/// A cable with this fault from this instant of its clock on, us.
struct Cable {
    link: Box<dyn Link>,
    fault: Option<(Fault, u64)>,
}

impl Cable {
    fn fault(&self) -> Option<Fault> {
        let (fault, at_us) = self.fault?;
        (self.link.now_us() >= at_us).then_some(fault)
    }

    /// The error of a cable that is reported to be gone.
    fn error(&self, fault: Fault) -> LinkError {
        let place = self.link.place();
        match fault {
            Fault::GivenUp => LinkError::OwnerGone {
                place,
                owner: Box::new(Owner::this_process()),
            },
            Fault::Pulled | Fault::Silent => LinkError::Lost {
                place,
                why: "the device is gone".to_owned(),
            },
        }
    }
}

impl Link for Cable {
    fn place(&self) -> String {
        self.link.place()
    }

    fn now_us(&self) -> u64 {
        self.link.now_us()
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        match self.fault() {
            Some(Fault::Silent) => Ok(()),
            Some(fault) => Err(self.error(fault)),
            None => self.link.send(bytes),
        }
    }

    fn receive(&mut self, buffer: &mut [u8], deadline_us: u64) -> Result<usize, LinkError> {
        match self.fault() {
            Some(fault @ (Fault::Pulled | Fault::GivenUp)) => Err(self.error(fault)),
            Some(Fault::Silent) => {
                while self.link.now_us() < deadline_us {
                    self.link.receive(&mut [0; 256], deadline_us)?;
                }
                Ok(0)
            }
            None => self.link.receive(buffer, deadline_us),
        }
    }
}

/// A computer with one rig at such a cable.
struct Computer {
    script: Script,
    fault: Option<(Fault, u64)>,
}

impl Connector for Computer {
    fn open(
        &self,
        _: DeviceKind,
        _: &Address,
        _: u32,
        _: LinkPurpose,
    ) -> Result<Box<dyn Link>, OpenError> {
        Ok(Box::new(Cable {
            link: link(self.script.clone()).0,
            fault: self.fault,
        }))
    }

    fn nonce(&self) -> u32 {
        1
    }

    fn now(&self) -> Timestamp {
        Timestamp::UNIX_EPOCH
    }
}

/// Exit code and everything said.
fn said(script: Script, fault: Option<(Fault, u64)>, args: &[&str]) -> (u8, String) {
    let computer = Computer { script, fault };
    let (code, out, err) = tool::run(&computer, &[&["--rig", "0"], args].concat());
    (code, out + &err)
}

/// A capsule has no carriage to tell of, but it may have begun.
#[test]
fn an_order_whose_answer_is_lost_with_the_cable_may_be_moving() {
    for (kind, deaf) in [(DeviceKind::Capsule, "Fold"), (DeviceKind::Rig, "Home")] {
        let script = Script {
            deaf_to: vec![(deaf, 1_000)],
            ..ready(kind)
        };
        let cable = Cable {
            link: link(script).0,
            fault: Some((Fault::Pulled, 200_000)),
        };
        let mut device = Device::connect(Box::new(cable), kind, 1).expect("there");
        let error = match kind {
            DeviceKind::Capsule => device.fold().map(drop),
            _ => device.call(Home).map(drop),
        };
        let error = error.expect_err("lost");
        assert!(error.to_string().contains("MAY BE MOVING"), "{error}");
        let failure = Failure::from(error);
        assert!(failure.is_cut() && failure.exit_code() == 4);
    }
}

#[test]
fn a_command_that_loses_the_rig_says_what_may_have_become_of_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().display().to_string();
    let run = ["run", "--out", &out, "--duration-s", "40"];
    let with = |world| Script {
        world: vec![(5_000_000, world)],
        ..ready(DeviceKind::Rig)
    };
    let pulled = Some((Fault::Pulled, 5_000_000));
    let silent = Some((Fault::Silent, 5_000_000));
    let there = ready(DeviceKind::Rig);
    let moving = "MAY BE MOVING";
    let move_to = ["move", "120", "--speed-mm-s", "10"];
    for (script, fault, args, wanted, known) in [
        (there.clone(), pulled, &run[..], 4, moving),
        (there.clone(), silent, &run, 7, moving),
        (with(World::Reset), None, &run, 4, "it was reset, or"),
        (with(World::TimerStands), None, &run, 6, "a stop was sent"),
        (there, silent, &move_to, 7, moving),
        (
            Script::new(DeviceKind::Rig),
            Some((Fault::Silent, 1_000_000)),
            &["home"],
            7,
            moving,
        ),
    ] {
        let (code, said) = said(script, fault, args);
        let what = format!("{fault:?} {args:?}: {code} {said}");
        assert_eq!(code, wanted, "{what}");
        assert!(said.contains(known), "{what}");
        assert!(!said.to_lowercase().contains("nothing was"), "{what}");
    }
}

#[test]
fn a_rig_at_rest_that_is_lost_raises_no_alarm_before_an_order() {
    let cable = Cable {
        link: link(ready(DeviceKind::Rig)).0,
        fault: Some((Fault::Pulled, 1_000_000)),
    };
    let mut rig = Device::connect(Box::new(cable), DeviceKind::Rig, 1).expect("a rig");
    rig.rig_status().expect("there");
    let error = rig.fall_silent(2_000_000).expect_err("pulled");
    assert!(!error.may_move(), "{error:?}");
    // An order that may have arrived is another matter.
    let error = rig.call(Home).expect_err("pulled");
    assert!(error.may_move(), "{error:?}");
}

/// Whoever goes through another process's broker goes on by itself when that process ends, also during a motion.
#[test]
fn a_line_that_its_owner_has_given_up_is_not_a_lost_rig() {
    let cable = Cable {
        link: link(ready(DeviceKind::Rig)).0,
        fault: Some((Fault::GivenUp, 3_000_000)),
    };
    let mut rig = Device::connect(Box::new(cable), DeviceKind::Rig, 1).expect("a rig");
    let accepted = rig.run(PAPER_RUN).expect("accepted");
    let error = rig.wait_run(&accepted, &mut Unobserved);
    assert!(error.expect_err("given up").is_owner_gone());
}
