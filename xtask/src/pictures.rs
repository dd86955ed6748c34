//! Draws pictures of the manual: the wiring from the pins that the images use, and a terminal's screen. The other SVG
//! files beside them are changed by hand.

mod capsule;
mod rig;
mod screens;
mod svg;
mod watch;

use std::path::{Path, PathBuf};

use crate::process::{Failure, Result, host_cargo, root, run};

/// The pictures that are drawn and where they are, from the root.
fn all() -> [(&'static str, String); 3] {
    [
        ("docs/pictures/rig-wiring.svg", rig::draw()),
        ("docs/pictures/capsule-wiring.svg", capsule::draw()),
        ("docs/pictures/watch.svg", watch::draw()),
    ]
}

/// Draws all of them; with a browser, takes those of the page and of a report as well.
///
/// # Errors
/// A file that cannot be written, or a program that fails.
pub(crate) fn draw(browser: Option<&Path>) -> Result<()> {
    for (name, picture) in all() {
        let path: PathBuf = root().join(name);
        let written = path
            .parent()
            .map_or(Ok(()), std::fs::create_dir_all)
            .and_then(|()| std::fs::write(&path, picture));
        written.map_err(|why| Failure::new(format!("{name}: {why}"), "is the folder writable?"))?;
        println!("{name}");
    }
    // Figures 7 and 8 are drawn by the tool itself, in the test that keeps them.
    let mut test = host_cargo("test");
    test.args(["--locked", "--package", "host-tool", "--test", "campaigns"])
        .arg("the_manuals_figures")
        .env("RETROGRADE_PICTURES", "draw");
    run(&mut test, "see the test above")?;
    browser.map_or(Ok(()), screens::take)
}

#[cfg(test)]
mod tests {
    use super::*;
    use wiring::{Signal, board};

    /// A change of a pin or of a drawing changes its picture, and this says so.
    #[test]
    fn the_manuals_pictures_are_those_that_are_drawn() {
        for (name, picture) in all() {
            let drawn = std::fs::read_to_string(root().join(name)).unwrap_or_default();
            assert!(
                drawn == picture,
                "{name}: `cargo xtask pictures` draws it anew"
            );
        }
    }

    /// The places at which a signal has to be found: chip, Arduino socket, shield, morpho.
    fn names(signal: &Signal, shield: bool) -> Vec<String> {
        let place = board::place_of(signal.pin).expect("a place on the board");
        let shield = match shield {
            true => board::shield_label(place.arduino),
            false => "",
        };
        let names = [
            signal.pin.to_string(),
            place.arduino.to_owned(),
            shield.to_owned(),
            place.morpho.to_owned(),
        ];
        names.into_iter().filter(|name| !name.is_empty()).collect()
    }

    /// Every signal is in its picture, with all the names that its pin has.
    #[test]
    fn every_signal_is_drawn_with_the_names_of_its_pin() {
        let (rig, capsule) = (rig::draw(), capsule::draw());
        let drawn = [
            (wiring::rig::SIGNALS.as_slice(), &rig, true),
            (&wiring::capsule::SIGNALS, &capsule, false),
        ];
        for (signals, picture, shield) in drawn {
            for signal in signals {
                for name in names(signal, shield) {
                    let text = format!(">{name}<");
                    assert!(picture.contains(&text), "{}: no {name}", signal.name);
                }
            }
        }
    }

    /// The table of the manual, and those of the bench's boards, which are made without this one, name the same pins.
    #[test]
    fn manual_and_bench_have_the_same_pins() {
        let text = |name: &str| std::fs::read_to_string(root().join(name)).expect("a file");
        let manual = text("docs/rig.md");
        for signal in &wiring::rig::SIGNALS {
            let pin = signal.pin.to_string();
            let row = manual
                .lines()
                .filter(|line| line.starts_with('|'))
                .find(|line| line.split(['|', ',']).any(|cell| cell.trim() == pin));
            let row = row.unwrap_or_else(|| panic!("docs/rig.md has no row of {pin}"));
            let place = board::place_of(signal.pin).expect("a place");
            if row.contains("shield") || place.arduino.starts_with('A') {
                assert!(row.contains(place.arduino), "{row} lacks {}", place.arduino);
            }
        }
        let boards = [
            (
                "virtual-bench/src/boards/rig.rs",
                wiring::rig::SIGNALS.as_slice(),
            ),
            (
                "virtual-bench/src/boards/capsule.rs",
                &wiring::capsule::SIGNALS,
            ),
        ];
        for (file, signals) in boards {
            let bench = text(file);
            for signal in signals {
                // The serial port is the chip's in the bench's emulator.
                if signal.name.starts_with("serial") {
                    continue;
                }
                let code = format!("Pin::new('{}', {})", signal.pin.port, signal.pin.number);
                assert!(
                    bench.contains(&code),
                    "{file} has no {code}: {}",
                    signal.name
                );
            }
        }
    }

    /// Pins that are used twice, or places that two pins share, would be a short.
    #[test]
    fn no_pin_and_no_place_is_used_twice() {
        for signals in [wiring::rig::SIGNALS.as_slice(), &wiring::capsule::SIGNALS] {
            for (nth, signal) in signals.iter().enumerate() {
                assert!(signals[..nth].iter().all(|other| other.pin != signal.pin));
            }
        }
        for (nth, place) in board::PLACES.iter().enumerate() {
            for other in &board::PLACES[..nth] {
                assert!(other.pin != place.pin && other.morpho != place.morpho);
                assert!(place.arduino.is_empty() || other.arduino != place.arduino);
            }
        }
    }
}
