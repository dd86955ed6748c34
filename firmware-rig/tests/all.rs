//! All tests of the crate in one program: each program more takes seconds to build and link.

mod commands;
mod control;
mod edge_timing;
mod execution;
mod holding;
mod machine;
mod manual;
mod moving;
mod periods;
mod runs;
mod sequences;
mod settings;
