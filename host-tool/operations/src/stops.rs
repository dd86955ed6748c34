//! Which stops of one machine somebody waits for, and which of them the machine has confirmed. It has neither clock nor
//! thread.
//!
//! Each stop has a number. Only a confirmation by the machine counts for one, and only for those asked for before it was
//! sent: a stop that nobody has answered says nothing about the next. What was ordered before a stop is older than its
//! number, and must not move anything any more.

use std::sync::{Mutex, MutexGuard, PoisonError};

use protocol::system::Urgent;

/// A stop that somebody has asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Ask {
    number: u64,
    urgent: Urgent,
}

impl Ask {
    /// Number of the stop, from 1.
    #[must_use]
    pub fn number(self) -> u64 {
        self.number
    }
}

/// The stops of one machine, for several threads.
#[derive(Debug, Default)]
pub struct Stops(Mutex<Book>);

/// What [`Stops`] keeps, without the threads: a value that a model can copy and compare.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Book {
    /// Number of the last stop.
    asked: u64,
    /// The same for each strength.
    last: [u64; 2],
    /// Up to which number the machine has confirmed a stop of at least this strength.
    confirmed: [u64; 2],
    /// Those that somebody waits for.
    open: Vec<Ask>,
    /// An order is being carried out that came after the stop of this number.
    order: Option<u64>,
}

fn strength(urgent: Urgent) -> usize {
    match urgent {
        Urgent::Stop => 0,
        Urgent::EStop => 1,
    }
}

/// The stronger of two stops.
#[must_use]
pub fn stronger(one: Option<Urgent>, other: Option<Urgent>) -> Option<Urgent> {
    match (one, other) {
        (Some(Urgent::EStop), _) | (_, Some(Urgent::EStop)) => Some(Urgent::EStop),
        (one, other) => one.or(other),
    }
}

impl Book {
    /// As [`Stops::ask`].
    pub fn ask(&mut self, urgent: Urgent) -> Ask {
        self.asked += 1;
        let number = self.asked;
        self.last[strength(urgent)] = number;
        let ask = Ask { number, urgent };
        self.open.push(ask);
        ask
    }

    /// As [`Stops::withdraw`].
    pub fn withdraw(&mut self, ask: Ask) {
        self.open.retain(|open| *open != ask);
    }

    /// As [`Stops::asked`].
    #[must_use]
    pub fn asked(&self) -> u64 {
        self.asked
    }

    /// As [`Stops::confirm`].
    pub fn confirm(&mut self, urgent: Urgent, number: u64) {
        // An emergency stop is a stop as well.
        for confirmed in &mut self.confirmed[..=strength(urgent)] {
            *confirmed = number.max(*confirmed);
        }
    }

    /// As [`Stops::is_confirmed`].
    #[must_use]
    pub fn is_confirmed(&self, ask: Ask) -> bool {
        self.confirmed[strength(ask.urgent)] >= ask.number
    }

    /// As [`Stops::unconfirmed`].
    #[must_use]
    pub fn unconfirmed(&self) -> Option<Urgent> {
        let open = self.open.iter().filter(|ask| !self.is_confirmed(**ask));
        open.fold(None, |all, ask| stronger(all, Some(ask.urgent)))
    }

    /// As [`Stops::since`].
    #[must_use]
    pub fn since(&self, number: u64) -> Option<Urgent> {
        [Urgent::EStop, Urgent::Stop]
            .into_iter()
            .find(|urgent| self.last[strength(*urgent)] > number)
    }

    /// As [`Stops::begin_order`] and [`Stops::end_order`].
    pub fn order(&mut self, number: Option<u64>) {
        self.order = number;
    }

    /// As [`Stops::wanted`].
    #[must_use]
    pub fn wanted(&self) -> Option<Urgent> {
        let during = self.order.and_then(|number| self.since(number));
        stronger(self.unconfirmed(), during)
    }
}

impl Stops {
    // Nobody panics while holding it; if somebody did, a stop would have to go out all the same.
    fn book(&self) -> MutexGuard<'_, Book> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Somebody wants a stop, and waits for its confirmation until [`Stops::withdraw`].
    pub fn ask(&self, urgent: Urgent) -> Ask {
        self.book().ask(urgent)
    }

    /// Nobody waits for this stop any more. Others that wait for theirs still do.
    pub fn withdraw(&self, ask: Ask) {
        self.book().withdraw(ask);
    }

    /// Number of the last stop: an order that comes now is newer than that, and older than the next.
    #[must_use]
    pub fn asked(&self) -> u64 {
        self.book().asked()
    }

    /// The machine has confirmed this stop, which was sent after the stop `number` was asked for.
    pub fn confirm(&self, urgent: Urgent, number: u64) {
        self.book().confirm(urgent, number);
    }

    /// The machine has confirmed a stop that was sent after this one was asked for.
    #[must_use]
    pub fn is_confirmed(&self, ask: Ask) -> bool {
        self.book().is_confirmed(ask)
    }

    /// The strongest stop that somebody waits for and the machine has not confirmed.
    #[must_use]
    pub fn unconfirmed(&self) -> Option<Urgent> {
        self.book().unconfirmed()
    }

    /// The strongest stop that was asked for since the stop `number`, confirmed or not.
    #[must_use]
    pub fn since(&self, number: u64) -> Option<Urgent> {
        self.book().since(number)
    }

    /// From now on an order is carried out that came after the stop `number`: every later one stops it.
    pub fn begin_order(&self, number: u64) {
        self.book().order(Some(number));
    }

    /// The order has ended.
    pub fn end_order(&self) {
        self.book().order(None);
    }

    /// What has to be sent to the machine now.
    #[must_use]
    pub fn wanted(&self) -> Option<Urgent> {
        self.book().wanted()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three presses at a machine that is dead: the second and the third were once told that it stands, because the first
    /// had given up.
    #[test]
    fn a_stop_that_nobody_confirmed_confirms_no_other() {
        let stops = Stops::default();
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
        let stops = Stops::default();
        let early = stops.ask(Urgent::Stop);
        let sent = stops.asked();
        let late = stops.ask(Urgent::Stop);
        stops.confirm(Urgent::Stop, sent);
        assert!(stops.is_confirmed(early) && !stops.is_confirmed(late));
        assert_eq!(stops.unconfirmed(), Some(Urgent::Stop));
        // One that was sent earlier and is answered later takes nothing back.
        stops.confirm(Urgent::Stop, stops.asked());
        stops.confirm(Urgent::Stop, 0);
        assert!(stops.is_confirmed(late));
    }

    #[test]
    fn a_stop_is_no_emergency_stop_but_an_emergency_stop_is_a_stop() {
        let stops = Stops::default();
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
        let stops = Stops::default();
        let (one, other) = (stops.ask(Urgent::EStop), stops.ask(Urgent::Stop));
        stops.withdraw(one);
        assert_eq!(stops.wanted(), Some(Urgent::Stop));
        stops.withdraw(other);
        assert_eq!(stops.wanted(), None);
    }

    #[test]
    fn a_stop_ends_every_older_order_and_no_newer_one() {
        let stops = Stops::default();
        let older = stops.asked();
        let ask = stops.ask(Urgent::EStop);
        stops.confirm(Urgent::EStop, stops.asked());
        stops.withdraw(ask);
        let newer = stops.asked();
        assert_eq!(stops.since(older), Some(Urgent::EStop));
        assert_eq!(stops.since(newer), None);
        assert_eq!(stops.wanted(), None);
        stops.begin_order(older);
        assert_eq!(stops.wanted(), Some(Urgent::EStop));
        stops.end_order();
        stops.begin_order(newer);
        assert_eq!(stops.wanted(), None);
        let _ = stops.ask(Urgent::Stop);
        assert_eq!(stops.wanted(), Some(Urgent::Stop));
    }
}
