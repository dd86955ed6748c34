//! Scripts of requests to `retrograde serve`.

use fuzz::{http, together};

use crate::{Example, bytes, script};

/// Number of a route, by its path: the table may grow at any place.
fn route(path: &str) -> u8 {
    let found = http::routes().iter().position(|(_, of)| of == path);
    found.expect("a route") as u8
}

pub fn of_http() -> Vec<Example> {
    use http::Content::{Float, Known as Word, Other, Text, Thousandths};
    use http::Field::{Any as AnyField, Known as AField};
    use http::Header::{Foreign, Json, Key, Known, Rebound, Token};
    use http::Line::{Any, Command, Route};
    use http::{Body, Machines, Step};
    let willing = Machines {
        both: true,
        willing: true,
    };
    let example =
        |name, machines: Machines, steps: &[Step]| ("http", name, script(&bytes(&machines), steps));
    let command = |path: &str, headers: &[http::Header], body: Body| Step {
        here: true,
        line: Route(route(path), String::new()),
        headers: headers.to_vec(),
        body,
    };
    let may = |key| vec![Token, Key(key), Json];
    let speeds = Body::Fields(vec![
        (AField(0), Thousandths(1_000)),
        (AField(3), Thousandths(5_000)),
    ]);
    let position = Body::Fields(vec![(AField(14), Thousandths(12_500))]);
    vec![
        example(
            "home",
            willing,
            &[
                command("/api/v1/rig/home", &may(1), Body::Empty),
                command("/api/v1/rig/home", &may(1), Body::Empty),
                command("/api/v1/actions/{id}", &[], Body::Empty),
            ],
        ),
        example(
            "home-without-token",
            willing,
            &[
                command("/api/v1/rig/home", &[Key(1), Json], Body::Empty),
                command("/api/v1/rig/home", &[Token, Key(1), Foreign], Body::Empty),
                command("/api/v1/rig/home", &[Token, Key(1), Rebound], Body::Empty),
            ],
        ),
        example(
            "run",
            willing,
            &[
                command("/api/v1/rig/run", &may(1), speeds.clone()),
                command("/api/v1/rig/settings", &[], Body::Empty),
                command("/api/v1/records", &[], Body::Empty),
                command("/api/v1/records/{name}", &[], Body::Empty),
            ],
        ),
        example(
            "plan",
            willing,
            &[
                command("/api/v1/plan", &[Json], speeds),
                command(
                    "/api/v1/plan",
                    &[Json],
                    Body::Text("{\"cycles\":".to_owned()),
                ),
            ],
        ),
        example(
            "move",
            willing,
            &[
                command("/api/v1/rig/move", &may(1), position),
                command("/api/v1/rig/jog/renew", &may(2), Body::Renewal(1)),
            ],
        ),
        example(
            "jog",
            willing,
            &[
                command(
                    "/api/v1/rig/jog",
                    &may(1),
                    Body::Fields(vec![(AField(15), Word(0))]),
                ),
                command("/api/v1/rig/jog/renew", &may(2), Body::Renewal(1)),
            ],
        ),
        example(
            "bad-fields",
            willing,
            &[command(
                "/api/v1/rig/run",
                &may(1),
                Body::Fields(vec![
                    (AField(1), Float(f64::MAX)),
                    (AnyField("rig".to_owned()), Other(0)),
                    (AField(13), Text("--note".to_owned())),
                ]),
            )],
        ),
        example(
            "fold",
            willing,
            &[
                command("/api/v1/capsule/fold", &may(1), Body::Empty),
                command("/api/v1/capsule/unfold", &may(2), Body::Empty),
                command("/api/v1/capsule/ack", &may(3), Body::Empty),
            ],
        ),
        example(
            "refused",
            Machines {
                both: false,
                willing: false,
            },
            &[
                command("/api/v1/rig/home", &may(1), Body::Empty),
                command("/api/v1/capsule/fold", &may(2), Body::Empty),
                command("/api/v1/rig/hold", &may(3), Body::Empty),
            ],
        ),
        example(
            "stop",
            willing,
            &[
                command("/api/v1/stop", &[], Body::Bytes(vec![255], 9)),
                Step {
                    here: false,
                    ..command("/api/v1/estop", &[], Body::Empty)
                },
                command(
                    "/api/v1/estop",
                    &[Known(4, b"10.0.0.9".to_vec())],
                    Body::Empty,
                ),
            ],
        ),
        example(
            "look",
            willing,
            &[
                command("/", &[], Body::Empty),
                command("/api/v1/state", &[], Body::Empty),
                command("/api/v1/stream", &[], Body::Empty),
                command("/api/v1/actions", &[], Body::Empty),
                command("/api/v1/rig/health", &[], Body::Empty),
            ],
        ),
        example(
            "nothing-there",
            willing,
            &[
                Step {
                    here: true,
                    line: Any("PUT".to_owned(), "/api/v1/rig/home?x".to_owned()),
                    headers: may(1),
                    body: Body::Empty,
                },
                Step {
                    here: true,
                    line: Command("rig".to_owned(), "dance".to_owned()),
                    headers: may(1),
                    body: Body::Empty,
                },
            ],
        ),
    ]
}

/// Orders and stops at once, with machines that live or die.
pub fn of_together() -> Vec<Example> {
    use http::Header::{Json, Key, Token};
    use http::{Body, Line, Machines, Step};
    use together::{Crowd, Fate, Start};
    let start = |fate, both| {
        bytes(&Start {
            machines: Machines {
                both,
                willing: true,
            },
            fate,
        })
    };
    let order = |path: &str, key| Step {
        here: true,
        line: Line::Route(route(path), String::new()),
        headers: vec![Token, Key(key), Json],
        body: Body::Empty,
    };
    let stop = |path: &str| Step {
        headers: vec![],
        ..order(path, 0)
    };
    let home = || order("/api/v1/rig/home", 1);
    let fold = || order("/api/v1/capsule/fold", 2);
    let example = |name, start: &[u8], crowds: &[Crowd]| ("together", name, script(start, crowds));
    vec![
        example(
            "order-and-stop",
            &start(Fate::Live, true),
            &[
                vec![home(), fold(), stop("/api/v1/stop")],
                vec![stop("/api/v1/estop"), order("/api/v1/rig/ack", 3)],
            ],
        ),
        example(
            "the-same-at-once",
            &start(Fate::Live, false),
            &[vec![home(), home(), home()]],
        ),
        example(
            "stops-at-once",
            &start(Fate::Live, true),
            &[vec![
                stop("/api/v1/stop"),
                stop("/api/v1/estop"),
                stop("/api/v1/stop"),
            ]],
        ),
        example(
            "nobody-there",
            &start(Fate::Absent, true),
            &[vec![home(), stop("/api/v1/stop")]],
        ),
        example(
            "silent",
            &start(Fate::Silent(4), true),
            &[
                vec![home()],
                vec![fold(), stop("/api/v1/stop"), stop("/api/v1/rig/health")],
            ],
        ),
        example(
            "pulled",
            &start(Fate::Lost(5), false),
            &[vec![home(), stop("/api/v1/stop")], vec![home()]],
        ),
    ]
}
