//! Faults at an exact step edge or instant.

use std::collections::BTreeMap;

/// When a fault happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// At this instant of the bench's clock, ns.
    At(u64),
    /// Together with this step edge, counted from 1 since the start of the bench.
    Edge(u64),
}

/// Planned faults.
#[derive(Clone, Debug)]
pub struct Faults<A> {
    at: BTreeMap<u64, Vec<A>>,
    edge: BTreeMap<u64, Vec<A>>,
}

impl<A> Default for Faults<A> {
    fn default() -> Self {
        Self {
            at: BTreeMap::new(),
            edge: BTreeMap::new(),
        }
    }
}

impl<A> Faults<A> {
    pub fn plan(&mut self, when: When, action: A) {
        let (waiting, moment) = match when {
            When::At(at) => (&mut self.at, at),
            When::Edge(number) => (&mut self.edge, number),
        };
        waiting.entry(moment).or_default().push(action);
    }

    /// Takes the faults due with edge `number`, in the order planned.
    pub fn due_at_edge(&mut self, number: u64) -> Vec<A> {
        self.edge.remove(&number).unwrap_or_default()
    }

    /// Takes the faults due by `now_ns`, the earliest first.
    pub fn due_by(&mut self, now_ns: u64) -> Vec<A> {
        let mut due = Vec::new();
        while let Some(first) = self.at.first_entry()
            && *first.key() <= now_ns
        {
            due.extend(first.remove());
        }
        due
    }

    /// The first edge with which a fault is due.
    #[must_use]
    pub fn next_edge(&self) -> Option<u64> {
        self.edge.first_key_value().map(|(number, _)| *number)
    }

    /// When the next fault is due, ns.
    #[must_use]
    pub fn next_ns(&self) -> Option<u64> {
        self.at.first_key_value().map(|(at, _)| *at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fault_is_due_once_at_its_moment() {
        let mut faults = Faults::default();
        faults.plan(When::At(50), 'b');
        faults.plan(When::Edge(3), 'c');
        faults.plan(When::At(20), 'a');
        assert_eq!(faults.next_ns(), Some(20));
        assert!(faults.due_at_edge(2).is_empty());
        assert!(faults.due_by(19).is_empty());
        assert_eq!(faults.due_by(50), ['a', 'b']);
        assert_eq!(faults.due_at_edge(3), ['c']);
        assert!(faults.due_at_edge(3).is_empty());
        assert_eq!(faults.next_ns(), None);
    }
}
