//! What is not a machine is called what it is, with what to do, within a second or so.
#![cfg(unix)]

mod machine;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread;
use std::time::{Duration, Instant};

use host_tool::cli::run_on;
use host_tool::connector::Ports;

/// Serves one connection.
fn server(serve: fn(TcpStream)) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = format!("tcp:{}", listener.local_addr().expect("bound"));
    thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            serve(stream);
        }
    });
    address
}

fn read_on(mut stream: TcpStream) {
    let mut bytes = [0; 256];
    while stream.read(&mut bytes).is_ok_and(|count| count > 0) {}
}

fn silent(stream: TcpStream) {
    read_on(stream);
}

fn echo(mut stream: TcpStream) {
    let mut bytes = [0; 256];
    while let Ok(count @ 1..) = stream.read(&mut bytes) {
        if stream.write_all(&bytes[..count]).is_err() {
            return;
        }
    }
}

fn web(mut stream: TcpStream) {
    // Answers what is no request, and ends.
    let _ = stream.read(&mut [0; 256]);
    let _ = stream.write_all(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n");
}

fn ssh(mut stream: TcpStream) {
    let _ = stream.write_all(b"SSH-2.0-OpenSSH_9.2p1\r\n");
    read_on(stream);
}

fn instrument(mut stream: TcpStream) {
    for _ in 0..20 {
        if stream.write_all(b"+1.2345E-03 VDC\r\n").is_err() {
            return;
        }
        thread::sleep(Duration::from_millis(50));
    }
    read_on(stream);
}

fn other_baud(mut stream: TcpStream) {
    let _ = stream.write_all(&[0xE6, 0x80, 0x1E, 0xFE, 0x98].repeat(10));
    read_on(stream);
}

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
        let line = ["retrograde", "--rig", &address, "info"];
        let (mut out, mut err) = (vec![], vec![]);
        let code = run_on(line.map(Into::into), &Ports, &mut out, &mut err, false);
        let took = begin.elapsed();
        let err = String::from_utf8(err).expect("UTF-8");
        assert_eq!(code, 4, "{says}: {err}");
        assert!(err.contains(says) && err.contains(remedy), "{says}: {err}");
        // 0.8 s on an idle computer; it ends by itself on any.
        assert!(took < Duration::from_secs(20), "{says}: {took:?}");
    }
}
