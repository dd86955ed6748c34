//! Motion of the rig, in integers only: units, axis, trapezoid, step times, run plan.
//!
//! * [`units`]: newtypes for steps, positions, lengths and times; the tick, [`units::TICK_HZ`].
//! * [`axis`]: screw, motor and stroke; converts lengths to steps; [`axis::Position`].
//! * [`trapezoid`]: [`trapezoid::StrokeProfile`], a move from rest to rest defined by three integers.
//! * [`step_times`]: the tick of every step of such a move, and stops on the way.
//! * [`slots`]: the ring from which DMA feeds the step timer.
//! * [`timeline`]: the planned steps, which [`edge_timing`] compares with the captured edges.
//! * [`run`]: a whole experiment, solved exactly before it starts or refused with the limit that
//!   it breaks.
//!
//! It uses no clock, no hardware, no floating point. Set-up may use `u128`; the code that runs once per step uses
//! `u32` products, one `u32` division and `i64` sums.
#![no_std]
#![forbid(unsafe_code)]

pub mod axis;
pub mod edge_timing;
pub mod run;
pub mod slots;
pub mod step_times;
pub mod timeline;
pub mod trapezoid;
pub mod units;
