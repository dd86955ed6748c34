//! How long flash operations take, in a sector in which no settings are stored.

use super::log_value;
use device::{
    chip::flash::Sectors,
    store::{SECTOR, SECTORS},
};
use embassy_futures::block_on;
use embassy_stm32::pac::TIM5;
use embedded_storage_async::nor_flash::{NorFlash, ReadNorFlash};
use measurements::Measurement as M;

/// The last sector of the settings.
const OFFSET: u32 = SECTORS.end - SECTOR;
/// Words written for the measurement.
const WORDS: u32 = 64;
/// Ticks of TIM5 in a microsecond.
const US: u32 = 100;

/// Reports the times, unless the supply is too low or settings are stored there.
pub fn report(mut sectors: Sectors) {
    // After an error the rest is missing and shows as "not measured".
    let _ = block_on(async {
        let mut stored = [0; 4];
        for offset in (OFFSET..OFFSET + SECTOR).step_by(stored.len()) {
            sectors.read(offset, &mut stored).await?;
            if stored != [0xFF; 4] {
                return Ok(());
            }
        }
        let first = erase_us(&mut sectors).await?;
        let began = TIM5.cnt().read();
        for word in 0..WORDS {
            sectors.write(OFFSET + 4 * word, &[0; 4]).await?;
        }
        let words = ticks_since(began);
        let second = erase_us(&mut sectors).await?;
        log_value(M::EraseTime, first.max(second));
        log_value(M::WordTime, words / WORDS / US);
        Ok::<_, <Sectors as embedded_storage_async::nor_flash::ErrorType>::Error>(())
    });
}

/// Erases the sector; us.
async fn erase_us(sectors: &mut Sectors) -> Result<u32, embassy_stm32::flash::Error> {
    let began = TIM5.cnt().read();
    sectors.erase(OFFSET, OFFSET + SECTOR).await?;
    Ok(ticks_since(began) / US)
}

fn ticks_since(began: u32) -> u32 {
    TIM5.cnt().read().wrapping_sub(began)
}
