//! Sends server-sent events to all readers. A reader that is too slow loses the oldest and receives their number.

use std::convert::Infallible;
use std::future::ready;

use axum::body::{Body, Bytes};
use futures_util::StreamExt;
use futures_util::stream::{once, unfold};
use serde_json::{Value, json};
use tokio::sync::broadcast::Sender;
use tokio::sync::broadcast::error::RecvError;

/// Messages kept for a slow reader: about 5 s of both machines.
const KEPT: usize = 256;

/// The messages to all readers; an empty one is the last.
#[derive(Debug)]
pub struct Stream(Sender<Bytes>);

impl Default for Stream {
    fn default() -> Self {
        Self(Sender::new(KEPT))
    }
}

fn message(event: &str, data: &Value) -> Bytes {
    format!("event: {event}\ndata: {data}\n\n").into()
}

impl Stream {
    /// Whether there are readers.
    pub fn is_read(&self) -> bool {
        self.0.receiver_count() > 0
    }

    /// Sends an event to all readers without waiting.
    pub fn tell(&self, event: &str, data: &Value) {
        // An error means that there are no readers.
        let _ = self.0.send(message(event, data));
    }

    pub fn close(&self) {
        let _ = self.0.send(Bytes::new());
    }

    /// A response body that lasts until its reader disconnects; `first` returns its first event.
    pub fn body(&self, first: impl FnOnce() -> Value) -> Body {
        // Subscribe first, so that events during `first` come after it.
        let messages = self.0.subscribe();
        let first = message("state", &first());
        let rest = unfold(messages, |mut messages| async {
            let text = match messages.recv().await {
                Ok(text) => text,
                Err(RecvError::Lagged(lost)) => message("lost", &json!({ "messages": lost })),
                Err(RecvError::Closed) => return None,
            };
            (!text.is_empty()).then_some((text, messages))
        });
        Body::from_stream(once(ready(first)).chain(rest).map(Ok::<_, Infallible>))
    }
}

#[cfg(test)]
mod tests {
    use axum::body::HttpBody as _;
    use tokio::runtime::Builder;

    use super::*;

    /// The next text; none if the stream has ended.
    fn next(body: &mut Body) -> Option<String> {
        let runtime = Builder::new_current_thread().build().expect("a runtime");
        let frame = runtime.block_on(std::future::poll_fn(|context| {
            std::pin::Pin::new(&mut *body).poll_frame(context)
        }));
        let bytes = frame?.expect("whole").into_data().expect("data");
        Some(String::from_utf8(bytes.to_vec()).expect("UTF-8"))
    }

    #[test]
    fn a_reader_that_keeps_up_gets_everything_after_the_state_and_in_order() {
        let stream = Stream::default();
        stream.tell("event", &json!("before"));
        let mut body = stream.body(|| {
            stream.tell("event", &json!("while the state is made"));
            json!({})
        });
        stream.tell("rig", &json!([1, 2]));
        stream.close();
        for expected in [
            "event: state\ndata: {}\n\n",
            "event: event\ndata: \"while the state is made\"\n\n",
            "event: rig\ndata: [1,2]\n\n",
        ] {
            assert_eq!(next(&mut body).as_deref(), Some(expected));
        }
        assert_eq!(next(&mut body), None, "the server has ended");
    }

    #[test]
    fn a_slow_reader_is_told_what_it_has_lost_and_holds_nobody_up() {
        let stream = Stream::default();
        let mut body = stream.body(|| json!({}));
        for number in 0..KEPT + 100 {
            stream.tell("rig", &json!(number));
        }
        assert!(next(&mut body).is_some());
        let lost = next(&mut body);
        assert_eq!(
            lost.as_deref(),
            Some("event: lost\ndata: {\"messages\":100}\n\n")
        );
        for number in 100..KEPT + 100 {
            let expected = format!("event: rig\ndata: {number}\n\n");
            assert_eq!(next(&mut body), Some(expected));
        }
        assert!(stream.is_read());
        drop(body);
        assert!(!stream.is_read());
    }
}
