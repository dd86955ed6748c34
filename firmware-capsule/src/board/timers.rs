//! The encoder's counter and the timer of the bridge's pulses.

use embassy_stm32::pac;

/// One period of the bridge's pulses: 80 kHz of the timer's 16 MHz (docs/capsule.md, "Drive").
pub(crate) const PWM_TICKS: u16 = 200;

/// Counts all four edges of A and B, over the full 32 bits (RM0383 section 13.3.12). The inputs are filtered over
/// 8 clocks, 0.5 us; the motor's fastest edges are 57 us apart.
pub(crate) fn configure_encoder() {
    use pac::timer::vals::{CcmrInputCcs, FilterValue, Sms};
    pac::TIM2.ccmr_input(0).modify(|w| {
        for channel in [0, 1] {
            w.set_ccs(channel, CcmrInputCcs::TI4);
            w.set_icf(channel, FilterValue::FCK_INT_N8);
        }
    });
    pac::TIM2.smcr().modify(|w| w.set_sms(Sms::ENCODER_MODE_3));
    // It counts only while the encoder is powered.
    pac::TIM2.arr().write_value(u32::MAX);
}

/// Starts, or stops and keeps the count.
pub(crate) fn count_encoder(on: bool) {
    pac::TIM2.cr1().modify(|w| w.set_cen(on));
}

pub(crate) fn encoder_is_counted() -> bool {
    pac::TIM2.cr1().read().cen()
}

pub(crate) fn encoder_count() -> i32 {
    pac::TIM2.cnt().read() as i32
}

/// Sets the pulses up, on the timer's first two channels. They do not run yet.
pub(crate) fn configure_pulses() {
    use pac::timer::vals::Ocm;
    pac::TIM3.psc().write_value(0);
    pac::TIM3.arr().write(|w| w.set_arr(PWM_TICKS - 1));
    pac::TIM3.ccmr_output(0).modify(|w| {
        for channel in [0, 1] {
            w.set_ocm(channel, Ocm::PWM_MODE1);
            w.set_ocpe(channel, true); // a new duty begins with a period
        }
    });
    pac::TIM3.ccer().modify(|w| {
        w.set_cce(0, true);
        w.set_cce(1, true);
    });
}

/// Sets how many ticks of each period IN1 and IN2 are high, from the next period on.
pub(crate) fn set_pulses(in1: u16, in2: u16) {
    pac::TIM3.ccr(0).write(|w| w.set_ccr(in1));
    pac::TIM3.ccr(1).write(|w| w.set_ccr(in2));
}

/// Begins a period with the pulses that were set, or stops the pulses; the outputs stay.
pub(crate) fn run_pulses(on: bool) {
    if on {
        pac::TIM3.egr().write(|w| w.set_ug(true));
    }
    pac::TIM3.cr1().modify(|w| w.set_cen(on));
}

/// The pulses run, and the bridge is awake.
pub(crate) fn pulses_run() -> bool {
    pac::TIM3.cr1().read().cen()
}
