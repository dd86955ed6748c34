//! Command lines in this process. Whatever they print must leave a terminal as it is.

use host_tool::cli::run_on;
use lab::operations::connector::Connector;

/// Whether a terminal acts on the character, or reorders others because of it. A second list, because the tool's own
/// list may lack one.
fn is_obeyed(c: char) -> bool {
    let turns = matches!(c,
        '\u{061C}' | '\u{200E}' | '\u{200F}' | '\u{2028}'..='\u{202E}' | '\u{2066}'..='\u{2069}');
    turns || c.is_control() && !matches!(c, '\n' | '\t')
}

/// Checks a text that reaches a terminal.
///
/// # Panics
/// The terminal would act on a part of it.
pub fn check(text: &str) {
    let obeyed = text.chars().find(|c| is_obeyed(*c));
    assert_eq!(obeyed, None, "a terminal obeys it: {text:?}");
}

/// Runs a command line without a person at the terminal. Returns its exit code and its output.
///
/// # Panics
/// A terminal would act on a part of the output, or a failure prints nothing.
pub fn run(args: &[&str], connector: &dyn Connector) -> (u8, String) {
    let line = ["retrograde"].iter().chain(args).map(Into::into);
    let (mut out, mut err) = (vec![], vec![]);
    let code = run_on(line, connector, &mut out, &mut err, None);
    let text = String::from_utf8([out, err].concat()).expect("UTF-8");
    check(&text);
    assert!(code == 0 || !text.is_empty(), "no word about it: {args:?}");
    (code, text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_obeys_is_noticed() {
        check("µm, “ü”\tand\nlines");
        for bad in [
            "\u{1b}[2J",
            "\u{9b}",
            "\r",
            "\u{7f}",
            "a\u{202e}b",
            "\u{2066}",
        ] {
            let noticed = std::panic::catch_unwind(|| check(bad));
            assert!(noticed.is_err(), "{bad:?}");
        }
    }
}
