//! The rig: board, shield, driver, switches, supplies.

use super::svg::{Anchor, Picture, Row, board};
use wiring::{Pin, board as places, rig};

const BOARD: (i32, i32) = (30, 60);
const BOARD_SIZE: (i32, i32) = (560, 840);
/// The board's right edge, where the wires begin.
const EDGE: i32 = BOARD.0 + BOARD_SIZE.0;
/// Columns within the board.
const CHIP: i32 = 250;
const ARDUINO: i32 = 310;
const SHIELD: i32 = 375;
const MORPHO: i32 = 465;
/// Ground at the ends of the switches' wires.
const GROUND: i32 = 1_110;

/// Where each signal's row is.
const ROWS: [(Pin, i32); 13] = [
    (rig::STEP, 120),
    (rig::DIR, 165),
    (rig::ENABLE, 240),
    (rig::READ_BACK, 290),
    (rig::CAPTURE, 330),
    (rig::ESTOP_LOOP, 420),
    (rig::HOME_FLAG, 520),
    (rig::FAR_LIMIT, 620),
    (rig::SYNC, 690),
    (rig::BUTTON, 745),
    (rig::LED, 795),
    (rig::SERIAL[0], 840),
    (rig::SERIAL[1], 875),
];

fn y_of(pin: Pin) -> i32 {
    ROWS.iter()
        .find(|(of, _)| *of == pin)
        .map_or(0, |(_, y)| *y)
}

pub(super) fn draw() -> String {
    let mut picture = Picture::new(1_260, 1_130);
    picture.text((30, 34), Anchor::Start, "title", "Rig: every wire");
    let heads = [
        (14, "signal"),
        (CHIP, "chip"),
        (ARDUINO, "board"),
        (SHIELD, "shield V3"),
        (MORPHO, "morpho pin"),
    ];
    board(&mut picture, BOARD, BOARD_SIZE, &heads, &rows());
    drive(&mut picture);
    jumpers(&mut picture);
    switches(&mut picture);
    rest(&mut picture);
    supplies(&mut picture);
    picture.finish("Wiring of the rig", "the pins in the crate `wiring`")
}

fn rows() -> Vec<Row> {
    let row = |signal: &wiring::Signal| {
        let place = places::place_of(signal.pin);
        let arduino = place.map_or("", |place| place.arduino);
        let morpho = place.map_or("", |place| place.morpho);
        Row {
            y: y_of(signal.pin),
            name: signal.name,
            cells: vec![
                (CHIP, signal.pin.to_string()),
                (ARDUINO, arduino.to_owned()),
                (SHIELD, places::shield_label(arduino).to_owned()),
                (MORPHO, morpho.to_owned()),
            ],
        }
    };
    rig::SIGNALS.iter().map(row).collect()
}

/// Driver and motor; the shield has these wires.
fn drive(picture: &mut Picture) {
    let (x, width) = (860, 270);
    picture.rect((x, 95), (width, 185), "part");
    picture.text(
        (x + 70, 118),
        Anchor::Start,
        "name",
        "driver in the X socket",
    );
    for (pin, name) in [(rig::STEP, "STEP"), (rig::DIR, "DIR"), (rig::ENABLE, "nEN")] {
        let y = y_of(pin);
        picture.line(&[(EDGE, y), (x, y)], "wire");
        picture.text((x + 8, y + 4), Anchor::Start, "", name);
    }
    let notes = [
        "inputs that take 3.3 V:",
        "DRV8825, or TMC2209 at 3.3 V",
        "current set before the motor",
    ];
    for (line, note) in (0..).zip(notes) {
        picture.text((x + 72, 150 + 17 * line), Anchor::Start, "note", note);
    }
    picture.text((x + 72, 252), Anchor::Start, "", "motor, NEMA 17:");
    picture.text(
        (x + 72, 269),
        Anchor::Start,
        "",
        "two coils at 1A 1B, 2A 2B",
    );
    picture.text((x - 130, 112), Anchor::Start, "note", "on the shield");
    picture.pull_up((720, y_of(rig::ENABLE)), "10 kohm", "3.3 V");
}

/// One pin to two more.
fn jumpers(picture: &mut Picture) {
    let x = 640;
    let (from, to) = (y_of(rig::STEP), y_of(rig::CAPTURE));
    picture.dot((x, from), "joint");
    picture.line(&[(x, from), (x, to), (EDGE, to)], "jumper");
    picture.line(
        &[(x, y_of(rig::READ_BACK)), (EDGE, y_of(rig::READ_BACK))],
        "jumper",
    );
    picture.dot((x, y_of(rig::READ_BACK)), "joint");
    let morpho = |pin| places::place_of(pin).map_or("", |place| place.morpho);
    let wire = format!(
        "one wire with three female ends: {}, {}, {}",
        morpho(rig::STEP),
        morpho(rig::READ_BACK),
        morpho(rig::CAPTURE)
    );
    picture.text((x + 14, 316), Anchor::Start, "", &wire);
    let note = "the shield leaves the morpho pins free";
    picture.text((x + 14, 334), Anchor::Start, "note", note);
}

/// E-stop loop, home flag, far limit: a pull-up, a small capacitor, contacts to ground.
fn switches(picture: &mut Picture) {
    let contacts: [(Pin, &[&str]); 3] = [
        (rig::ESTOP_LOOP, &["E-stop", "home end", "far end"]),
        (rig::HOME_FLAG, &["opens at 0 to 1 mm"]),
        (rig::FAR_LIMIT, &["opens beyond the stroke"]),
    ];
    for (pin, names) in contacts {
        let y = y_of(pin);
        picture.line(&[(EDGE, y), (810, y)], "wire");
        picture.pull_up((640, y), "1 to 2.2 kohm", "3.3 V");
        picture.capacitor((690, y), "RC at most 5 us");
        let mut x = 810;
        for name in names {
            picture.closed_contact((x, y), name);
            picture.line(&[(x + 60, y), (x + 95, y)], "wire");
            x += 95;
        }
        picture.line(&[(x, y), (GROUND, y)], "wire");
        picture.ground((GROUND, y));
    }
    let y = y_of(rig::ESTOP_LOOP) + 24;
    picture.text(
        (850, y),
        Anchor::Start,
        "note",
        "normally closed, in series",
    );
    let y = y_of(rig::HOME_FLAG) + 24;
    picture.text((850, y), Anchor::Start, "note", "normally closed");
    let y = y_of(rig::FAR_LIMIT) + 24;
    picture.text((850, y), Anchor::Start, "note", "normally closed");
}

/// Camera, button, LED, serial port.
fn rest(picture: &mut Picture) {
    let y = y_of(rig::SYNC);
    picture.line(&[(EDGE, y), (780, y)], "wire");
    picture.rect((780, y - 16), (350, 32), "part");
    let camera = "camera, or LED with 330 ohm, to GND; optional";
    picture.text((792, y + 4), Anchor::Start, "", camera);
    let y = y_of(rig::BUTTON);
    picture.line(&[(EDGE, y), (640, y)], "wire");
    picture.open_contact((640, y));
    picture.line(&[(700, y), (740, y)], "wire");
    picture.ground((740, y));
    let button = "blue button B1, on the board; another one may be added";
    picture.text((765, y + 4), Anchor::Start, "note", button);
    let y = y_of(rig::LED);
    picture.text(
        (EDGE + 14, y + 4),
        Anchor::Start,
        "note",
        "green LED LD2, on the board: no wire",
    );
    let y = y_of(rig::SERIAL[0]);
    let serial =
        "USB cable, through the ST-LINK: no wire. D1 and D0 are not connected to these pins";
    picture.text((EDGE + 14, y + 21), Anchor::Start, "note", serial);
}

/// Motor supply and board supply.
fn supplies(picture: &mut Picture) {
    let y = 965;
    picture.rect((30, y - 30), (150, 60), "part");
    picture.text((44, y - 4), Anchor::Start, "name", "24 V supply");
    picture.text((44, y + 14), Anchor::Start, "note", "of the motor");
    picture.line(&[(180, y), (300, y)], "power");
    picture.rect((300, y - 30), (190, 60), "part");
    picture.text((314, y - 4), Anchor::Start, "name", "switch within reach");
    picture.text(
        (314, y + 14),
        Anchor::Start,
        "note",
        "cuts the motor's supply",
    );
    picture.line(&[(490, y), (860, y)], "power");
    picture.capacitor((640, y), "47 uF or more, right at the driver");
    picture.rect((860, y - 30), (270, 60), "part");
    picture.text(
        (874, y - 4),
        Anchor::Start,
        "name",
        "VMOT and GND of the shield",
    );
    picture.text(
        (874, y + 14),
        Anchor::Start,
        "note",
        "screw terminal; mind the polarity",
    );
    let y = 1_070;
    picture.rect((30, y - 30), (150, 60), "part");
    picture.text((44, y - 4), Anchor::Start, "name", "7 to 12 V, or 5 V");
    picture.text((44, y + 14), Anchor::Start, "note", "of the board");
    picture.line(&[(180, y), (300, y)], "power");
    picture.rect((300, y - 30), (830, 60), "part");
    let text = "7 to 12 V at VIN (CN7-24), or 5 V at E5V (CN7-6); GND (CN7-20). JP5 on E5V (pins 2-3), JP1 open; then USB";
    picture.text((314, y - 4), Anchor::Start, "", text);
    let text = "without it: JP5 on U5V (pins 1-2), and everything hangs on the USB cable";
    picture.text((314, y + 14), Anchor::Start, "note", text);
}
