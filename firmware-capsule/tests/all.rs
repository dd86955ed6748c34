//! All tests of the crate in one program: each program more takes seconds to build and link.

mod circuit;
mod control;
mod kept;
mod limits;
mod manual;
mod motions;
mod partial;
mod scenarios;
mod sense;
mod sequences;
mod settings;
mod states;
mod trace;
mod window;
