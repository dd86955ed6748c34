//! The settings that results depend on, grouped by result.

use protocol::settings::SettingKey as Key;

/// Settings that convert steps to millimetres.
pub(super) const SCREW: [Key; 3] = [Key::LeadUm, Key::FullSteps, Key::Microsteps];
/// Settings that homing depends on.
pub(super) const HOMING: &[Key] = &[
    Key::LeadUm,
    Key::FullSteps,
    Key::Microsteps,
    Key::StrokeUm,
    Key::SeekUmS,
    Key::LocateUmS,
    Key::HomingAccelUmS2,
    Key::StopAccelUmS2,
    Key::OvertravelUm,
    Key::PullOffUm,
    Key::FlagUm,
    Key::SwitchFilterUs,
    Key::MaxStepHz,
    Key::StepPulseNs,
];
/// Settings that the pulses of short strokes depend on. The length of these strokes follows from `FlagUm` or, where
/// that is 0, from `MaxResidualSteps`.
pub(super) const PULSES: &[Key] = &[
    Key::LeadUm,
    Key::FullSteps,
    Key::Microsteps,
    Key::MaxSpeedUmS,
    Key::MaxAccelUmS2,
    Key::MaxStepHz,
    Key::StepPulseNs,
    Key::TurnaroundUs,
    Key::FlagUm,
    Key::MaxResidualSteps,
];
/// Settings that a slow run depends on if it brakes on the way.
pub(super) const BRAKED: &[Key] = &[
    Key::LeadUm,
    Key::FullSteps,
    Key::Microsteps,
    Key::StopAccelUmS2,
];
/// Settings that a whole run depends on.
pub(super) const RUN: &[Key] = &[
    Key::LeadUm,
    Key::FullSteps,
    Key::Microsteps,
    Key::StrokeUm,
    Key::MaxSpeedUmS,
    Key::MaxAccelUmS2,
    Key::MaxStepHz,
    Key::StepPulseNs,
    Key::TurnaroundUs,
    Key::FlagUm,
    Key::MaxResidualSteps,
    Key::SwitchFilterUs,
];
