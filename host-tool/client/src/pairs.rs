//! The members of a JSON object.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde_json::{Map, Value};

/// The members in their order, including repeated ones, which a map would drop.
pub struct Pairs(pub Vec<(String, Value)>);

impl Pairs {
    /// The members as a map.
    ///
    /// # Errors
    /// A name that occurs twice.
    pub fn once(self) -> Result<Map<String, Value>, String> {
        let mut map = Map::new();
        for (name, value) in self.0 {
            if map.insert(name.clone(), value).is_some() {
                return Err(name);
            }
        }
        Ok(map)
    }
}

impl<'de> Deserialize<'de> for Pairs {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Members;
        impl<'de> Visitor<'de> for Members {
            type Value = Pairs;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a JSON object")
            }
            fn visit_map<M: MapAccess<'de>>(self, mut map: M) -> Result<Pairs, M::Error> {
                let mut pairs = vec![];
                while let Some(pair) = map.next_entry()? {
                    pairs.push(pair);
                }
                Ok(Pairs(pairs))
            }
        }
        deserializer.deserialize_map(Members)
    }
}
