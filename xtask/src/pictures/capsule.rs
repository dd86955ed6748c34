//! The capsule on the board on which it is studied: bridge, motor, sensors, cell.

use super::svg::{Anchor, Picture, Row, board};
use wiring::{Pin, board as places, capsule};

const BOARD: (i32, i32) = (30, 60);
const BOARD_SIZE: (i32, i32) = (400, 640);
const EDGE: i32 = BOARD.0 + BOARD_SIZE.0;
const CHIP: i32 = 150;
const ARDUINO: i32 = 215;
const MORPHO: i32 = 290;
/// The parts on the right.
const PARTS: i32 = 640;

const ROWS: [(Pin, i32); 11] = [
    (capsule::IN1, 120),
    (capsule::IN2, 160),
    (capsule::N_SLEEP, 200),
    (capsule::N_FAULT, 265),
    (capsule::CURRENT, 345),
    (capsule::ENCODER[0], 425),
    (capsule::ENCODER[1], 465),
    (capsule::SENSORS, 520),
    (capsule::BATTERY, 600),
    (capsule::SERIAL[0], 645),
    (capsule::SERIAL[1], 680),
];

fn y_of(pin: Pin) -> i32 {
    ROWS.iter()
        .find(|(of, _)| *of == pin)
        .map_or(0, |(_, y)| *y)
}

pub(super) fn draw() -> String {
    let mut picture = Picture::new(1_170, 740);
    picture.text(
        (30, 34),
        Anchor::Start,
        "title",
        "Capsule, on a NUCLEO-F411RE: every wire",
    );
    let heads = [
        (14, "signal"),
        (CHIP, "chip"),
        (ARDUINO, "board"),
        (MORPHO, "morpho pin"),
    ];
    board(&mut picture, BOARD, BOARD_SIZE, &heads, &rows());
    bridge(&mut picture);
    motor(&mut picture);
    sensors(&mut picture);
    cell(&mut picture);
    picture.finish("Wiring of the capsule", "the pins in the crate `wiring`")
}

fn rows() -> Vec<Row> {
    let row = |signal: &wiring::Signal| {
        let place = places::place_of(signal.pin);
        let text = |of: Option<&'static str>| of.unwrap_or_default().to_owned();
        Row {
            y: y_of(signal.pin),
            name: signal.name,
            cells: vec![
                (CHIP, signal.pin.to_string()),
                (ARDUINO, text(place.map(|place| place.arduino))),
                (MORPHO, text(place.map(|place| place.morpho))),
            ],
        }
    };
    capsule::SIGNALS.iter().map(row).collect()
}

fn bridge(picture: &mut Picture) {
    picture.rect((PARTS, 90), (200, 205), "part");
    picture.text((PARTS + 90, 114), Anchor::Start, "name", "H-bridge");
    picture.text((PARTS + 90, 131), Anchor::Start, "note", "DRV8411 class");
    for (pin, name) in [
        (capsule::IN1, "IN1"),
        (capsule::IN2, "IN2"),
        (capsule::N_SLEEP, "nSLEEP"),
        (capsule::N_FAULT, "nFAULT"),
    ] {
        let y = y_of(pin);
        picture.line(&[(EDGE, y), (PARTS, y)], "wire");
        picture.text((PARTS + 8, y + 4), Anchor::Start, "", name);
    }
    picture.pull_down((480, y_of(capsule::N_SLEEP)), "100 kohm");
    let y = y_of(capsule::N_FAULT) - 8;
    picture.text(
        (EDGE + 14, y),
        Anchor::Start,
        "note",
        "open drain; the chip pulls it up",
    );
    picture.text((PARTS + 90, 235), Anchor::Start, "note", "ISEN to GND: no");
    picture.text((PARTS + 90, 250), Anchor::Start, "note", "shunt there");
}

/// The shunt is between bridge and motor, so that it also measures the current that circulates between two pulses.
fn motor(picture: &mut Picture) {
    let right = PARTS + 200;
    picture.text((right - 48, 164), Anchor::Start, "", "OUT1");
    picture.text((right - 48, 204), Anchor::Start, "", "OUT2");
    picture.line(&[(right, 160), (930, 160)], "power");
    picture.rect((930, 152), (44, 16), "part");
    picture.text((952, 144), Anchor::Middle, "name", "shunt 0.05 ohm");
    picture.line(&[(974, 160), (1_060, 160)], "power");
    picture.line(&[(right, 200), (1_060, 200)], "power");
    picture.rect((1_040, 140), (100, 80), "part");
    picture.text((1_090, 176), Anchor::Middle, "name", "motor");
    picture.text((1_090, 194), Anchor::Middle, "note", "and encoder");
    // The amplifier, across the shunt.
    let y = y_of(capsule::CURRENT);
    picture.line(&[(930, 160), (910, 160), (910, y - 25)], "wire");
    picture.line(&[(974, 160), (994, 160), (994, y - 25)], "wire");
    picture.dot((910, 160), "dot");
    picture.dot((994, 160), "dot");
    picture.rect((880, y - 25), (150, 50), "part");
    picture.text((955, y - 4), Anchor::Middle, "name", "amplifier");
    picture.text(
        (955, y + 14),
        Anchor::Middle,
        "note",
        "zero at half its supply",
    );
    picture.line(&[(EDGE, y), (880, y)], "wire");
    let note = "1 mV per mA, behind 1 kohm and 160 nF";
    picture.text((EDGE + 14, y - 8), Anchor::Start, "note", note);
}

/// Encoder and amplifier are powered only while the capsule moves.
fn sensors(picture: &mut Picture) {
    let (a, b) = (y_of(capsule::ENCODER[0]), y_of(capsule::ENCODER[1]));
    picture.line(&[(EDGE, a), (1_100, a), (1_100, 220)], "wire");
    picture.line(&[(EDGE, b), (1_125, b), (1_125, 220)], "wire");
    picture.text(
        (EDGE + 14, a - 8),
        Anchor::Start,
        "note",
        "encoder, 16 lines; the chip pulls both up",
    );
    let y = y_of(capsule::SENSORS);
    picture.line(&[(EDGE, y), (PARTS, y)], "wire");
    picture.pull_down((480, y), "100 kohm");
    picture.rect((PARTS, y - 22), (200, 44), "part");
    picture.text(
        (PARTS + 12, y - 3),
        Anchor::Start,
        "name",
        "switch of 3.3 V",
    );
    picture.text(
        (PARTS + 12, y + 13),
        Anchor::Start,
        "note",
        "high = on; fed from CN7-16",
    );
    picture.line(
        &[
            (PARTS + 200, y),
            (955, y),
            (955, y_of(capsule::CURRENT) + 25),
        ],
        "power",
    );
    picture.text((862, y - 8), Anchor::Start, "note", "3.3 V of the");
    picture.text((862, y + 18), Anchor::Start, "note", "encoder, too");
}

fn cell(picture: &mut Picture) {
    let y = y_of(capsule::BATTERY);
    picture.line(&[(EDGE, y), (PARTS, y)], "wire");
    picture.pull_down((480, y), "100 kohm");
    picture.rect((560, y - 5), (28, 10), "part");
    picture.text(
        (EDGE + 14, y - 12),
        Anchor::Start,
        "note",
        "100 kohm; 3.3 nF A3 to GND",
    );
    picture.rect((PARTS, y - 22), (200, 44), "part");
    picture.text(
        (PARTS + 12, y - 3),
        Anchor::Start,
        "name",
        "lithium cell, 40 mAh",
    );
    picture.text(
        (PARTS + 12, y + 13),
        Anchor::Start,
        "note",
        "to VM of the bridge, and GND",
    );
    let note = "USB cable, through the ST-LINK: no wire. D1 and D0 are not connected to these pins";
    let y = y_of(capsule::SERIAL[0]);
    picture.text((EDGE + 14, y + 21), Anchor::Start, "note", note);
}
