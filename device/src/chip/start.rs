//! The chip at its start: clocks, time base, identity, serial port, watchdog.

use super::supply;
use crate::option_bytes::brown_out;
use embassy_stm32::{
    Config, Peri, bind_interrupts, dma,
    interrupt::{self, InterruptExt, Priority},
    mode::Async,
    pac, peripherals,
    usart::{self, RingBufferedUartRx, Uart, UartTx},
    wdg::IndependentWatchdog,
};
use protocol::system::{Chip, Clock, ResetCause};
use static_cell::StaticCell;

bind_interrupts!(struct Interrupts {
    USART2 => usart::InterruptHandler<peripherals::USART2>;
    DMA1_STREAM5 => dma::InterruptHandler<peripherals::DMA1_CH5>;
    DMA1_STREAM6 => dma::InterruptHandler<peripherals::DMA1_CH6>;
});

/// Speed of the serial port, baud.
const BAUD: u32 = 115_200;

/// The external clock has this long to come, ms: the ST-LINK has to start first.
const CLOCK_MS: u32 = 300;
/// The oscillator that a reset begins with, kHz.
const RESET_KHZ: u32 = 16_000;

/// Longer than the longest erasure of a settings sector, 500 ms, in which no task runs.
const WATCHDOG_US: u32 = 800_000;

/// The timer of the HAL's time driver (a feature of the HAL in the workspace's manifest).
pub(super) const TIME_DRIVER: pac::timer::TimGp16 = pac::TIM4;

/// Starts the HAL. Its time driver would count a compare flag that is raised at its initialisation as half a
/// period, 65 ms, and the clock could step back later: the flag is cleared before the first interrupt can see it.
pub fn init_clearing_stale_flags(config: Config) -> embassy_stm32::Peripherals {
    cortex_m::interrupt::free(|_| {
        let peripherals = embassy_stm32::init(config);
        TIME_DRIVER.sr().write_value(pac::timer::regs::SrGp16(0));
        cortex_m::peripheral::NVIC::unpend(pac::Interrupt::TIM4);
        peripherals
    })
}

/// Starts the watchdog and then the HAL with `external` clocks, or with `internal` ones where the external clock does
/// not come. A clock that stops later breaks TIM1, which ends all pulses, and raises the NMI (RM0383 section 6.2.7).
///
/// The HAL itself waits for the external clock for ever, and before the watchdog.
pub fn init_with_either_clock(external: Config, internal: Config) -> embassy_stm32::Peripherals {
    start_watchdog();
    let comes = external_clock_comes();
    let peripherals = init_clearing_stale_flags(if comes { external } else { internal });
    pac::RCC.cr().modify(|w| w.set_csson(comes));
    peripherals
}

/// Starts the watchdog with what [`watchdog`] will ask for. The prescaler and the reload value are taken while its clock
/// runs, so it is started first (RM0383 section 18.3).
fn start_watchdog() {
    use pac::iwdg::vals::{Key, Pr};
    let key = |key| pac::IWDG.kr().write(|w| w.set_key(key));
    key(Key::START);
    key(Key::ENABLE);
    pac::IWDG.pr().write(|w| w.set_pr(Pr::DIVIDE_BY8));
    // 32 kHz / 8: four to the millisecond.
    pac::IWDG
        .rlr()
        .write(|w| w.set_rl((WATCHDOG_US / 250 - 1) as u16));
    // Five cycles of its clock; the longest wait is a millisecond.
    let taken = |_| {
        let status = pac::IWDG.sr().read();
        !status.pvu() && !status.rvu()
    };
    let _ = (0..RESET_KHZ / 10).any(taken);
    feed();
}

/// Feeds the watchdog.
pub(super) fn feed() {
    pac::IWDG
        .kr()
        .write(|w| w.set_key(pac::iwdg::vals::Key::RESET));
}

/// Switches the external clock on and waits for it, bounded. Off again if it does not come.
fn external_clock_comes() -> bool {
    pac::RCC.cr().modify(|w| w.set_hsebyp(true));
    pac::RCC.cr().modify(|w| w.set_hseon(true));
    let comes = (0..CLOCK_MS).any(|_| {
        cortex_m::asm::delay(RESET_KHZ);
        feed();
        pac::RCC.cr().read().hserdy()
    });
    pac::RCC.cr().modify(|w| w.set_hseon(comes));
    comes
}

/// Why the chip was reset; clears the flags (RM0383 section 6.3.21).
pub fn reset_cause() -> ResetCause {
    let csr = pac::RCC.csr().read();
    pac::RCC.csr().modify(|w| w.set_rmvf(true));
    if csr.wdgrstf() {
        ResetCause::Watchdog
    } else if csr.porrstf() || csr.borrstf() {
        ResetCause::PowerOn
    } else if csr.sftrstf() {
        ResetCause::Software
    } else {
        ResetCause::Pin
    }
}

/// Clock, supply and option bytes as they are now.
pub fn chip() -> Chip {
    let option_bytes = supply::option_bytes();
    let external = pac::RCC.pllcfgr().read().pllsrc() == pac::rcc::vals::Pllsrc::HSE;
    Chip {
        clock: if external && pac::RCC.cr().read().hserdy() {
            Clock::External
        } else {
            Clock::Internal
        },
        brown_out: brown_out(option_bytes),
        supply_low: supply::is_low(),
        option_bytes,
    }
}

/// The chip's unique number (RM0383 section 24.1).
pub fn uid() -> [u8; 12] {
    embassy_stm32::uid::uid()
}

/// Opens the serial port, and sets priorities: the time base at 2, the port below everything else at 7.
pub fn open_serial(
    usart: Peri<'static, peripherals::USART2>,
    rx: Peri<'static, peripherals::PA3>,
    tx: Peri<'static, peripherals::PA2>,
    tx_dma: Peri<'static, peripherals::DMA1_CH6>,
    rx_dma: Peri<'static, peripherals::DMA1_CH5>,
) -> (UartTx<'static, Async>, RingBufferedUartRx<'static>) {
    static RECEIVE_BUFFER: StaticCell<[u8; 512]> = StaticCell::new();
    interrupt::TIM4.set_priority(Priority::P2);
    interrupt::USART2.set_priority(Priority::P7);
    interrupt::DMA1_STREAM5.set_priority(Priority::P7);
    interrupt::DMA1_STREAM6.set_priority(Priority::P7);
    let mut config = usart::Config::default();
    config.baudrate = BAUD;
    let uart = Uart::new(usart, rx, tx, tx_dma, rx_dma, Interrupts, config);
    let Ok(uart) = uart else {
        defmt::panic!("USART2: the clock does not divide to the baud rate")
    };
    let (transmitter, receiver) = uart.split();
    let receiver = receiver.into_ring_buffered(RECEIVE_BUFFER.init([0; 512]));
    (transmitter, receiver)
}

/// The watchdog, not yet started.
pub fn watchdog(
    iwdg: Peri<'static, peripherals::IWDG>,
) -> IndependentWatchdog<'static, peripherals::IWDG> {
    IndependentWatchdog::new(iwdg, WATCHDOG_US)
}
