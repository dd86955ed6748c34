//! The serial port: USART2 with two streams of DMA1.

use super::{super::start::BAUD, TIME_DRIVER_INTERRUPT};
use embassy_stm32::{
    Peri, bind_interrupts, dma,
    gpio::Pull,
    interrupt::{self, InterruptExt, Priority},
    mode::Async,
    peripherals,
    usart::{self, RingBufferedUartRx, Uart, UartTx},
};
use static_cell::StaticCell;

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
    static RECEIVE_BUFFER: StaticCell<[u8; 512]> = StaticCell::new();
    TIME_DRIVER_INTERRUPT.set_priority(Priority::P2);
    interrupt::USART2.set_priority(Priority::P7);
    interrupt::DMA1_STREAM5.set_priority(Priority::P7);
    interrupt::DMA1_STREAM6.set_priority(Priority::P7);
    let mut config = usart::Config::default();
    config.baudrate = BAUD;
    // The ST-LINK drives the line, but not while it is without power or starts.
    config.rx_pull = Pull::Up;
    let uart = Uart::new(usart, rx, tx, tx_dma, rx_dma, Interrupts, config);
    let Ok(uart) = uart else {
        defmt::panic!("USART2: the clock does not divide to the baud rate")
    };
    let (transmitter, receiver) = uart.split();
    let receiver = receiver.into_ring_buffered(RECEIVE_BUFFER.init([0; 512]));
    (transmitter, receiver)
}
