//! Reads a script from bytes: a list of steps in postcard, skipping whatever is not a step.

use serde::de::DeserializeOwned;

/// The steps in these bytes. Skips one byte where no step begins: any bytes are then a script, and a changed byte
/// leaves later steps as they are.
pub fn steps<'a, T: DeserializeOwned + 'a>(mut data: &'a [u8]) -> impl Iterator<Item = T> + 'a {
    std::iter::from_fn(move || {
        while !data.is_empty() {
            if let Ok((step, rest)) = postcard::take_from_bytes(data) {
                data = rest;
                return Some(step);
            }
            data = &data[1..];
        }
        None
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_step_is_skipped_and_the_rest_is_found() {
        let mut bytes = vec![9, 9];
        let steps_in = [Some(7_u16), None, Some(300)];
        for step in &steps_in {
            bytes.extend(postcard::to_stdvec(step).expect("short"));
            bytes.push(0xFF);
        }
        let found: Vec<Option<u16>> = steps(&bytes).collect();
        assert_eq!(found, steps_in);
        assert_eq!(steps::<Option<u16>>(&[]).count(), 0);
    }
}
