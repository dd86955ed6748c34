//! A normally closed contact and its faults.

/// How a contact bounces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounce {
    /// How often the contact falls back after each change.
    pub times: u32,
    /// Time between two changes, ns.
    pub apart_ns: u64,
}

/// Delay from a contact's change to the chip's pin, ns [assumed, the least]: the carriage follows its step, and the
/// pull-up charges the wire. An RC on the wire takes longer.
pub const TO_PIN_NS: u64 = 1_000;

/// A contact to ground, at the chip's end of its wire.
#[derive(Clone, Debug)]
pub struct Contact {
    actuated: bool,
    open: bool,
    stuck: Option<bool>,
    /// Pending fault: its instant in ns, and whether it sticks open; `None` ends sticking.
    sticking: Option<(u64, Option<bool>)>,
    bounce: Option<Bounce>,
    /// Pending changes in their order: instant in ns, and whether it opens.
    coming: Vec<(u64, bool)>,
    noise: Option<Noise>,
    /// Its level at the last update, and when it last opened, ns.
    was_open: bool,
    opened_ns: Option<u64>,
}

/// A level that toggles on the wire, whatever the contact does.
#[derive(Clone, Copy, Debug)]
struct Noise {
    half_period_ns: u64,
    next_ns: u64,
    high: bool,
}

impl Contact {
    /// A contact without faults, open when `actuated`.
    #[must_use]
    pub fn new(actuated: bool) -> Self {
        Self {
            actuated,
            open: actuated,
            stuck: None,
            sticking: None,
            bounce: None,
            coming: Vec::new(),
            noise: None,
            was_open: actuated,
            opened_ns: actuated.then_some(0),
        }
    }

    /// Whether it is open now.
    #[must_use]
    pub fn is_open(&self) -> bool {
        let level = self.noise.map_or(self.open, |noise| noise.high);
        self.stuck.unwrap_or(level)
    }

    /// Adds noise on its wire that toggles at this interval, or removes it.
    pub fn set_noise(&mut self, half_period_ns: Option<u64>, at_ns: u64) {
        self.noise = half_period_ns.map(|half_period_ns| Noise {
            half_period_ns,
            next_ns: at_ns + half_period_ns,
            high: !self.open,
        });
    }

    /// Actuates or releases it.
    pub fn actuate(&mut self, actuated: bool, at_ns: u64) {
        if actuated == self.actuated {
            return;
        }
        self.actuated = actuated;
        let at_ns = at_ns + TO_PIN_NS;
        self.coming.retain(|&(at, _)| at < at_ns);
        self.coming.push((at_ns, actuated));
        if let Some(bounce) = self.bounce {
            let changes = (1..=u64::from(2 * bounce.times)).map(|n| {
                let open = if n % 2 == 1 { !actuated } else { actuated };
                (at_ns + n * bounce.apart_ns, open)
            });
            self.coming.extend(changes);
        }
    }

    /// Injects a pulse on its wire: the opposite level for `width_ns`.
    pub fn disturb(&mut self, at_ns: u64, width_ns: u64) {
        let at_ns = at_ns + TO_PIN_NS;
        self.change(at_ns, !self.actuated);
        self.change(at_ns + width_ns, self.actuated);
    }

    /// Inserts a pending change by its instant: it may lie between two of a bounce.
    fn change(&mut self, at_ns: u64, open: bool) {
        let place = self.coming.partition_point(|&(at, _)| at <= at_ns);
        self.coming.insert(place, (at_ns, open));
    }

    /// Sticks it open (a cut wire) or closed (welded), whatever actuates it, or lets it work again.
    pub fn stick(&mut self, open: Option<bool>, at_ns: u64) {
        self.sticking = Some((at_ns + TO_PIN_NS, open));
    }

    /// Makes every change from now on bounce.
    pub fn set_bounce(&mut self, bounce: Option<Bounce>) {
        self.bounce = bounce;
    }

    /// Applies the changes that are due by `now_ns`.
    pub fn advance(&mut self, now_ns: u64) {
        while let Some(noise) = self.noise.as_mut().filter(|noise| noise.next_ns <= now_ns) {
            noise.next_ns += noise.half_period_ns;
            noise.high = !noise.high;
        }
        if let Some((_, stuck)) = self.sticking.take_if(|(at, _)| *at <= now_ns) {
            self.stuck = stuck;
        }
        while let Some(&(at, open)) = self.coming.first() {
            if at > now_ns {
                break;
            }
            self.open = open;
            self.coming.remove(0);
        }
        let open = self.is_open();
        if !std::mem::replace(&mut self.was_open, open) && open {
            self.opened_ns = Some(now_ns);
        }
    }

    /// When it last opened, ns.
    #[must_use]
    pub fn opened_ns(&self) -> Option<u64> {
        self.opened_ns
    }

    /// Whether it has been open for longer than `ns` at `at_ns`.
    #[must_use]
    pub fn is_open_for(&self, ns: u64, at_ns: u64) -> bool {
        self.is_open() && self.opened_ns.is_some_and(|opened| at_ns > opened + ns)
    }

    /// When its next pending change is due, ns.
    #[must_use]
    pub fn next_ns(&self) -> Option<u64> {
        let coming = self.coming.first().map(|&(at, _)| at);
        let sticking = self.sticking.map(|(at, _)| at);
        let noise = self.noise.map(|noise| noise.next_ns);
        coming.into_iter().chain(sticking).chain(noise).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_and_a_disturbance_reach_the_pin_later() {
        let mut contact = Contact::new(false);
        contact.actuate(true, 100);
        contact.advance(100 + TO_PIN_NS - 1);
        assert!(!contact.is_open());
        contact.advance(100 + TO_PIN_NS);
        assert!(contact.is_open());
        contact.disturb(5_000, 300);
        assert_eq!(contact.next_ns(), Some(5_000 + TO_PIN_NS));
        contact.advance(5_000 + TO_PIN_NS);
        assert!(!contact.is_open());
        contact.advance(5_300 + TO_PIN_NS);
        assert!(contact.is_open());
    }

    #[test]
    fn a_bouncing_contact_settles_as_it_is_actuated() {
        let mut contact = Contact::new(false);
        contact.set_bounce(Some(Bounce {
            times: 2,
            apart_ns: 10,
        }));
        contact.actuate(true, 100);
        let mut seen = vec![contact.is_open()];
        while let Some(at) = contact.next_ns() {
            contact.advance(at);
            seen.push(contact.is_open());
        }
        assert_eq!(seen, [false, true, false, true, false, true]);
    }

    #[test]
    fn a_disturbance_within_a_bounce_comes_in_its_order() {
        let mut contact = Contact::new(false);
        contact.set_bounce(Some(Bounce {
            times: 1,
            apart_ns: 1_000,
        }));
        contact.actuate(true, 0);
        contact.disturb(300, 200);
        let mut seen = Vec::new();
        while let Some(at) = contact.next_ns() {
            contact.advance(at);
            seen.push((at - TO_PIN_NS, contact.is_open()));
        }
        let expected = [
            (0, true),
            (300, false),
            (500, true),
            (1_000, false),
            (2_000, true),
        ];
        assert_eq!(seen, expected);
    }

    #[test]
    fn a_stuck_contact_does_not_change_and_recovers() {
        let mut contact = Contact::new(false);
        contact.stick(Some(false), 3);
        contact.actuate(true, 5);
        contact.advance(5 + TO_PIN_NS);
        assert!(!contact.is_open());
        contact.stick(None, 9_000);
        assert_eq!(contact.next_ns(), Some(9_000 + TO_PIN_NS));
        contact.advance(9_000 + TO_PIN_NS);
        assert!(contact.is_open());
        assert_eq!(contact.next_ns(), None);
    }
}
