//! The serial link: bytes to frames to decisions; replies, events and telemetry to bytes.

use crate::{
    channels::{Inbound, LAST_FRAME_US, OUTBOUND, REPLIES, REQUESTS, SESSION},
    watchdog::{CHECK_IN, Client, check_in},
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
    system::Identity,
    table::{Reply, Response},
};

/// Sends what the other tasks have queued, one frame after the other.
#[embassy_executor::task]
pub(crate) async fn transmit(mut uart: UartTx<'static, Async>) -> ! {
    loop {
        let frame = OUTBOUND.receive().await;
        if uart.write(&frame).await.is_err() {
            defmt::warn!("transmit error");
        }
    }
}

/// When bytes have come, and at least every 100 ms. `identity` is complete but for the session.
#[embassy_executor::task]
pub(crate) async fn receive(mut uart: RingBufferedUartRx<'static>, identity: Identity) -> ! {
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
                0
            }
            Err(_) => 0,
        };
        for byte in &buffer[..count] {
            if let Some(frame) = deframer.push(*byte) {
                LAST_FRAME_US.store(Instant::now().as_micros() as u32, Ordering::Relaxed);
                serve(&frame, &mut session, &identity).await;
            }
        }
    }
}

async fn serve(frame: &Frame<'_>, session: &mut Session, identity: &Identity) {
    let (number, seq, reply) = match session.receive(frame) {
        Decision::Greet { session, seq } => {
            SESSION.store(session, Ordering::Relaxed);
            let identity = Identity {
                session,
                ..*identity
            };
            (session, seq, Reply::Accepted(Response::Hello(identity)))
        }
        Decision::Execute { request, ticket } => {
            let reply = ask(Inbound::Request(request)).await;
            if let Some(frame) = send(ticket.session, ticket.seq, &reply).await {
                session.remember(ticket, &frame);
            }
            return;
        }
        Decision::Refuse { refusal, ticket } => {
            let reply = Reply::Refused(refusal);
            if let Some(frame) = send(ticket.session, ticket.seq, &reply).await {
                session.remember(ticket, &frame);
            }
            return;
        }
        Decision::Urgent {
            urgent,
            session,
            seq,
        } => (session, seq, ask(Inbound::Urgent(urgent)).await),
        Decision::Reject {
            error,
            session,
            seq,
        } => (session, seq, Reply::Wire(error)),
        Decision::Resend(frame) => {
            OUTBOUND.send(frame).await;
            return;
        }
        Decision::Ignore => return,
    };
    // Without a ticket there is nothing to remember.
    let _ = send(number, seq, &reply).await;
}

async fn ask(inbound: Inbound) -> Reply {
    REPLIES.reset();
    REQUESTS.send(inbound).await;
    REPLIES.wait().await
}

async fn send(session: u8, seq: u16, reply: &Reply) -> Option<Encoded> {
    let header = Header {
        kind: Kind::Reply,
        session,
        seq,
    };
    let frame = encode(header, reply).ok()?;
    OUTBOUND.send(frame.clone()).await;
    Some(frame)
}
