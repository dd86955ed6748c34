//! The record of every step edge that left the chip.

use std::fmt;

use sha2::{Digest, Sha256};

/// A rising edge of STEP with the direction at that time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StepEdge {
    /// Instant, ns on the bench's clock.
    pub at_ns: u64,
    /// Whether the direction is away from home.
    pub away: bool,
}

/// Rising step edges in order, eight bytes each.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EdgeLog {
    packed: Vec<u64>,
}

impl EdgeLog {
    pub fn push(&mut self, edge: StepEdge) {
        self.packed.push(edge.at_ns << 1 | u64::from(edge.away));
    }

    /// Edges so far.
    #[must_use]
    pub fn len(&self) -> usize {
        self.packed.len()
    }

    /// Whether no edge has left the chip.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.packed.is_empty()
    }

    /// The edges in order.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = StepEdge> + ExactSizeIterator + '_ {
        self.packed.iter().map(|&packed| StepEdge {
            at_ns: packed >> 1,
            away: packed & 1 == 1,
        })
    }

    /// The edges from number `first` on.
    #[must_use]
    pub fn since(&self, first: usize) -> Self {
        Self {
            packed: self.packed[first.min(self.packed.len())..].to_vec(),
        }
    }

    /// The edges at or after `from_ns`.
    #[must_use]
    pub fn after(&self, from_ns: u64) -> Self {
        self.since(self.packed.partition_point(|&packed| packed >> 1 < from_ns))
    }

    /// Fingerprint of all edges: two runs are equal when these are.
    #[must_use]
    pub fn sha256(&self) -> Fingerprint {
        let mut hash = Sha256::new();
        for packed in &self.packed {
            hash.update(packed.to_le_bytes());
        }
        Fingerprint(hash.finalize().into())
    }
}

impl FromIterator<StepEdge> for EdgeLog {
    fn from_iter<T: IntoIterator<Item = StepEdge>>(edges: T) -> Self {
        let mut log = Self::default();
        edges.into_iter().for_each(|edge| log.push(edge));
        log
    }
}

/// A SHA-256.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fingerprint(pub [u8; 32]);

impl fmt::Display for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}
