//! The winding between two edges of the bridge: its inductance, the diodes, and the current that the shunt sees.
//!
//! Speed and cell are constant between two edges, so the current is an exponential. Its charge and its square are
//! integrated exactly. Without inductance the current follows at once, and opening the bridge ends it.

use crate::parameters::{Parameters, Shunt};

/// State of the bridge at the winding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Bridge {
    /// Asleep, or both inputs low: the current decays through the diodes, against the cell.
    Coast,
    /// IN1 high: folds.
    Forward,
    /// IN2 high: unfolds.
    Reverse,
    /// Both inputs high, both low sides conduct: the winding is shorted. Between pulses this is slow decay.
    Brake,
}

/// Flow between two edges.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Flow {
    /// Current at the end, A.
    pub(crate) end_a: f64,
    /// Charge through the winding, C.
    pub(crate) charge: f64,
    /// Charge out of the cell, C.
    pub(crate) drawn: f64,
    /// Integral of the cell's current squared, A2 s: the heat in its own resistance.
    pub(crate) drawn_square: f64,
    /// Charge through the shunt, C.
    pub(crate) sensed: f64,
}

/// A source, a resistance and an inductance in series.
struct Circuit {
    volt: f64,
    ohm: f64,
    henry: f64,
}

impl Circuit {
    /// Current after `dt`, its integral and the integral of its square.
    fn carry(&self, from_a: f64, dt: f64) -> (f64, f64, f64) {
        let last = self.volt / self.ohm;
        if self.henry <= 0.0 {
            return (last, last * dt, last * last * dt);
        }
        let tau = self.henry / self.ohm;
        let decay = (-dt / tau).exp();
        let above = from_a - last;
        (
            last + above * decay,
            last * dt + above * tau * (1.0 - decay),
            last * last * dt
                + 2.0 * last * above * tau * (1.0 - decay)
                + above * above * tau / 2.0 * (1.0 - decay * decay),
        )
    }

    /// Time until the current passes zero.
    fn ends_after(&self, from_a: f64) -> f64 {
        let last = self.volt / self.ohm;
        if self.henry <= 0.0 || from_a * last >= 0.0 {
            return f64::INFINITY;
        }
        self.henry / self.ohm * (1.0 - from_a / last).ln()
    }
}

/// Present source of the current: the cell may polarise, the winding may warm up or be shorted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Source {
    /// Voltage of the cell without its resistance, V.
    pub(crate) cell_v: f64,
    /// Resistance of the winding, ohm.
    pub(crate) ohm: f64,
    /// Inductance of the winding, H; next to none if turns are shorted.
    pub(crate) henry: f64,
}

#[cfg(test)]
impl Source {
    fn of(parameters: &Parameters) -> Self {
        Self {
            cell_v: parameters.battery_mv * 1e-3,
            ohm: parameters.winding_ohm,
            henry: parameters.winding_h,
        }
    }
}

/// Simulates the winding for `dt`, with `from_a` in it at the start.
pub(crate) fn flow(
    parameters: &Parameters,
    source: Source,
    bridge: Bridge,
    (from_a, back_v): (f64, f64),
    dt: f64,
) -> Flow {
    let Source {
        cell_v: cell,
        ohm: winding,
        henry,
    } = source;
    let circuit = |volt: f64, ohm: f64| Circuit { volt, ohm, henry };
    let driven_ohm = winding + parameters.bridge_ohm + parameters.battery_ohm;
    let (sign, circuit) = match bridge {
        Bridge::Forward => (1.0, circuit(cell - back_v, driven_ohm)),
        Bridge::Reverse => (-1.0, circuit(-cell - back_v, driven_ohm)),
        Bridge::Brake => (0.0, circuit(-back_v, winding + parameters.bridge_ohm)),
        Bridge::Coast => {
            // The back-EMF stays below the cell's voltage, so a current that has decayed cannot return.
            if from_a == 0.0 || henry <= 0.0 {
                return Flow::default();
            }
            let against = -(cell + 2.0 * parameters.diode_v) * from_a.signum();
            let circuit = circuit(against - back_v, winding + parameters.battery_ohm);
            let ends = circuit.ends_after(from_a);
            let (mut end_a, charge, square) = circuit.carry(from_a, dt.min(ends));
            if ends <= dt {
                end_a = 0.0;
            }
            let sensed = match parameters.shunt {
                Shunt::Below { filtered_first } if filtered_first => -charge.abs(),
                Shunt::Below { .. } => 0.0,
                Shunt::InSeries => charge,
            };
            return Flow {
                end_a,
                charge,
                drawn: -charge.abs(),
                drawn_square: square,
                sensed,
            };
        }
    };
    let (end_a, charge, square) = circuit.carry(from_a, dt);
    let drawn = sign * charge;
    let sensed = match parameters.shunt {
        Shunt::InSeries => charge,
        Shunt::Below {
            filtered_first: true,
        } => drawn,
        Shunt::Below { .. } => {
            let (before, after) = (sign * from_a, sign * end_a);
            if sign == 0.0 || henry <= 0.0 || before >= 0.0 && after >= 0.0 {
                drawn.max(0.0)
            } else if before < 0.0 && after > 0.0 {
                // Only the part after the zero crossing reaches the shunt's amplifier.
                let zero = circuit.ends_after(from_a).min(dt);
                (sign * circuit.carry(0.0, dt - zero).1).max(0.0)
            } else if before > 0.0 {
                let zero = circuit.ends_after(from_a).min(dt);
                (sign * circuit.carry(from_a, zero).1).max(0.0)
            } else {
                0.0
            }
        }
    };
    Flow {
        end_a,
        charge,
        drawn,
        drawn_square: if sign == 0.0 { 0.0 } else { square },
        sensed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean current of a steady pulse train, and the mean that the shunt shows, mA.
    fn mean_ma(
        parameters: &Parameters,
        (period_s, duty): (f64, f64),
        pause: Bridge,
        back_v: f64,
    ) -> [f64; 2] {
        let mut from_a = 0.0;
        let mut means = [0.0; 2];
        for _ in 0..50 {
            let on = flow(
                parameters,
                Source::of(parameters),
                Bridge::Forward,
                (from_a, back_v),
                duty * period_s,
            );
            let off = flow(
                parameters,
                Source::of(parameters),
                pause,
                (on.end_a, back_v),
                (1.0 - duty) * period_s,
            );
            from_a = off.end_a;
            let mean = |charge: f64| charge / period_s * 1e3;
            means = [mean(on.charge + off.charge), mean(on.sensed + off.sensed)];
        }
        means
    }

    fn with(winding_h: f64, shunt: Shunt) -> Parameters {
        Parameters {
            winding_h,
            shunt,
            // Equal resistance in pulse and pause, so that the formulas hold exactly.
            battery_ohm: 0.0,
            ..Parameters::nominal()
        }
    }

    /// The mean is `(D V - e) / R` at any inductance, from 20 kHz on.
    #[test]
    fn slow_decay_has_a_mean_that_no_inductance_changes() {
        for winding_h in [0.0, 53e-6, 106e-6] {
            for period_s in [50e-6, 12.5e-6] {
                let parameters = with(winding_h, Shunt::InSeries);
                let [mean, seen] = mean_ma(&parameters, (period_s, 0.7), Bridge::Brake, 2.2);
                let wanted = (0.7 * 3.7 - 2.2) / 6.0 * 1e3;
                assert!((mean - wanted).abs() < 0.1, "{mean} mA for {wanted} mA");
                assert!((seen - mean).abs() < 1e-9);
            }
        }
    }

    /// 85 mA ordered from a bridge that opens between the pulses, by the formula without inductance.
    #[test]
    fn coasting_pulses_give_less_than_half_and_the_shunt_below_sees_something_else() {
        let duty = 0.085 * 6.0 / (3.7 - 2.2);
        let order = (50e-6, duty);
        let ideal = with(0.0, Shunt::InSeries);
        let [mean, _] = mean_ma(&ideal, order, Bridge::Coast, 2.2);
        assert!((mean - 85.0).abs() < 0.1, "{mean} mA");
        let real = with(53e-6, Shunt::InSeries);
        let [mean, _] = mean_ma(&real, order, Bridge::Coast, 2.2);
        assert!((40.0..60.0).contains(&mean), "{mean} mA");
        for (filtered_first, fraction) in [(false, 0.85..0.99), (true, 0.70..0.95)] {
            let below = with(53e-6, Shunt::Below { filtered_first });
            let [mean, seen] = mean_ma(&below, order, Bridge::Coast, 2.2);
            assert!(fraction.contains(&(seen / mean)), "{seen} of {mean} mA");
        }
    }

    #[test]
    fn a_current_that_freewheels_ends_and_charges_the_cell() {
        let parameters = with(53e-6, Shunt::InSeries);
        let coasting = flow(
            &parameters,
            Source::of(&parameters),
            Bridge::Coast,
            (0.5, 1.0),
            50e-6,
        );
        assert_eq!(coasting.end_a, 0.0);
        assert!(coasting.charge > 0.0 && coasting.drawn == -coasting.charge);
        // The same time in two parts.
        let first = flow(
            &parameters,
            Source::of(&parameters),
            Bridge::Coast,
            (0.5, 1.0),
            2e-6,
        );
        let second = flow(
            &parameters,
            Source::of(&parameters),
            Bridge::Coast,
            (first.end_a, 1.0),
            48e-6,
        );
        let sum = first.charge + second.charge;
        assert!((sum / coasting.charge - 1.0).abs() < 1e-9);
    }

    /// The cell's energy goes into the winding's heat and the motor.
    #[test]
    fn no_energy_is_lost() {
        let parameters = with(53e-6, Shunt::InSeries);
        let (mut from_a, mut given, mut taken) = (0.0, 0.0, 0.0);
        for _ in 0..200 {
            for (bridge, dt) in [(Bridge::Forward, 8e-6), (Bridge::Brake, 4.5e-6)] {
                // Steps so short that the square of the mean equals the mean of the square.
                for _ in 0..100 {
                    let part = flow(
                        &parameters,
                        Source::of(&parameters),
                        bridge,
                        (from_a, 2.0),
                        dt / 100.0,
                    );
                    from_a = part.end_a;
                    given += 3.7 * part.drawn;
                    taken += 2.0 * part.charge + 6.0 * part.charge * part.charge / (dt / 100.0);
                }
            }
        }
        taken += 53e-6 * from_a * from_a / 2.0;
        assert!((given / taken - 1.0).abs() < 1e-3, "{given} J, {taken} J");
    }
}
