//! The serial port: LPUART1 with two channels of DMA2.
//!
//! LPUART1 is the port that could hear a byte in stop mode, from the HSI; nothing stops yet. At 16 MHz its divider is 35,556 of 1/256:
//! 115,200 baud to 0.001 %.

use super::{super::start::BAUD, TIME_DRIVER_INTERRUPT};
use embassy_stm32::{
    Peri, bind_interrupts, dma,
    interrupt::{self, InterruptExt, Priority},
    mode::Async,
    peripherals,
    usart::{self, RingBufferedUartRx, Uart, UartTx},
};
use static_cell::StaticCell;

bind_interrupts!(struct Interrupts {
    LPUART1 => usart::InterruptHandler<peripherals::LPUART1>;
    DMA2_CHANNEL6 => dma::InterruptHandler<peripherals::DMA2_CH6>;
    DMA2_CHANNEL7 => dma::InterruptHandler<peripherals::DMA2_CH7>;
});

/// Opens the serial port, and sets priorities: the time base at 2, the port below everything else at 7.
pub fn open(
    uart: Peri<'static, peripherals::LPUART1>,
    rx: Peri<'static, peripherals::PA3>,
    tx: Peri<'static, peripherals::PA2>,
    tx_dma: Peri<'static, peripherals::DMA2_CH6>,
    rx_dma: Peri<'static, peripherals::DMA2_CH7>,
) -> (UartTx<'static, Async>, RingBufferedUartRx<'static>) {
    static RECEIVE_BUFFER: StaticCell<[u8; 512]> = StaticCell::new();
    TIME_DRIVER_INTERRUPT.set_priority(Priority::P2);
    interrupt::LPUART1.set_priority(Priority::P7);
    interrupt::DMA2_CHANNEL6.set_priority(Priority::P7);
    interrupt::DMA2_CHANNEL7.set_priority(Priority::P7);
    let mut config = usart::Config::default();
    config.baudrate = BAUD;
    let uart = Uart::new(uart, rx, tx, tx_dma, rx_dma, Interrupts, config);
    let Ok(uart) = uart else {
        defmt::panic!("LPUART1: the clock does not divide to the baud rate")
    };
    let (transmitter, receiver) = uart.split();
    let receiver = receiver.into_ring_buffered(RECEIVE_BUFFER.init([0; 512]));
    (transmitter, receiver)
}
