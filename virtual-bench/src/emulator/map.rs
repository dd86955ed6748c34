//! Where an STM32F411RE differs from the emulated STM32F427: memory sizes, peripherals, DMA requests, unique number. An
//! access to something that the STM32F411 lacks is recorded and fails a run.

use std::num::{NonZeroU32, NonZeroU64};
use std::path::Path;

use rigless::image::Image;
use rigless::soc::st::tim::{CHANNEL_REQUESTS, UPDATE_REQUEST};
use rigless::soc::stm32f427::peripherals::dma::{Dma, Wire};
use rigless::soc::stm32f427::peripherals::{adc, usart};
use rigless::soc::{EraseBlocks, Region};

use super::ring::StreamId;

/// First byte of the flash.
pub(super) const FLASH_BASE: u64 = 0x0800_0000;
/// Bytes of flash (RM0383 table 4).
pub(super) const FLASH_BYTES: u64 = 512 << 10;

/// Sizes of the eight sectors in order, bytes (RM0383 table 4).
pub(super) const SECTOR_BYTES: [u64; 8] = [
    16 << 10,
    16 << 10,
    16 << 10,
    16 << 10,
    64 << 10,
    128 << 10,
    128 << 10,
    128 << 10,
];

const fn blocks(bytes: u64, count: u32) -> EraseBlocks {
    match (NonZeroU64::new(bytes), NonZeroU32::new(count)) {
        (Some(size), Some(count)) => EraseBlocks { size, count },
        _ => panic!("a sector has bytes"),
    }
}

static SECTORS: [EraseBlocks; 3] = [
    blocks(16 << 10, 4),
    blocks(64 << 10, 1),
    blocks(128 << 10, 3),
];

/// The RAM.
pub(super) const RAM: std::ops::Range<u64> = 0x2000_0000..0x2002_0000;

/// The memories of the STM32F411RE (RM0383 section 2.3).
pub(super) static MEMORY: [Region; 3] = [
    Region::flash("flash", FLASH_BASE, FLASH_BYTES)
        .erased_in(&SECTORS)
        .erased_to(0xFF)
        .programmed_by("FLASH"),
    Region::system("system", 0x1FFF_0000, 32 << 10),
    Region::ram("sram", RAM.start, RAM.end - RAM.start),
];

/// Below the RAM, above the system memory: reserved except for 16 option bytes, which no firmware reads here; and above
/// the RAM. An access is a bus error (docs/silicon.md, item 18).
pub(super) const BESIDE_RAM: [std::ops::Range<u64>; 2] =
    [0x1FFF_8000..0x2000_0000, RAM.end..0x2200_0000];

/// Interrupt lines 0 to 85 (RM0383 table 37).
pub(super) const INTERRUPT_LINES: u32 = 86;

/// The 1 KiB blocks of 0x4000_0000.. that an STM32F411 has (RM0383 table 1), in KiB from there.
const PRESENT: [u16; 40] = [
    // APB1: TIM2 to TIM5, RTC, WWDG, IWDG, I2S2ext, SPI2, SPI3, I2S3ext, USART2, I2C1 to I2C3, PWR
    0, 1, 2, 3, 10, 11, 12, 13, 14, 15, 16, 17, 21, 22, 23, 28,
    // APB2: TIM1, USART1, USART6, ADC1, SDIO, SPI1, SPI4, SYSCFG, EXTI, TIM9 to TIM11, SPI5
    64, 68, 69, 72, 75, 76, 77, 78, 79, 80, 81, 82, 84,
    // AHB1: GPIOA to GPIOE, GPIOH, CRC, RCC, FLASH, DMA1, DMA2
    128, 129, 130, 131, 132, 135, 140, 142, 143, 152, 153,
];

/// Whether `address` belongs to a peripheral block that the STM32F411 does not have.
pub(super) fn absent(address: u64) -> bool {
    match address {
        0x4000_0000..0x4008_0000 => {
            let block = (address - 0x4000_0000) >> 10;
            !PRESENT.iter().any(|&present| u64::from(present) == block)
        }
        // The full-speed USB core and the processor's own blocks.
        0x5000_0000..0x5004_0000 | 0xE000_0000..=0xE00F_FFFF => false,
        _ => address >= 0x4008_0000,
    }
}

const fn wire(
    instance: &'static str,
    request: usize,
    channel: usize,
    streams: &'static [usize],
) -> Wire {
    Wire {
        instance,
        request,
        channel,
        streams,
    }
}

/// Requests of the peripherals in use (RM0383 table 27).
static DMA1_REQUESTS: [Wire; 4] = [
    wire("USART2", usart::RECEIVE_REQUEST, 4, &[5]),
    wire("USART2", usart::TRANSMIT_REQUEST, 4, &[6]),
    wire("USART2", usart::RECEIVE_REQUEST, 6, &[7]),
    wire("TIM5", CHANNEL_REQUESTS[1], 6, &[4]),
];

/// Requests of the peripherals in use (RM0383 table 28). The emulator's own table has no timers.
static DMA2_REQUESTS: [Wire; 2] = [
    wire("ADC1", adc::DMA_REQUEST, 0, &[0, 4]),
    wire("TIM1", UPDATE_REQUEST, 6, &[5]),
];

/// The rings of the step timer's periods and of the captured instants. They are also in the tables above.
pub(super) const PERIODS: StreamId = StreamId {
    stream: 5,
    channel: 6,
    instance: "TIM1",
    request: UPDATE_REQUEST,
};
pub(super) const CAPTURES: StreamId = StreamId {
    stream: 4,
    channel: 6,
    instance: "TIM5",
    request: CHANNEL_REQUESTS[1],
};
/// The ring of the received bytes.
pub(super) const RECEIVED: StreamId = StreamId {
    stream: 5,
    channel: 4,
    instance: "USART2",
    request: usart::RECEIVE_REQUEST,
};
/// TIM5_CCR2 (RM0383 table 1 and section 13.4.14).
pub(super) const TIM5_CCR2: u64 = 0x4000_0C38;

/// Both controllers with the STM32F411's requests.
pub(super) fn controllers() -> [Dma; 2] {
    [
        Dma::new(&DMA1_REQUESTS, &[], false),
        Dma::new(&DMA2_REQUESTS, &[], true),
    ]
}

/// Placeholder in the part while the bench uses its own controller.
pub(super) fn placeholder_dma() -> Dma {
    Dma::new(&[], &[], true)
}

/// The factory's data: the 96-bit unique number at 0x1FFF_7A10 and the flash size in KiB at 0x1FFF_7A22
/// (RM0383 section 24), and the calibration of reference and temperature sensor (DS10314 table 70 and 76).
pub(super) fn factory_image(uid: [u8; 12]) -> Result<Image, rigless::image::Error> {
    let mut bytes = vec![0xFF; 0x20];
    bytes[..12].copy_from_slice(&uid);
    let mut put =
        |offset: usize, value: u16| bytes[offset..offset + 2].copy_from_slice(&value.to_le_bytes());
    put(0x12, 512);
    // 1.21 V of 3.3 V, and 0.76 V and 0.96 V, as 12-bit readings.
    put(0x1A, 1502);
    put(0x1C, 943);
    put(0x1E, 1191);
    Image::new(Path::new("factory words"), bytes, Some(0x1FFF_7A10))
}
