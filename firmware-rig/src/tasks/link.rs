//! The serial link: bytes to frames to decisions; replies, events and telemetry to bytes.

use super::watchdog::{CHECK_IN, Client, check_in};
use crate::{
    board,
    channels::{
        BAD_FRAMES, CUT, Inbound, LAST_FRAME_US, MOTION_WAKE, OUTBOUND, REPLIES, REQUESTS, SESSION,
        UART_ERRORS,
    },
};
use core::sync::atomic::Ordering;
use embassy_stm32::{
    mode::Async,
    usart::{RingBufferedUartRx, UartTx},
};
use embassy_time::{Instant, with_timeout};
use protocol::{
    frame::{Deframer, Encoded, Frame, Header, Kind, encode},
    session::{Decision, Session},
    system::{Identity, Urgent},
    table::{Reply, Response},
};

/// Sends what the other tasks have queued, one frame after the other.
#[embassy_executor::task]
pub async fn transmit(mut uart: UartTx<'static, Async>) -> ! {
    loop {
        let frame = OUTBOUND.receive().await;
        if uart.write(&frame).await.is_err() {
            defmt::warn!("transmit error");
        }
    }
}

/// Reads the port; at least every 100 ms. `identity` is complete but for the session.
#[embassy_executor::task]
pub async fn receive(mut uart: RingBufferedUartRx<'static>, identity: Identity) -> ! {
    let mut deframer = Deframer::new();
    let mut session = Session::new(identity.boot_id);
    let mut buffer = [0_u8; 64];
    loop {
        check_in(Client::Link);
        let count = match with_timeout(CHECK_IN, uart.read(&mut buffer)).await {
            Ok(Ok(count)) => count,
            Ok(Err(error)) => {
                // Noise, framing, overrun: the CRC finds the damaged frame, the host repeats it.
                defmt::debug!("receive error {}", error);
                UART_ERRORS.fetch_add(1, Ordering::Relaxed);
                0
            }
            Err(_) => 0,
        };
        BAD_FRAMES.store(deframer.rejected(), Ordering::Relaxed);
        for byte in &buffer[..count] {
            if let Some(frame) = deframer.push(*byte) {
                LAST_FRAME_US.store(Instant::now().as_micros() as u32, Ordering::Relaxed);
                serve(&frame, &mut session, &identity).await;
            }
        }
    }
}

/// Not inlined: one copy of the whole encoder.
#[inline(never)]
fn reply_frame(header: Header, reply: &Reply) -> Option<Encoded> {
    encode(header, reply).ok()
}

/// What a frame is answered with.
enum Answer {
    Reply(Reply),
    /// Ask control first.
    Ask(Inbound),
    Frame(Encoded),
    Nothing,
}

/// One way in, one way out: each `await` is a copy of the state, so there are few.
async fn serve(frame: &Frame<'_>, session: &mut Session, identity: &Identity) {
    let mut remember = None;
    let (number, seq, answer) = match session.receive(frame) {
        Decision::Greet {
            session: number,
            seq,
        } => {
            SESSION.store(number, Ordering::Relaxed);
            let identity = Identity {
                session: number,
                ..*identity
            };
            let reply = Reply::Accepted(Response::Hello(identity));
            (number, seq, Answer::Reply(reply))
        }
        Decision::Execute { request, ticket } => {
            let (number, seq) = (ticket.session, ticket.seq);
            remember = Some(ticket);
            (number, seq, Answer::Ask(Inbound::Request(request)))
        }
        Decision::Urgent {
            urgent,
            session: number,
            seq,
        } => {
            if urgent == Urgent::EStop {
                // Before anything else; control latches the fault.
                board::cut_pulses();
                CUT.store(true, Ordering::Release);
                MOTION_WAKE.signal(());
            }
            (number, seq, Answer::Ask(Inbound::Urgent(urgent)))
        }
        Decision::Resend(frame) => (0, 0, Answer::Frame(frame)),
        Decision::Refuse { refusal, ticket } => {
            let (number, seq) = (ticket.session, ticket.seq);
            remember = Some(ticket);
            (number, seq, Answer::Reply(Reply::Refused(refusal)))
        }
        Decision::Reject {
            error,
            session: number,
            seq,
        } => (number, seq, Answer::Reply(Reply::Wire(error))),
        Decision::Ignore => (0, 0, Answer::Nothing),
    };
    let header = Header {
        kind: Kind::Reply,
        session: number,
        seq,
    };
    let frame = match answer {
        Answer::Reply(reply) => reply_frame(header, &reply),
        Answer::Ask(inbound) => {
            // Control has answered everything before it: nothing is overwritten.
            REQUESTS.signal(inbound);
            reply_frame(header, &REPLIES.wait().await)
        }
        Answer::Frame(frame) => Some(frame),
        Answer::Nothing => None,
    };
    let Some(frame) = frame else {
        return;
    };
    if let Some(ticket) = remember {
        session.remember(ticket, &frame);
    }
    OUTBOUND.send(frame).await;
}
