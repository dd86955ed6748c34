//! Things that go wrong, at an exact step edge or instant.

/// When a fault happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum When {
    /// At this instant of the bench's clock, ns.
    At(u64),
    /// Together with this step edge, counted from 1 over the bench's whole life.
    Edge(u64),
}

/// Faults that wait for their moment.
#[derive(Clone, Debug)]
pub struct Faults<A> {
    waiting: Vec<(When, A)>,
}

impl<A> Default for Faults<A> {
    fn default() -> Self {
        Self {
            waiting: Vec::new(),
        }
    }
}

impl<A> Faults<A> {
    /// Plans `action`.
    pub fn plan(&mut self, when: When, action: A) {
        self.waiting.push((when, action));
    }

    /// Takes what is due with edge `number`, in the order planned.
    pub fn due_at_edge(&mut self, number: u64) -> Vec<A> {
        self.take(|when| when == When::Edge(number))
    }

    /// Takes what is due by `now_ns`, in the order planned.
    pub fn due_by(&mut self, now_ns: u64) -> Vec<A> {
        self.take(|when| matches!(when, When::At(at) if at <= now_ns))
    }

    /// The earliest instant at which anything is due.
    #[must_use]
    pub fn next_ns(&self) -> Option<u64> {
        let instants = self.waiting.iter().filter_map(|(when, _)| match when {
            When::At(at) => Some(*at),
            When::Edge(_) => None,
        });
        instants.min()
    }

    fn take(&mut self, due: impl Fn(When) -> bool) -> Vec<A> {
        if self.waiting.is_empty() {
            return Vec::new();
        }
        let taken = self.waiting.extract_if(.., |(when, _)| due(*when));
        taken.map(|(_, action)| action).collect()
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
        assert_eq!(faults.due_by(50), ['b', 'a']);
        assert_eq!(faults.due_at_edge(3), ['c']);
        assert!(faults.due_at_edge(3).is_empty());
        assert_eq!(faults.next_ns(), None);
    }
}
