//! Sends server-sent events to all readers, from a ring of fixed size. A reader that is too slow loses the oldest
//! events and is told how many.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::body::{Body, Bytes};
use futures_util::stream::unfold;
use protocol::system::DeviceKind;
use serde_json::{Value, json};
use tokio::sync::broadcast::error::RecvError;
use tokio::sync::{broadcast, watch};
use tokio::time::timeout;

/// Messages in the ring: about 5 s of both machines.
pub const RING: usize = 256;

/// Maximum readers.
pub const READERS: usize = 100;

/// Send a keep-alive to a reader after this time without a message.
const SIGN_OF_LIFE: Duration = Duration::from_secs(10);

/// Counts of everything sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Told {
    rig_samples: u64,
    capsule_samples: u64,
    messages: u64,
}

impl Told {
    fn samples(&mut self, machine: DeviceKind) -> &mut u64 {
        match machine {
            DeviceKind::Rig => &mut self.rig_samples,
            DeviceKind::Capsule => &mut self.capsule_samples,
        }
    }
}

#[derive(Clone, Debug)]
struct Message {
    /// Counts before this message.
    before: Told,
    /// Counts including this message.
    after: Told,
    text: Bytes,
}

/// The ring of messages.
#[derive(Debug)]
pub struct Stream {
    told: Mutex<Told>,
    ring: broadcast::Sender<Arc<Message>>,
    readers: Mutex<usize>,
    /// Set when the server shuts down.
    closed: watch::Sender<bool>,
}

impl Default for Stream {
    fn default() -> Self {
        Self {
            told: Mutex::default(),
            ring: broadcast::Sender::new(RING),
            readers: Mutex::new(0),
            closed: watch::Sender::new(false),
        }
    }
}

impl Stream {
    /// Whether there are readers.
    pub fn is_read(&self) -> bool {
        self.ring.receiver_count() > 0
    }

    /// Sends an event to all readers without waiting for any.
    pub fn tell(&self, event: &str, data: &Value) {
        self.send(event, data, None);
    }

    /// Sends telemetry samples; they are counted, so that a reader learns how many it lost.
    pub fn tell_samples(&self, machine: DeviceKind, samples: Vec<Value>) {
        let event = client::identity::kind_name(machine);
        self.send(event, &Value::Array(samples), Some(machine));
    }

    fn send(&self, event: &str, data: &Value, samples: Option<DeviceKind>) {
        let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        let before = *told;
        told.messages += 1;
        let text = match samples {
            None => format!("event: {event}\ndata: {data}\n\n"),
            Some(machine) => {
                let first = *told.samples(machine);
                *told.samples(machine) += data.as_array().map_or(0, |all| all.len() as u64);
                format!("event: {event}\ndata: {{\"first\":{first},\"samples\":{data}}}\n\n")
            }
        };
        let message = Message {
            before,
            after: *told,
            text: text.into(),
        };
        // Send before the next message is numbered, to keep the order. It is no error if there are no readers.
        let _ = self.ring.send(Arc::new(message));
    }

    /// Disconnects all readers.
    pub fn close(&self) {
        let _ = self.closed.send(true);
    }

    /// A response body that lasts until its reader leaves; `first` makes its first event. `None` if there are too many
    /// readers.
    pub fn body(self: &Arc<Self>, first: impl FnOnce() -> Value) -> Option<Body> {
        let place = Place::take(self)?;
        let told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        let (ring, seen) = (self.ring.subscribe(), *told);
        drop(told);
        // Listen first: what happens while the first event is made comes after it.
        let first = first();
        let reader = Reader {
            ring,
            seen,
            greeting: Some(format!("event: state\ndata: {first}\n\n").into()),
            held: None,
            closed: self.closed.subscribe(),
            _place: place,
        };
        Some(Body::from_stream(unfold(reader, |mut reader| async {
            let text = reader.next().await?;
            Some((Ok::<_, Infallible>(text), reader))
        })))
    }
}

/// A reader's place within [`READERS`].
struct Place(Arc<Stream>);

impl Place {
    fn take(stream: &Arc<Stream>) -> Option<Self> {
        let mut readers = stream
            .readers
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if *readers == READERS {
            return None;
        }
        *readers += 1;
        Some(Self(Arc::clone(stream)))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        *self
            .0
            .readers
            .lock()
            .unwrap_or_else(PoisonError::into_inner) -= 1;
    }
}

struct Reader {
    ring: broadcast::Receiver<Arc<Message>>,
    /// Counts of what the reader has received or was told it lost.
    seen: Told,
    greeting: Option<Bytes>,
    /// The message that follows the lost ones.
    held: Option<Arc<Message>>,
    closed: watch::Receiver<bool>,
    _place: Place,
}

impl Reader {
    /// The next text for this reader; `None` when the server shuts down.
    async fn next(&mut self) -> Option<Bytes> {
        if let Some(greeting) = self.greeting.take() {
            return Some(greeting);
        }
        loop {
            let message = match self.held.take() {
                Some(message) => message,
                None => match timeout(SIGN_OF_LIFE, self.receive()).await {
                    Ok(Some(message)) => message,
                    Ok(None) => return None,
                    Err(_) => return Some(Bytes::from_static(b":\n\n")),
                },
            };
            // Sent before this reader connected.
            if message.after.messages <= self.seen.messages {
                continue;
            }
            if message.before != self.seen {
                let (before, seen) = (message.before, self.seen);
                let lost = json!({
                    "rig_samples": before.rig_samples - seen.rig_samples,
                    "capsule_samples": before.capsule_samples - seen.capsule_samples,
                    "messages": before.messages - seen.messages,
                });
                self.seen = before;
                self.held = Some(message);
                return Some(format!("event: lost\ndata: {lost}\n\n").into());
            }
            self.seen = message.after;
            return Some(message.text.clone());
        }
    }

    async fn receive(&mut self) -> Option<Arc<Message>> {
        let Self { ring, closed, .. } = self;
        let received = async {
            loop {
                match ring.recv().await {
                    Ok(message) => return Some(message),
                    // The counts of the next message tell how many were lost.
                    Err(RecvError::Lagged(_)) => {}
                    Err(RecvError::Closed) => return None,
                }
            }
        };
        let ended = async {
            let _ = closed.wait_for(|closed| *closed).await;
            None
        };
        let (received, ended) = (std::pin::pin!(received), std::pin::pin!(ended));
        futures_util::future::select(received, ended)
            .await
            .factor_first()
            .0
    }
}

#[cfg(test)]
mod tests {
    use axum::body::HttpBody as _;

    use super::*;

    /// Reads the texts that are available.
    async fn read(body: &mut Body, count: usize) -> Vec<String> {
        let mut all = vec![];
        for _ in 0..count {
            let next =
                std::future::poll_fn(|context| std::pin::Pin::new(&mut *body).poll_frame(context));
            let frame = next.await.expect("more").expect("whole");
            let bytes = frame.into_data().expect("data");
            all.push(String::from_utf8(bytes.to_vec()).expect("UTF-8"));
        }
        all
    }

    fn run(test: impl Future) {
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_time().build().expect("a runtime");
        runtime.block_on(test);
    }

    #[test]
    fn a_reader_that_keeps_up_gets_everything_in_order() {
        run(async {
            let stream = Arc::<Stream>::default();
            stream.tell_samples(DeviceKind::Rig, vec![json!(0)]);
            let mut body = stream.body(|| json!({})).expect("a place");
            stream.tell_samples(DeviceKind::Rig, vec![json!(1), json!(2)]);
            stream.tell("event", &json!("e"));
            stream.tell_samples(DeviceKind::Capsule, vec![json!(3)]);
            assert_eq!(
                read(&mut body, 4).await,
                [
                    "event: state\ndata: {}\n\n",
                    "event: rig\ndata: {\"first\":1,\"samples\":[1,2]}\n\n",
                    "event: event\ndata: \"e\"\n\n",
                    "event: capsule\ndata: {\"first\":0,\"samples\":[3]}\n\n",
                ]
            );
        });
    }

    /// It is neither in the state nor counted as lost otherwise.
    #[test]
    fn what_happens_while_the_state_is_made_comes_after_it() {
        run(async {
            let stream = Arc::<Stream>::default();
            let first = || {
                stream.tell("event", &json!("between"));
                json!({})
            };
            let mut body = stream.body(first).expect("a place");
            let texts = read(&mut body, 2).await;
            assert_eq!(texts[1], "event: event\ndata: \"between\"\n\n");
        });
    }

    #[test]
    fn a_slow_reader_is_told_exactly_what_it_has_lost_and_holds_nobody_up() {
        run(async {
            let stream = Arc::<Stream>::default();
            let mut body = stream.body(|| json!({})).expect("a place");
            let all = RING as u64 + 100;
            for number in 0..all {
                let machine = [DeviceKind::Rig, DeviceKind::Capsule][number as usize % 2];
                stream.tell_samples(machine, vec![json!(number), json!(number)]);
            }
            let texts = read(&mut body, 3).await;
            assert_eq!(
                texts[1],
                "event: lost\ndata: {\"rig_samples\":100,\"capsule_samples\":100,\"messages\":100}\n\n"
            );
            assert_eq!(
                texts[2],
                "event: rig\ndata: {\"first\":100,\"samples\":[100,100]}\n\n"
            );
            // The remaining messages follow, without further loss.
            let rest = read(&mut body, RING - 1).await;
            assert!(rest.iter().all(|text| !text.contains("lost")));
        });
    }

    #[test]
    fn readers_are_bounded_and_places_come_back() {
        let stream = Arc::<Stream>::default();
        let bodies: Vec<_> = (0..READERS).map(|_| stream.body(|| json!({}))).collect();
        assert!(bodies.iter().all(Option::is_some));
        assert!(stream.body(|| json!({})).is_none());
        drop(bodies);
        assert!(stream.body(|| json!({})).is_some());
        assert!(!stream.is_read());
    }

    #[test]
    fn a_place_that_comes_back_is_one_place() {
        let stream = Arc::<Stream>::default();
        let mut bodies: Vec<_> = (0..READERS).map(|_| stream.body(|| json!({}))).collect();
        drop(bodies.pop());
        bodies.push(stream.body(|| json!({})));
        assert!(bodies.iter().all(Option::is_some));
        assert!(stream.body(|| json!({})).is_none() && stream.is_read());
    }

    #[test]
    fn a_reader_ends_with_the_server() {
        run(async {
            let stream = Arc::<Stream>::default();
            let mut body = stream.body(|| json!({})).expect("a place");
            let _greeting = read(&mut body, 1).await;
            stream.close();
            let next =
                std::future::poll_fn(|context| std::pin::Pin::new(&mut body).poll_frame(context));
            assert!(next.await.is_none());
        });
    }
}
