//! Names of states, outcomes, faults and events in JSON: lower case with underscores, and one name for one thing.

use std::fmt::Debug;

use postcard_schema::Schema;
use postcard_schema::schema::DataModelType;
use protocol::capsule::{CapsuleFault, CapsuleState};
use protocol::rig::{RigFault, RigInputs, RigState};
use protocol::settings::SettingKey;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

/// Calls `each` with every key and every text of a value.
fn names(value: &Value, each: &mut impl FnMut(&str)) {
    match value {
        Value::String(text) => each(text),
        Value::Array(all) => all.iter().for_each(|value| names(value, each)),
        Value::Object(all) => all.iter().for_each(|(key, value)| {
            each(key);
            names(value, each);
        }),
        _ => {}
    }
}

#[test]
fn no_name_in_json_has_a_capital() {
    let mut seen = 0;
    let mut each = |name: &str| {
        seen += 1;
        // People name a machine as they like, and its last words are a sentence.
        let free = name.contains(' ');
        assert!(
            free || !name.contains(|c: char| c.is_ascii_uppercase()),
            "{name}"
        );
    };
    for event in exemplars::events() {
        names(&json!(event), &mut each);
    }
    // Requests and replies are of the wire alone; their contents are shown and recorded.
    for response in exemplars::responses() {
        for content in json!(response)
            .as_object()
            .into_iter()
            .flat_map(|all| all.values())
        {
            names(content, &mut each);
        }
    }
    assert!(seen > 400, "{seen}");
}

#[test]
fn an_emergency_stop_and_its_loop_are_called_estop_everywhere() {
    assert_eq!(json!(RigFault::EStopLoop), "estop_loop");
    assert_eq!(json!(RigFault::EStopFrame), "estop_frame");
    assert_eq!(json!(CapsuleFault::EStopFrame), "estop_frame");
    let inputs = RigInputs {
        home_flag: false,
        far_limit: false,
        estop_loop: true,
    };
    assert_eq!(
        json!(inputs),
        json!({"home_flag_open": false, "far_limit_open": false, "estop_loop_open": true})
    );
}

#[test]
fn a_setting_is_called_the_same_in_json_and_at_the_command_line() {
    for key in SettingKey::ALL {
        assert_eq!(json!(key), key.name());
    }
}

#[test]
fn the_document_of_http_lists_the_states_of_both_machines() {
    fn check<State: Schema + DeserializeOwned + Debug>(listed: &Value) {
        let names = listed.as_array().expect("a list").iter();
        let mut names: Vec<_> = names.filter(|name| !name.is_null()).collect();
        for name in &names {
            serde_json::from_value::<State>((*name).clone()).expect("a state");
        }
        names.dedup();
        let DataModelType::Enum(variants) = State::SCHEMA.ty else {
            panic!("a state is an enumeration");
        };
        assert_eq!(names.len(), variants.len(), "{names:?}");
    }
    let document: Value =
        serde_json::from_str(include_str!("../../docs/openapi.json")).expect("JSON");
    let schemas = &document["components"]["schemas"];
    for (machine, samples, check) in [
        ("Rig", "RigSamples", check::<RigState> as fn(&Value)),
        ("Capsule", "CapsuleSamples", check::<CapsuleState>),
    ] {
        check(&schemas[machine]["allOf"][1]["properties"]["state"]["enum"]);
        let sample = &schemas[samples]["properties"]["samples"]["items"]["properties"];
        check(&sample["state"]["enum"]);
    }
}
