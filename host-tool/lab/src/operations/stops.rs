//! The stops of one machine: which are awaited, and which the machine has confirmed. It uses neither clock nor thread.
//!
//! Each stop has a number. Only a confirmation by the machine counts, and only for stops requested before the confirmed
//! one was sent: a stop without an answer says nothing about the next. Orders older than a stop must not move anything
//! any more.

use std::sync::{Mutex, PoisonError};

use protocol::system::Urgent;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Ask {
    number: u64,
    urgent: Urgent,
}

impl Ask {
    /// Number of the stop, from 1.
    pub fn number(self) -> u64 {
        self.number
    }
}

/// The stops of one machine, for several threads.
#[derive(Debug, Default)]
pub struct Stops(Mutex<Book>);

impl Stops {
    /// Reads or changes the book. The lock lasts no longer than `act`, which must not wait.
    pub fn with<T>(&self, act: impl FnOnce(&mut Book) -> T) -> T {
        // No code panics while holding the lock; if it did, a stop must still be sent.
        act(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// The data of [`Stops`] without the lock: a value that a model can copy and compare.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Book {
    /// Number of the last stop.
    asked: u64,
    /// Number of the last stop of each strength.
    last: [u64; 2],
    /// For each strength, the number up to which the machine has confirmed a stop at least as strong.
    confirmed: [u64; 2],
    /// Requests that are still awaited.
    open: Vec<Ask>,
    /// Set while an order is executed: the number of the last stop before it.
    order: Option<u64>,
}

/// Name of a stop on the screen.
pub fn name(urgent: Urgent) -> &'static str {
    match urgent {
        Urgent::Stop => "stop",
        Urgent::EStop => "EMERGENCY STOP",
    }
}

impl Book {
    /// Requests a stop, which stays open until [`Book::withdraw`].
    pub fn ask(&mut self, urgent: Urgent) -> Ask {
        self.asked += 1;
        let number = self.asked;
        self.last[urgent as usize] = number;
        let ask = Ask { number, urgent };
        self.open.push(ask);
        ask
    }

    /// Ends the wait for this stop. Waits for other stops continue.
    pub fn withdraw(&mut self, ask: Ask) {
        self.open.retain(|open| *open != ask);
    }

    /// Number of the last stop. An order that arrives now is newer than this stop and older than the next.
    pub fn asked(&self) -> u64 {
        self.asked
    }

    /// Notes that the machine has confirmed this stop, which was sent after stop `number` was requested.
    pub fn confirm(&mut self, urgent: Urgent, number: u64) {
        // An emergency stop also confirms an ordinary one.
        for confirmed in &mut self.confirmed[..=urgent as usize] {
            *confirmed = number.max(*confirmed);
        }
    }

    /// Whether the machine has confirmed a stop that was sent after this one was requested.
    pub fn is_confirmed(&self, ask: Ask) -> bool {
        self.confirmed[ask.urgent as usize] >= ask.number
    }

    pub fn unconfirmed(&self) -> Option<Urgent> {
        let open = self.open.iter().filter(|ask| !self.is_confirmed(**ask));
        open.map(|ask| ask.urgent).max()
    }

    /// The strongest stop requested since stop `number`, confirmed or not.
    pub fn since(&self, number: u64) -> Option<Urgent> {
        [Urgent::EStop, Urgent::Stop]
            .into_iter()
            .find(|urgent| self.last[*urgent as usize] > number)
    }

    /// Begins an order that came after stop `number`: every later stop ends it. `None` ends the order.
    pub fn order(&mut self, number: Option<u64>) {
        self.order = number;
    }

    /// The stop that has to be sent to the machine now, if any.
    pub fn wanted(&self) -> Option<Urgent> {
        let during = self.order.and_then(|number| self.since(number));
        self.unconfirmed().max(during)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: three stops of a dead machine. The second and third used to be reported as confirmed, because the
    /// first had given up.
    #[test]
    fn a_stop_that_nobody_confirmed_confirms_no_other() {
        let mut stops = Book::default();
        let asks = [(); 3].map(|()| stops.ask(Urgent::EStop));
        for ask in asks {
            assert!(!stops.is_confirmed(ask));
            stops.withdraw(ask);
        }
        assert!(asks.iter().all(|ask| !stops.is_confirmed(*ask)));
        assert_eq!(stops.unconfirmed(), None);
    }

    #[test]
    fn a_confirmation_counts_for_what_was_asked_for_before_the_stop_was_sent() {
        let mut stops = Book::default();
        let early = stops.ask(Urgent::Stop);
        let sent = stops.asked();
        let late = stops.ask(Urgent::Stop);
        stops.confirm(Urgent::Stop, sent);
        assert!(stops.is_confirmed(early) && !stops.is_confirmed(late));
        assert_eq!(stops.unconfirmed(), Some(Urgent::Stop));
        // A late answer to an earlier stop does not undo confirmations.
        stops.confirm(Urgent::Stop, stops.asked());
        stops.confirm(Urgent::Stop, 0);
        assert!(stops.is_confirmed(late));
    }

    #[test]
    fn a_stop_is_no_emergency_stop_but_an_emergency_stop_is_a_stop() {
        let mut stops = Book::default();
        let (stop, estop) = (stops.ask(Urgent::Stop), stops.ask(Urgent::EStop));
        stops.confirm(Urgent::Stop, stops.asked());
        assert!(stops.is_confirmed(stop) && !stops.is_confirmed(estop));
        assert_eq!(stops.wanted(), Some(Urgent::EStop));
        let again = stops.ask(Urgent::Stop);
        stops.confirm(Urgent::EStop, stops.asked());
        assert!(stops.is_confirmed(estop) && stops.is_confirmed(again));
    }

    #[test]
    fn whoever_gives_up_takes_nobody_elses_stop_back() {
        let mut stops = Book::default();
        let (one, other) = (stops.ask(Urgent::EStop), stops.ask(Urgent::Stop));
        stops.withdraw(one);
        assert_eq!(stops.wanted(), Some(Urgent::Stop));
        stops.withdraw(other);
        assert_eq!(stops.wanted(), None);
    }

    #[test]
    fn a_stop_ends_every_older_order_and_no_newer_one() {
        let mut stops = Book::default();
        let older = stops.asked();
        let ask = stops.ask(Urgent::EStop);
        stops.confirm(Urgent::EStop, stops.asked());
        stops.withdraw(ask);
        let newer = stops.asked();
        assert_eq!(stops.since(older), Some(Urgent::EStop));
        assert_eq!(stops.since(newer), None);
        assert_eq!(stops.wanted(), None);
        stops.order(Some(older));
        assert_eq!(stops.wanted(), Some(Urgent::EStop));
        stops.order(None);
        stops.order(Some(newer));
        assert_eq!(stops.wanted(), None);
        let _ = stops.ask(Urgent::Stop);
        assert_eq!(stops.wanted(), Some(Urgent::Stop));
    }
}
