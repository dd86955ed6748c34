//! The command line in this process, without a person at the terminal.

use host_tool::cli::run_on;
use operations::connector::Ports;

/// Exit code, standard output and standard error of `retrograde` with these arguments.
pub fn retrograde(args: &[&str]) -> (u8, String, String) {
    let line = ["retrograde"].iter().chain(args).map(Into::into);
    let (mut out, mut err) = (vec![], vec![]);
    let code = run_on(line, &Ports, &mut out, &mut err, false);
    let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
    (code, text(out), text(err))
}
