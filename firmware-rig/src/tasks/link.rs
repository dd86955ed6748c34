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
    VERSION,
    frame::{Deframer, Encoded, Frame, Header, Kind, encode},
    session::{Decision, Session},
    system::{Identity, Urgent},
    table::{Reply, Response, SCHEMA_KEY},
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

async fn serve(frame: &Frame<'_>, session: &mut Session, identity: &Identity) {
    match session.receive(frame) {
        Decision::Greet {
            session: number,
            seq,
        } => {
            SESSION.store(number, Ordering::Relaxed);
            let identity = Identity {
                session: number,
                protocol: VERSION,
                schema_key: SCHEMA_KEY,
                ..*identity
            };
            send(number, seq, &Reply::Accepted(Response::Hello(identity))).await;
        }
        Decision::Execute { request, ticket } => {
            let reply = ask(Inbound::Request(request)).await;
            if let Some(frame) = send(ticket.session, ticket.seq, &reply).await {
                session.remember(ticket, &frame);
            }
        }
        Decision::Urgent {
            urgent,
            session,
            seq,
        } => {
            if urgent == Urgent::EStop {
                // Before anything else; control latches the fault.
                board::cut_pulses();
                CUT.store(true, Ordering::Release);
                MOTION_WAKE.signal(());
            }
            let reply = ask(Inbound::Urgent(urgent)).await;
            send(session, seq, &reply).await;
        }
        Decision::Resend(frame) => OUTBOUND.send(frame).await,
        Decision::Refuse { refusal, ticket } => {
            if let Some(frame) = send(ticket.session, ticket.seq, &Reply::Refused(refusal)).await {
                session.remember(ticket, &frame);
            }
        }
        Decision::Reject {
            error,
            session,
            seq,
        } => {
            send(session, seq, &Reply::Wire(error)).await;
        }
        Decision::Ignore => {}
    }
}

async fn ask(inbound: Inbound) -> Reply {
    REPLIES.reset();
    REQUESTS.send(inbound).await;
    REPLIES.wait().await
}

async fn send(session: u8, seq: u16, reply: &Reply) -> Option<Encoded> {
    let frame = encode(
        Header {
            kind: Kind::Reply,
            session,
            seq,
        },
        reply,
    )
    .ok()?;
    OUTBOUND.send(frame.clone()).await;
    Some(frame)
}
