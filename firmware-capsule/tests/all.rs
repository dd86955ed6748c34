//! All tests of the crate in one program: each program more takes seconds to build and link.

mod cases;
mod control;
mod known;
mod manual;
mod motions;
mod sense;
mod settings;
mod states;
mod trace;
mod units;
