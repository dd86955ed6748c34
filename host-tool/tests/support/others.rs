//! Things other than machines at the end of a line.
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread;
use std::time::Duration;

/// Serves one connection.
pub fn server(serve: fn(TcpStream)) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let address = format!("tcp:{}", listener.local_addr().expect("bound"));
    thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            serve(stream);
        }
    });
    address
}

pub fn silent(mut stream: TcpStream) {
    let mut bytes = [0; 256];
    while stream.read(&mut bytes).is_ok_and(|count| count > 0) {}
}

pub fn echo(mut stream: TcpStream) {
    let mut bytes = [0; 256];
    while let Ok(count @ 1..) = stream.read(&mut bytes) {
        if stream.write_all(&bytes[..count]).is_err() {
            return;
        }
    }
}

pub fn web(mut stream: TcpStream) {
    // Answers anything that is not a request, and closes.
    let _ = stream.read(&mut [0; 256]);
    let _ = stream.write_all(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n");
}

pub fn ssh(mut stream: TcpStream) {
    let _ = stream.write_all(b"SSH-2.0-OpenSSH_9.2p1\r\n");
    silent(stream);
}

pub fn instrument(mut stream: TcpStream) {
    for _ in 0..20 {
        if stream.write_all(b"+1.2345E-03 VDC\r\n").is_err() {
            return;
        }
        thread::sleep(Duration::from_millis(50));
    }
    silent(stream);
}

pub fn other_baud(mut stream: TcpStream) {
    let _ = stream.write_all(&[0xE6, 0x80, 0x1E, 0xFE, 0x98].repeat(10));
    silent(stream);
}

/// Sends like a machine and hears nothing.
pub fn deaf(mut stream: TcpStream) {
    use protocol::frame::{Header, Kind, encode};
    use protocol::system::Urgent;
    use protocol::table::Reply;
    let header = Header {
        kind: Kind::Reply,
        session: 1,
        seq: 1,
    };
    let frame = encode(header, &Reply::Urgent(Urgent::Stop)).expect("fits");
    while stream.write_all(&frame).is_ok() {
        thread::sleep(Duration::from_millis(20));
    }
}
