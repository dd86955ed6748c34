//! Names and values of settings as the user writes them.

use lab::operations::failure::Failure;
use protocol::settings::{MAX_NAME, SettingKey};

#[derive(Clone, Copy, Debug)]
pub struct Key(pub SettingKey);

impl std::str::FromStr for Key {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        SettingKey::ALL
            .into_iter()
            .find(|key| key.name() == name)
            .map(Self)
            .ok_or_else(|| {
                format!("there is no setting `{name}`: `retrograde settings list` shows all")
            })
    }
}

/// Reads a value and checks it against the range of its setting.
pub(crate) fn value_of(key: SettingKey, text: &str) -> Result<u32, Failure> {
    let range = key.range();
    let (name, min, max) = (key.name(), range.min, range.max);
    if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_digit()) {
        let unit = match key.unit() {
            "1" => String::new(),
            unit => format!(" {unit}"),
        };
        return Err(Failure::input(
            format!(
                "{name} cannot be {text}: settings are whole numbers in the unit of their name, {min} to {max}{unit} here"
            ),
            "nothing was sent; `retrograde settings list` shows all with unit and range",
        ));
    }
    text.parse()
        .ok()
        .filter(|value| (min..=max).contains(value))
        .ok_or_else(|| {
            Failure::refused(
                format!("{name} is {text}, allowed is {min} to {max}"),
                "nothing was sent",
            )
        })
}

/// Checks that a name is short enough for the rig and has no control characters.
pub(crate) fn checked_name(name: &str) -> Result<heapless::String<MAX_NAME>, String> {
    if name.contains(char::is_control) {
        return Err("the name has a control character".to_owned());
    }
    name.try_into()
        .map_err(|_| format!("the name has {} bytes, {MAX_NAME} are allowed", name.len()))
}
