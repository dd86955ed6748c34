//! The page: what it offers in a state is what the machine takes then, and the stops come first for the Tab key.

use client::error::ClientError;
use client::{Device, Unobserved, wording};
use lab::trials::experiment::PAPER_RUN;
use protocol::capsule::{CapsuleState, CheckFolded};
use protocol::rig::{Direction, Hold, Jog, MoveTo, Resume, RigState};
use protocol::system::{DeviceKind, Urgent};
use simulated_machines::machine::{Script, link};

const PAGE: &str = include_str!("../../serve/src/page.html");

/// A button and its states.
#[derive(Debug)]
struct Button {
    /// Its command, such as `rig/home`.
    command: String,
    offered_in: Vec<String>,
    main_in: Vec<String>,
}

fn attribute<'a>(tag: &'a str, name: &str) -> Option<&'a str> {
    let (_, rest) = tag.split_once(&format!("{name}=\""))?;
    rest.split('"').next()
}

/// The buttons that follow the state of a machine.
fn buttons() -> Vec<Button> {
    let words = |text: Option<&str>| -> Vec<String> {
        let text = text.unwrap_or_default();
        text.split_whitespace().map(str::to_owned).collect()
    };
    let tags = PAGE.split("<button").skip(1);
    tags.filter_map(|tag| {
        let tag = tag.split('>').next()?;
        let command = attribute(tag, "data-command")
            .or(attribute(tag, "data-submits"))
            .or(attribute(tag, "data-jog").map(|_| "rig/jog"))?;
        Some(Button {
            command: command.to_owned(),
            offered_in: words(attribute(tag, "data-in")),
            main_in: words(attribute(tag, "data-main")),
        })
    })
    .collect()
}

fn rig_in(state: RigState) -> Device {
    let mut script = Script::new(DeviceKind::Rig);
    script.ready = state != RigState::Unhomed;
    let mut rig = Device::connect(link(script).0, DeviceKind::Rig, 1).expect("a rig");
    match state {
        RigState::Running | RigState::Held => {
            rig.run(PAPER_RUN).expect("accepted");
        }
        RigState::Faulted => rig.urgent(Urgent::EStop).expect("stopped"),
        RigState::Moving => {
            let to = MoveTo {
                position_um: 100_000,
                speed_um_s: 5_000,
            };
            rig.call(to).expect("accepted");
        }
        _ => {}
    }
    if state == RigState::Held {
        rig.call(Hold).expect("accepted");
        rig.wait_rest(&mut Unobserved).expect("stands");
    }
    assert_eq!(rig.rig_status().expect("a status").state, state);
    rig
}

fn capsule_in(state: CapsuleState) -> Device {
    let mut script = Script::new(DeviceKind::Capsule);
    // A new one is unreferenced.
    script.ready = state != CapsuleState::Unreferenced;
    let mut capsule = Device::connect(link(script).0, DeviceKind::Capsule, 1).expect("a capsule");
    match state {
        CapsuleState::Folding | CapsuleState::Folded => {
            let accepted = capsule.fold().expect("accepted");
            if state == CapsuleState::Folded {
                let ended = capsule.wait_actuation(&accepted, &mut Unobserved);
                ended.expect("folded");
            }
        }
        CapsuleState::Faulted => capsule.urgent(Urgent::EStop).expect("stopped"),
        _ => {}
    }
    assert_eq!(capsule.capsule_status().expect("a status").state, state);
    capsule
}

/// Sends the command of a button.
fn press(device: &mut Device, command: &str) -> Result<(), ClientError> {
    let jog = Jog {
        direction: Direction::Away,
        speed_um_s: 5_000,
    };
    let to = MoveTo {
        position_um: 50_000,
        speed_um_s: 20_000,
    };
    match command {
        "rig/home" => device.home().map(drop),
        "rig/run" => device.run(PAPER_RUN).map(drop),
        "rig/hold" => device.call(Hold).map(drop),
        "rig/resume" => device.call(Resume).map(drop),
        "rig/move" => device.call(to).map(drop),
        "rig/jog" => device.call(jog).map(drop),
        "rig/ack" | "capsule/ack" => device.acknowledge(),
        "capsule/fold" => device.fold().map(drop),
        "capsule/unfold" => device.unfold().map(drop),
        "capsule/reference" => device.reference().map(drop),
        "capsule/check" => device.call(CheckFolded).map(drop),
        other => panic!("no such command: {other}"),
    }
}

/// Compares what the page offers in a state with what the machine takes, and names the buttons that stand out.
fn compare(machine: &str, state: &str, make: impl Fn() -> Device) -> Vec<String> {
    let of_machine = |button: &Button| button.command.starts_with(&format!("{machine}/"));
    let names = |states: &[String]| states.iter().any(|name| name == state);
    let mut main = vec![];
    for button in buttons().into_iter().filter(of_machine) {
        let offered = names(&button.offered_in);
        let pressed = press(&mut make(), &button.command);
        assert_eq!(pressed.is_ok(), offered, "{state} {button:?}: {pressed:?}");
        if names(&button.main_in) {
            assert!(offered, "{state} {button:?}");
            main.push(button.command);
        }
    }
    main
}

#[test]
fn what_the_page_offers_is_what_the_rig_takes() {
    for (state, main) in [
        (RigState::Unhomed, "rig/home"),
        (RigState::Ready, "rig/run"),
        (RigState::Running, ""),
        (RigState::Moving, ""),
        (RigState::Held, "rig/resume"),
        (RigState::Faulted, "rig/ack"),
    ] {
        let found = compare("rig", &wording::name(&state), || rig_in(state));
        assert_eq!(found.concat(), main, "{state:?}");
    }
}

#[test]
fn what_the_page_offers_is_what_the_capsule_takes() {
    for (state, main) in [
        (CapsuleState::Unreferenced, "capsule/reference"),
        (CapsuleState::Unfolded, "capsule/fold"),
        (CapsuleState::Folding, ""),
        (CapsuleState::Folded, "capsule/unfold"),
        (CapsuleState::Faulted, "capsule/ack"),
    ] {
        let found = compare("capsule", &wording::name(&state), || capsule_in(state));
        assert_eq!(found.concat(), main, "{state:?}");
    }
}

#[test]
fn the_tab_key_meets_the_stops_first_and_nothing_else_is_pressed_without_a_state() {
    let body = PAGE.split_once("<body>").expect("a body").1;
    let mut buttons_of_body = body.split("<button ");
    let before = buttons_of_body.next().expect("a beginning");
    for tag in ["<input", "<select", "<summary", "<a ", "tabindex"] {
        assert!(!before.contains(tag), "{tag}");
    }
    let ids = buttons_of_body.filter_map(|tag| attribute(tag, "id"));
    assert_eq!(ids.take(2).collect::<Vec<_>>(), ["stop", "estop"]);
    for button in buttons() {
        assert!(!button.offered_in.is_empty(), "{button:?}");
    }
    assert_eq!(buttons().len(), 13, "all but the stops and the token's");
}

/// The text of a function of the page's script.
fn function(head: &str) -> &'static str {
    let after = PAGE.split_once(head).expect("there").1;
    after.split_once("\n}").expect("its end").0
}

/// Lines of the script that a stop depends on. No browser runs here.
#[test]
fn a_stop_goes_on_until_it_is_confirmed_and_goes_before_all_other_requests() {
    for (head, line) in [
        // A stop ends orders, plan and jog, and goes on at the machines that have not confirmed it.
        ("async function stop(name) {", "stops += 1;"),
        ("async function stop(name) {", "abort(orders);"),
        ("async function stop(name) {", "abort(plans);"),
        ("async function stop(name) {", "dropJog();"),
        ("async function stop(name) {", "isPending() && !mine.over;"),
        ("async function stop(name) {", "{ machine: mine.waits[0] }"),
        (
            "async function post(",
            "setTimeout(() => control.abort(), limit)",
        ),
        // No order is sent meanwhile but a hold, which moves nothing, and none is sent again after a stop.
        ("async function command(", "if (!token)"),
        ("async function command(", "if (isStale() && !holds)"),
        ("async function command(", "if (stopping && !holds)"),
        (
            "async function command(",
            "if (stops !== before) return null;",
        ),
        // A finger reaches a disabled button; a jog that was not answered yet is stopped, too.
        (
            "async function beginJog(",
            "if (jog || button.disabled) return;",
        ),
        ("function endJog() {", "stopJog();"),
        // A run begins at 0.
        ("function refuses(", "command === 'rig/run' && isAway(rig)"),
        // No late answer wipes a word about a stop.
        (
            "function tell(text, tone) {",
            "if (!unconfirmed && !confirmed)",
        ),
    ] {
        assert!(function(head).contains(line), "{head} {line}");
    }
    let (before, _) = function("async function stop(name) {")
        .split_once("for (let limit")
        .expect("attempts");
    assert!(!before.contains("await"), "nothing is waited for");
    let requests: Vec<_> = PAGE.match_indices("fetch(").collect();
    assert_eq!(requests.len(), 2, "the stream, and `post` for all others");
}
