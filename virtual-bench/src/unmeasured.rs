//! Why a figure of the bench could not be measured.

use client::error::ClientError;

use crate::bench::BenchError;

/// Why a figure could not be measured.
#[derive(Debug, thiserror::Error, miette::Diagnostic)]
pub enum FigureError {
    /// The bench.
    #[error(transparent)]
    #[diagnostic(code(bench::failed))]
    Bench(#[from] BenchError),
    /// The device or the link to it.
    #[error(transparent)]
    #[diagnostic(transparent)]
    Client(#[from] ClientError),
    /// The step compressor of Klipper.
    #[error("Klipper's step compressor cannot be measured: {what}")]
    #[diagnostic(
        code(bench::klipper),
        help(
            "give the folder of a clone of Klipper with its `klippy/chelper`, and install a C compiler"
        )
    )]
    Klipper {
        /// Reason of the failure.
        what: String,
    },
    /// The page for the tables.
    #[error("the tables cannot be written into the page: {what}")]
    #[diagnostic(code(bench::page), help("give docs/performance.md, or a copy of it"))]
    Page {
        /// Reason of the failure.
        what: String,
    },
}
