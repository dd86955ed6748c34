//! The serial link: passes bytes to the service, its requests to control, and frames to the port.

use super::{
    channels::{BAD_FRAMES, LAST_HEARD_US, OUTBOUND, REPLIES, REQUESTS, SESSION, UART_ERRORS},
    serial,
    watchdog::{CHECK_IN, check_in},
};
use crate::{
    service::{Inbound, Incoming, Service},
    supervision::Client,
};
use core::{sync::atomic::Ordering, task::Poll};
use embassy_futures::{poll_once, yield_now};
use embassy_stm32::{
    mode::Async,
    usart::{RingBufferedUartRx, UartTx},
};
use embassy_time::{Instant, with_timeout};
use protocol::system::{Identity, Urgent};

/// Sends what the other tasks have queued, one frame after the other.
pub async fn transmit(mut uart: UartTx<'static, Async>) -> ! {
    loop {
        let frame = OUTBOUND.receive().await;
        if uart.write(&frame).await.is_err() {
            defmt::warn!("transmit error");
        }
    }
}

/// Reads the port, at least every 100 ms. An urgent stop calls `at_once` before control receives it.
pub async fn receive(
    mut uart: RingBufferedUartRx<'static>,
    identity: Identity,
    at_once: impl Fn(Urgent),
) -> ! {
    let mut service = Service::new(identity);
    let mut buffer = [0_u8; 64];
    loop {
        check_in(Client::Link);
        let count = match with_timeout(CHECK_IN, uart.read(&mut buffer)).await {
            Ok(Ok(count)) => count,
            Ok(Err(_)) => {
                // Noise, framing error or overrun: the host repeats the damaged frame. The HAL would return the old
                // bytes in its ring, perhaps an old emergency stop. Drop all of them.
                UART_ERRORS.fetch_add(1, Ordering::Relaxed);
                serial::rewind();
                while let Poll::Ready(dropped) = poll_once(uart.read(&mut buffer)) {
                    if dropped.is_err() {
                        serial::rewind();
                    }
                    // Keep the watchdog fed, even if errors never cease.
                    check_in(Client::Link);
                    yield_now().await;
                }
                0
            }
            Err(_) => 0,
        };
        BAD_FRAMES.store(service.bad_frames(), Ordering::Relaxed);
        for byte in &buffer[..count] {
            let now_us = Instant::now().as_micros() as u32;
            let Some(incoming) = service.receive(*byte, now_us) else {
                continue;
            };
            LAST_HEARD_US.store(service.heard_us(), Ordering::Relaxed);
            SESSION.store(service.session(), Ordering::Relaxed);
            // Send in one place: each `await` stores another copy of the state.
            let frame = match incoming {
                Incoming::Send(frame) => Some(frame),
                Incoming::Ask(inbound, to) => {
                    if let Inbound::Urgent(urgent) = inbound {
                        at_once(urgent);
                    }
                    // Overwrites nothing: control has answered every earlier request.
                    REQUESTS.signal(inbound);
                    service.answer(to, &REPLIES.wait().await)
                }
                Incoming::Ignore => None,
            };
            // Update after the answer: a refused request does not keep a motion alive.
            LAST_HEARD_US.store(service.heard_us(), Ordering::Relaxed);
            if let Some(frame) = frame {
                OUTBOUND.send(frame).await;
            }
        }
    }
}
