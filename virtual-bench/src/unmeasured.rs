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
}
