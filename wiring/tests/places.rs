//! The manual, its pictures and the bench's boards, which are made without this crate, name the same pins.

use std::path::Path;

use wiring::{Signal, board};

const MACHINES: [(&str, &[Signal]); 2] = [
    ("rig", &wiring::rig::SIGNALS),
    ("capsule", &wiring::capsule::SIGNALS),
];

fn read(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(name);
    std::fs::read_to_string(path).expect("a file of the repository")
}

/// Every signal stands in its picture, with all the names that its pin has: chip, board, shield, morpho.
#[test]
fn every_signal_is_drawn_with_the_names_of_its_pin() {
    for (machine, signals) in MACHINES {
        let picture = read(&format!("docs/pictures/{machine}-wiring.svg"));
        for signal in signals {
            let header = board::header_of(signal.pin).expect("a header of the board");
            let shield = match machine {
                "rig" => board::shield_label(header.arduino),
                _ => "",
            };
            for name in [
                &*signal.pin.to_string(),
                header.arduino,
                shield,
                header.morpho,
            ] {
                let drawn = name.is_empty() || picture.contains(&format!(">{name}<"));
                assert!(
                    drawn,
                    "{machine}-wiring.svg: {} without {name}",
                    signal.name
                );
            }
        }
    }
}

#[test]
fn manual_and_bench_have_the_same_pins() {
    let manual = read("docs/build.md");
    for signal in &wiring::rig::SIGNALS {
        let pin = signal.pin.to_string();
        let mut rows = manual.lines().filter(|line| line.starts_with('|'));
        let named = |row: &str| row.split(['|', ',']).any(|cell| cell.trim() == pin);
        assert!(rows.any(named), "docs/build.md has no row of {pin}");
    }
    for (machine, signals) in MACHINES {
        let bench = read(&format!("virtual-bench/src/boards/{machine}.rs"));
        // The serial port is the chip's in the emulator.
        for signal in signals
            .iter()
            .filter(|signal| !signal.name.starts_with("serial"))
        {
            let code = format!("Pin::new('{}', {})", signal.pin.port, signal.pin.number);
            assert!(
                bench.contains(&code),
                "{machine}: no {code}, {}",
                signal.name
            );
        }
    }
}

/// A pin that is used twice, or a place that two pins share, would be a short.
#[test]
fn no_pin_and_no_place_is_used_twice() {
    for (_, signals) in MACHINES {
        for (nth, signal) in signals.iter().enumerate() {
            assert!(signals[..nth].iter().all(|other| other.pin != signal.pin));
        }
    }
    for (nth, header) in board::HEADERS.iter().enumerate() {
        for other in &board::HEADERS[..nth] {
            assert!(other.pin != header.pin && other.morpho != header.morpho);
            assert!(header.arduino.is_empty() || other.arduino != header.arduino);
        }
    }
}
