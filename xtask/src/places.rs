//! Finds the source locations of the addresses in a machine's last words.

use std::path::Path;

use addr2line::Loader;

use crate::process::{Failure, Result};

/// Prints function, file and line of every address in `words` and ignores all other words.
///
/// They are return addresses: each is the address of the instruction after the call.
///
/// # Errors
/// No image, no debug information in it, or no address among the words.
pub(crate) fn print(image: &Path, words: &[String]) -> Result<()> {
    let addresses = addresses(words);
    if addresses.is_empty() {
        return Err(Failure::new(
            format!("there is no address in `{}`", words.join(" ")),
            "addresses look like 0x0801a2b4; `retrograde info` prints them",
        ));
    }
    let unreadable = |reason: &dyn std::fmt::Display| {
        Failure::new(
            format!("{} cannot be read: {reason}", image.display()),
            "check out the commit that `retrograde info` names and run `cargo xtask images`",
        )
    };
    let loader = Loader::new(image).map_err(|reason| unreadable(&reason))?;
    println!(
        "From {}: correct only if this image was running.",
        image.display()
    );
    for address in addresses {
        println!("{address:#010x}");
        // EXC_RETURN (Armv7-M ARM B1.5.8).
        if (0xFFFF_FFE0..=0xFFFF_FFFF).contains(&address) {
            println!("    an interrupt; the following was interrupted");
            continue;
        }
        let mut frames = loader
            .find_frames(address.saturating_sub(1))
            .map_err(|reason| unreadable(&reason))?;
        let mut found = false;
        while let Some(frame) = frames.next().map_err(|reason| unreadable(&reason))? {
            let function = frame
                .function
                .as_ref()
                .and_then(|name| name.demangle().ok());
            let (file, line) = frame.location.map_or((None, None), |at| (at.file, at.line));
            println!(
                "    {}:{}  {}",
                file.unwrap_or("?"),
                // Line 0 means that the optimiser has merged several lines.
                line.filter(|line| *line > 0)
                    .map_or("?".to_owned(), |line| line.to_string()),
                function.as_deref().unwrap_or("?")
            );
            found = true;
        }
        if !found {
            println!("    not in the image");
        }
    }
    Ok(())
}

fn addresses(words: &[String]) -> Vec<u64> {
    let words = words.iter().flat_map(|word| word.split([' ', ',', ';']));
    words
        .filter_map(|word| u64::from_str_radix(word.strip_prefix("0x")?, 16).ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_found_among_words() {
        let words = ["processor fault at 0x60000000, called from 0x80107c1".to_owned()];
        assert_eq!(addresses(&words), [0x6000_0000, 0x0801_07c1]);
        assert!(addresses(&["panic".to_owned()]).is_empty());
    }
}
