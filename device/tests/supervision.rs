//! The watchdog is fed only when motion, link and control have all checked in.

use device::supervision::{CheckIns, Client};
use proptest::prelude::*;

const CLIENTS: [Client; 3] = [Client::Motion, Client::Link, Client::Control];

proptest! {
    #[test]
    fn everybody_has_to_check_in_each_time(
        events in prop::collection::vec(prop::option::of(prop::sample::select(&CLIENTS[..])), 0..60),
    ) {
        let check_ins = CheckIns::new();
        let mut noted = Vec::new();
        for event in events {
            match event {
                Some(client) => {
                    check_ins.note(client);
                    noted.push(client);
                }
                None => {
                    let complete = CLIENTS.iter().all(|client| noted.contains(client));
                    prop_assert_eq!(check_ins.complete(), complete);
                    if complete {
                        noted.clear();
                    }
                }
            }
        }
    }
}

#[test]
fn nobody_alone_feeds_the_watchdog() {
    for missing in CLIENTS {
        let check_ins = CheckIns::default();
        for client in CLIENTS {
            if client != missing {
                check_ins.note(client);
                check_ins.note(client);
            }
        }
        assert!(!check_ins.complete(), "without {missing:?}");
        check_ins.note(missing);
        assert!(check_ins.complete());
        assert!(!check_ins.complete(), "all of them again");
    }
}
