//! The serial port: USART2 with two streams of DMA1.

use super::{super::start::BAUD, TIME_DRIVER_INTERRUPT};
use embassy_stm32::{
    Peri, bind_interrupts, dma,
    gpio::Pull,
    interrupt::{self, InterruptExt, Priority},
    mode::Async,
    pac, peripherals,
    usart::{self, RingBufferedUartRx, Uart, UartTx},
};
use static_cell::StaticCell;

/// Size of the ring of received bytes.
const RECEIVED: usize = 512;
/// The stream of DMA1 that fills it.
const STREAM: usize = 5;
/// Reads before giving up on a stream that should stop: it stops within some bus cycles, or never.
const STREAM_READS: u32 = 1_000;

bind_interrupts!(struct Interrupts {
    USART2 => usart::InterruptHandler<peripherals::USART2>;
    DMA1_STREAM5 => dma::InterruptHandler<peripherals::DMA1_CH5>;
    DMA1_STREAM6 => dma::InterruptHandler<peripherals::DMA1_CH6>;
});

/// Opens the serial port, and sets priorities: the time base at 2, the port below everything else at 7.
pub fn open(
    usart: Peri<'static, peripherals::USART2>,
    rx: Peri<'static, peripherals::PA3>,
    tx: Peri<'static, peripherals::PA2>,
    tx_dma: Peri<'static, peripherals::DMA1_CH6>,
    rx_dma: Peri<'static, peripherals::DMA1_CH5>,
) -> (UartTx<'static, Async>, RingBufferedUartRx<'static>) {
    static RECEIVE_BUFFER: StaticCell<[u8; RECEIVED]> = StaticCell::new();
    TIME_DRIVER_INTERRUPT.set_priority(Priority::P2);
    interrupt::USART2.set_priority(Priority::P7);
    interrupt::DMA1_STREAM5.set_priority(Priority::P7);
    interrupt::DMA1_STREAM6.set_priority(Priority::P7);
    let mut config = usart::Config::default();
    config.baudrate = BAUD;
    // The ST-LINK drives the line, but not without power or during its start.
    config.rx_pull = Pull::Up;
    let uart = Uart::new(usart, rx, tx, tx_dma, rx_dma, Interrupts, config);
    let Ok(uart) = uart else {
        defmt::panic!("USART2: the clock does not divide to the baud rate")
    };
    let (transmitter, receiver) = uart.split();
    let receiver = receiver.into_ring_buffered(RECEIVE_BUFFER.init([0; RECEIVED]));
    (transmitter, receiver)
}

/// Stops the reception and resets its stream to the start of its ring; the next read of the port starts it. After an
/// error the HAL only sets EN again, and no manual says where a stream continues without a new count and address
/// (AN4031 asks for both). The HAL counts the end of transfer that the stop raises.
pub fn rewind() {
    pac::USART2.cr3().modify(|w| w.set_dmar(false));
    let stream = pac::DMA1.st(STREAM);
    stream.cr().modify(|w| w.set_en(false));
    let _ = (0..STREAM_READS).any(|_| !stream.cr().read().en());
    // Clear the flags of harmless errors, which the HAL does not: they keep a stream from starting (RM0383 9.5.5).
    pac::DMA1.ifcr(STREAM / 4).write(|w| {
        w.set_dmeif(STREAM % 4, true);
        w.set_feif(STREAM % 4, true);
    });
    stream.m0ar().modify(|_| {});
    stream.ndtr().write(|w| w.set_ndt(RECEIVED as u16));
}
