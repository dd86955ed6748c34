//! A line without a machine is diagnosed with a remedy, within a second or so.

use std::net::TcpStream;
use std::time::{Duration, Instant};

use crate::support::offline::retrograde;
use crate::support::others::{echo, instrument, other_baud, server, silent, ssh, web};

#[test]
fn each_other_end_is_named_with_what_to_do() {
    type Serve = fn(TcpStream);
    let ends: [(Serve, &str, &str); 6] = [
        (silent, "nothing comes from there", "is the board powered"),
        (echo, "what is sent there comes back", "loop-back plug"),
        (web, "a web server is there", "virtual-bench serve"),
        (ssh, "an SSH server is there", "virtual-bench serve"),
        (
            instrument,
            "it sends \"+1.2345E-03 VDC",
            "retrograde devices",
        ),
        (
            other_baud,
            "none of them make a frame",
            "does `--baud` match",
        ),
    ];
    for (serve, says, remedy) in ends {
        let address = server(serve);
        let begin = Instant::now();
        let (code, _, err) = retrograde(&["--rig", &address, "info"]);
        let took = begin.elapsed();
        assert_eq!(code, 4, "{says}: {err}");
        assert!(err.contains(says) && err.contains(remedy), "{says}: {err}");
        // Takes 0.8 s on an idle computer. The limit only makes sure that it ends by itself.
        assert!(took < Duration::from_secs(20), "{says}: {took:?}");
    }
}
