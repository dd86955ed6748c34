//! All tests of the crate in one program: each program more takes seconds to build and link.

mod fingerprint;
mod half_periods;
mod link;
mod mark;
mod option_bytes;
mod retained;
mod settings;
mod store;
mod supervision;
