//! All tests of the crate in one program: each program more takes seconds to build and link.

mod axis;
mod paper;
mod run;
mod step_times;
mod timeline;
