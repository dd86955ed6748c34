//! Motion of the rig in pure integers: units, axis, trapezoid, step times, run plan.
//!
//! * [`units`]: the newtypes and the clock, [`units::TICK_HZ`].
//! * [`axis`]: screw, motor and stroke; what a micrometre is in steps; [`axis::Position`].
//! * [`trapezoid`]: [`trapezoid::StrokeProfile`], a move from rest to rest defined by three integers.
//! * [`step_times`]: the tick of every step of such a move, and how to stop within it.
//! * [`run`]: a whole experiment, solved exactly before it starts or refused with the number
//!   that makes it infeasible.
//!
//! There is no clock, no hardware and no floating point in here. Set-up may use `u128`; the path
//! that runs once per step uses `u32` products, one `u32` division and `i64` sums.
#![no_std]
#![forbid(unsafe_code)]

pub mod axis;
pub mod run;
pub mod step_times;
pub mod trapezoid;
pub mod units;
mod wide;
