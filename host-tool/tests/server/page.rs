//! The page: what it offers in a state is what the machine takes then, and the stops come first for the Tab key. How it
//! looks and what it keeps is checked in a browser: `virtual-bench page`.

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
    script.ready = true;
    let mut capsule = Device::connect(link(script).0, DeviceKind::Capsule, 1).expect("a capsule");
    match state {
        CapsuleState::Folding | CapsuleState::Folded => {
            let accepted = capsule.fold().expect("accepted");
            if state == CapsuleState::Folded {
                let ended = capsule.wait_actuation(&accepted, &mut Unobserved);
                ended.expect("folded");
            }
        }
        // A calibrated capsule after its fault was acknowledged.
        CapsuleState::Unreferenced => {
            capsule.urgent(Urgent::EStop).expect("stopped");
            capsule.acknowledge().expect("acknowledged");
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
        sense: Direction::Away,
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
    let first = [
        "<button", "<input", "<select", "<summary", "<a ", "tabindex",
    ]
    .into_iter()
    .filter_map(|tag| body.find(tag))
    .min()
    .expect("something to press");
    assert!(body[first..].starts_with("<button id=\"stop\""));
    let second = body[first + 1..].find("<button").expect("a second");
    assert!(body[first + 1 + second..].starts_with("<button id=\"estop\""));
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

#[test]
fn a_stop_goes_on_until_it_is_confirmed_and_goes_before_all_other_requests() {
    let stop = function("async function stop(name) {");
    let (before, tries) = stop.split_once("for (let limit").expect("attempts");
    assert!(
        tries.starts_with(" = 2500, pause = 100; isPending() && !mine.over;"),
        "{tries}"
    );
    for first in ["abort(orders);", "abort(plans);", "dropJog();"] {
        assert!(before.contains(first), "{first}");
    }
    assert!(!before.contains("await"), "nothing is waited for");
    // An answer in time, or none: also without the `AbortSignal.timeout` of newer browsers.
    assert!(!PAGE.contains("AbortSignal.timeout"));
    let requests: Vec<_> = PAGE.match_indices("fetch(").collect();
    assert_eq!(requests.len(), 2, "the stream, and `post` for all others");
    assert!(function("async function post(").contains("setTimeout(() => control.abort(), limit)"));
    assert!(
        tries.contains("{ machine: mine.waits[0] }"),
        "a machine that stands is left alone"
    );
    // No order ends the attempts. None is sent meanwhile, but a hold, which moves nothing.
    let command = function("async function command(");
    let (refused, sent) = command.split_once("const more = ").expect("the headers");
    assert!(refused.contains("if (!token)") && refused.contains("if (isStale() && !holds)"));
    assert!(refused.contains("if (stopping && !holds)"));
    assert!(refused.contains("if (one.over) pending.delete(name);"));
    assert!(!sent.contains("pending"), "{sent}");
    // A finger reaches a disabled button; a jog that was not answered yet is stopped, too.
    assert!(function("async function beginJog(").contains("if (jog || button.disabled) return;"));
    assert!(function("function endJog() {").ends_with("stopJog();"));
}

/// The state alone does not say it: a run begins at 0.
#[test]
fn a_run_is_not_offered_away_from_0() {
    let away = || {
        let mut rig = rig_in(RigState::Ready);
        press(&mut rig, "rig/move").expect("accepted");
        rig.wait_rest(&mut Unobserved).expect("stands");
        rig
    };
    assert_eq!(
        away().rig_status().expect("a status").state,
        RigState::Ready
    );
    press(&mut away(), "rig/run").expect_err("not at 0");
    press(&mut away(), "rig/home").expect("homes");
    assert!(function("function refuses(").contains("command === 'rig/run' && isAway(rig)"));
}

#[test]
fn a_phone_can_type_numbers_and_sees_the_stops_and_what_went_wrong() {
    // Some keyboards for `decimal` have a comma alone, which the server refuses.
    assert!(!PAGE.contains("inputmode=\"decimal\""));
    assert!(PAGE.contains("interactive-widget=resizes-content"));
    assert!(PAGE.contains("view.addEventListener(name, lift)"));
    let told = PAGE.split_once("<div id=\"told\">").expect("there").1;
    let told = told.split_once("</div>").expect("its end").0;
    for id in ["said", "banner"] {
        assert!(told.contains(&format!("<p id=\"{id}\"")), "{id}");
    }
    assert!(PAGE.contains("#told { position: sticky;"));
    assert!(PAGE.contains("shows nothing and STOPS NOTHING"));
}

/// A jog is stopped by letting go, and an order is answered late, also while an emergency stop goes on that is not
/// confirmed yet. Only the word that an order was not sent, which repeats that of the stop, takes its place.
#[test]
fn no_late_answer_wipes_a_word_about_a_stop() {
    for (function, says) in [("function stopJog()", 0), ("async function command(", 1)] {
        let after = PAGE.split_once(function).expect("there").1;
        let body = after.split_once("\n}").expect("its end").0;
        let said: Vec<_> = body.lines().filter(|line| line.contains("say(")).collect();
        assert_eq!(said.len(), says, "{said:?}");
        assert!(body.contains("tell("), "{function}");
    }
    let tell = PAGE
        .split_once("function tell(text, tone) {")
        .expect("there")
        .1;
    let body = tell.split_once("\n}").expect("its end").0;
    assert!(body.contains("if (!unconfirmed && !confirmed)"), "{body}");
}

/// A command that was not answered is sent again, and a stop may have come meanwhile.
#[test]
fn no_command_is_sent_again_after_a_stop() {
    let after = PAGE.split_once("async function command(").expect("there").1;
    let body = after.split_once("\n}").expect("its end").0;
    let (sent, failed) = body.split_once("} catch (error) {").expect("a failure");
    assert!(sent.contains("const before = stops;"), "{sent}");
    let first = failed
        .lines()
        .map(str::trim)
        .find(|line| line.starts_with("if"));
    assert_eq!(first, Some("if (stops !== before) return null;"));
    let stop = PAGE
        .split_once("async function stop(name) {")
        .expect("there")
        .1;
    assert!(stop.trim_start().starts_with("stops += 1;"));
}
