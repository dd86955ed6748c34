//! The stops that clients have sent on a line, and whether the owner has noticed them. Uses neither lock, clock nor
//! thread.

use std::collections::VecDeque;

use protocol::frame::Header;
use protocol::system::Urgent;

/// Stops whose confirmation is still passed on to their client.
const RECENT: usize = 32;

pub(super) struct ClientStop {
    pub(super) client: u64,
    /// The client's own header, for the answer.
    pub(super) header: Header,
    urgent: Urgent,
    /// Sequence number on the line.
    seq: u16,
}

#[derive(Default)]
pub(super) struct StopBook {
    /// Sequence number of the next stop.
    next_seq: u16,
    /// Newest last.
    recent: VecDeque<ClientStop>,
    /// A client has sent a stop that the owner has not noticed.
    pub(super) unnoticed: bool,
    /// The strongest stop since [`StopBook::forget`], from clients or elsewhere.
    strongest: Option<Urgent>,
}

impl StopBook {
    pub(super) fn numbering_from(next_seq: u16) -> Self {
        Self {
            next_seq,
            ..Self::default()
        }
    }

    /// Notes a client's stop and returns its sequence number on the line; a repetition has the same number.
    pub(super) fn send(&mut self, client: u64, header: Header, urgent: Urgent) -> u16 {
        self.unnoticed = true;
        self.strongest = self.strongest.max(Some(urgent));
        let same = |stop: &&ClientStop| {
            (stop.client, stop.header, stop.urgent) == (client, header, urgent)
        };
        if let Some(known) = self.recent.iter().find(same) {
            return known.seq;
        }
        let seq = self.next_seq;
        self.next_seq = seq.wrapping_add(1);
        if self.recent.len() == RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(ClientStop {
            client,
            header,
            urgent,
            seq,
        });
        seq
    }

    /// The stop that the machine confirms with this number.
    pub(super) fn find(&self, seq: u16, urgent: Urgent) -> Option<&ClientStop> {
        (self.recent.iter()).find(|stop| (stop.seq, stop.urgent) == (seq, urgent))
    }

    /// Notes that the owner learns of all stops, and of one from `elsewhere`. Returns the strongest.
    pub(super) fn notice(&mut self, elsewhere: Option<Urgent>) -> Option<Urgent> {
        self.unnoticed = false;
        self.strongest = self.strongest.max(elsewhere);
        self.strongest
    }

    /// Forgets the stops, unless the owner has not noticed one. Returns whether it did.
    pub(super) fn forget(&mut self) -> bool {
        if !self.unnoticed {
            self.strongest = None;
        }
        !self.unnoticed
    }
}
