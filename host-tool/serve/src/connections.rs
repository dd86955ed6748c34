//! Limits the connections, and decides which one to drop when there are too many. A stop always finds a place.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::task::AbortHandle;

/// Maximum connections from this computer, and from elsewhere. Separate limits: remote clients cannot block a local
/// stop.
const MOST: [usize; 2] = [256, 128];

/// Further connections, on which only stops are answered.
const FOR_STOPS: usize = 64;

/// State of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Doing {
    /// Idle: waiting for its first or next request.
    Nothing,
    /// Serving a reader of the stream, who may have stopped reading.
    Following,
    /// Answering a request.
    Answering,
}

/// Kinds of room; each has its own limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Room {
    Here,
    Elsewhere,
    /// Connections that may only stop.
    Stop,
}

#[derive(Debug)]
struct Entry {
    number: u64,
    room: Room,
    doing: Doing,
    end: Option<AbortHandle>,
}

#[derive(Debug, Default)]
struct Table {
    next: u64,
    /// Ordered by last activity, least recent first.
    entries: Vec<Entry>,
}

/// All open connections.
#[derive(Debug, Default)]
pub struct Connections(Mutex<Table>);

/// The place of one connection; freed when dropped.
#[derive(Debug)]
pub struct Place {
    all: Arc<Connections>,
    number: u64,
    /// Beyond the limit: only stops are answered.
    pub is_for_stops: bool,
}

impl Table {
    fn count(&self, room: Room) -> usize {
        let of = self.entries.iter().filter(|entry| entry.room == room);
        of.count()
    }

    /// Drops the connection that has been idle longest; false if all are busy.
    fn make_room(&mut self, room: Room) -> bool {
        let found = [Doing::Nothing, Doing::Following].iter().find_map(|doing| {
            self.entries
                .iter()
                .position(|entry| entry.room == room && entry.doing == *doing)
        });
        if let Some(index) = found
            && let Some(end) = self.entries.remove(index).end
        {
            end.abort();
        }
        found.is_some()
    }

    fn enter(&mut self, here: bool) -> Option<(u64, bool)> {
        let room = if here { Room::Here } else { Room::Elsewhere };
        let rooms = [(room, MOST[usize::from(!here)]), (Room::Stop, FOR_STOPS)];
        let (room, _) = rooms
            .into_iter()
            .find(|(room, most)| self.count(*room) < *most || self.make_room(*room))?;
        let number = self.next;
        self.next += 1;
        self.entries.push(Entry {
            number,
            room,
            doing: Doing::Nothing,
            end: None,
        });
        Some((number, room == Room::Stop))
    }
}

impl Connections {
    // No code panics while holding the lock; if it did, a stop still has to find a place.
    fn table(&self) -> MutexGuard<'_, Table> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a place for one more connection. `None` if even the places for stops are full.
    pub fn enter(self: &Arc<Self>, here: bool) -> Option<Place> {
        let (number, is_for_stops) = self.table().enter(here)?;
        Some(Place {
            all: Arc::clone(self),
            number,
            is_for_stops,
        })
    }

    /// Registers how to abort this connection when its place is needed.
    pub fn ended_by(&self, number: u64, end: AbortHandle) {
        let mut table = self.table();
        let entry = table
            .entries
            .iter_mut()
            .find(|entry| entry.number == number);
        if let Some(entry) = entry {
            entry.end = Some(end);
        }
    }
}

impl Place {
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Sets the state of this connection.
    pub fn does(&self, doing: Doing) {
        let mut table = self.all.table();
        let found = table
            .entries
            .iter()
            .position(|entry| entry.number == self.number);
        if let Some(index) = found {
            let entry = table.entries.remove(index);
            table.entries.push(Entry { doing, ..entry });
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let number = self.number;
        self.all
            .table()
            .entries
            .retain(|entry| entry.number != number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn enter(all: &Arc<Connections>, here: bool, count: usize) -> Vec<Place> {
        let places: Vec<_> = (0..count).filter_map(|_| all.enter(here)).collect();
        assert_eq!(places.len(), count);
        places
    }

    fn is_there(place: &Place) -> bool {
        let table = place.all.table();
        let mut numbers = table.entries.iter().map(|entry| entry.number);
        numbers.any(|number| number == place.number)
    }

    #[test]
    fn the_one_that_has_been_idle_for_longest_goes() {
        let all = Arc::default();
        let places = enter(&all, true, MOST[0]);
        places[0].does(Doing::Answering);
        places[1].does(Doing::Following);
        places[2].does(Doing::Answering);
        places[2].does(Doing::Nothing);
        let more = enter(&all, true, MOST[0] - 3);
        assert!(
            more.iter()
                .all(|place| !place.is_for_stops && is_there(place))
        );
        let left: Vec<_> = (0..MOST[0])
            .filter(|index| is_there(&places[*index]))
            .collect();
        assert_eq!(left, [0, 1, 2]);
        // When no idle connection is left, a reader is dropped.
        for place in &more {
            place.does(Doing::Answering);
        }
        let last = enter(&all, true, 1);
        last[0].does(Doing::Answering);
        assert!(is_there(&places[1]) && !is_there(&places[2]));
        let _reader_goes = enter(&all, true, 1);
        assert!(is_there(&places[0]) && !is_there(&places[1]));
    }

    #[test]
    fn a_stop_finds_a_place_while_all_others_are_at_work() {
        let all = Arc::default();
        let busy = enter(&all, true, MOST[0]);
        for place in &busy {
            place.does(Doing::Answering);
        }
        let stops = enter(&all, true, 3 * FOR_STOPS);
        assert!(stops.iter().all(|place| place.is_for_stops));
        assert_eq!(
            stops.iter().filter(|place| is_there(place)).count(),
            FOR_STOPS
        );
        assert!(is_there(&stops[3 * FOR_STOPS - 1]));
        // Connections from elsewhere have their own limit.
        assert!(
            enter(&all, false, 1)
                .iter()
                .all(|place| !place.is_for_stops)
        );
        drop(busy);
        assert!(enter(&all, true, 1).iter().all(|place| !place.is_for_stops));
    }

    #[test]
    fn the_connection_whose_place_is_needed_is_ended_and_no_other() {
        let runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = { runtime }.build().expect("a runtime");
        let all: Arc<Connections> = Arc::default();
        let places = enter(&all, true, MOST[0]);
        let tasks: Vec<_> = (places.iter())
            .map(|place| {
                let task = runtime.spawn(std::future::pending::<()>());
                all.ended_by(place.number(), task.abort_handle());
                task
            })
            .collect();
        places[0].does(Doing::Answering);
        let more = enter(&all, true, 1);
        assert!(is_there(&more[0]) && !is_there(&places[1]));
        runtime.block_on(tokio::task::yield_now());
        for (number, task) in tasks.iter().enumerate() {
            assert_eq!(task.is_finished(), number == 1, "{number}");
        }
    }

    #[test]
    fn a_place_that_is_left_is_free_and_the_others_stay() {
        let all: Arc<Connections> = Arc::default();
        let mut places = enter(&all, true, 3);
        drop(places.remove(1));
        assert!(places.iter().all(is_there));
        assert_eq!(all.table().entries.len(), 2);
    }
}
