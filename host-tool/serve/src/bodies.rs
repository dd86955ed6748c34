//! Reads the body of a request, within limits of size and time.

use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, StatusCode};
use client::pairs::Pairs;
use client::{limited, wording};
use serde_json::{Map, Value};
use tokio::time::timeout;

use crate::answers::{Instead, refused};

pub const LONGEST_BODY: usize = 16 * 1024;
/// Time limit for receiving a body.
const BODY: Duration = Duration::from_secs(5);

/// Reads a body that is a JSON object or empty.
pub async fn object(headers: &HeaderMap, body: Body) -> Result<Map<String, Value>, Instead> {
    let bytes = match timeout(BODY, to_bytes(body, LONGEST_BODY)).await {
        Ok(Ok(bytes)) => bytes,
        Ok(Err(_)) => {
            return Err(refused(
                StatusCode::PAYLOAD_TOO_LARGE,
                "the body is longer than 16 KiB, or was cut off; nothing was done",
                "send less",
            ));
        }
        Err(_) => {
            return Err(refused(
                StatusCode::REQUEST_TIMEOUT,
                "the body did not come within 5 s; nothing was done",
                "send it at once",
            ));
        }
    };
    let bytes = limited::utf8(&bytes).map_err(|why| {
        let why = format!("the body cannot be read: {why}; nothing was done");
        refused(StatusCode::BAD_REQUEST, &why, "send it as UTF-8")
    })?;
    if bytes.iter().all(u8::is_ascii_whitespace) {
        return Ok(Map::new());
    }
    let kind = headers
        .get(CONTENT_TYPE)
        .and_then(|value| value.to_str().ok())
        .unwrap_or_default();
    let kind = kind.split(';').next().unwrap_or_default().trim();
    if !kind.eq_ignore_ascii_case("application/json") {
        return Err(refused(
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "the body is not said to be JSON; nothing was done",
            "send `Content-Type: application/json`",
        ));
    }
    fields(bytes).map_err(|why| {
        let why = format!("the body cannot be read: {why}; nothing was done");
        refused(
            StatusCode::BAD_REQUEST,
            &why,
            "send for example {\"cycles\": 5}",
        )
    })
}

/// The fields of a JSON object, or why there are none.
pub fn fields(bytes: &[u8]) -> Result<Map<String, Value>, String> {
    let pairs: Pairs = serde_json::from_slice(bytes).map_err(|why| wording::unreadable(&why))?;
    pairs
        .once()
        .map_err(|name| format!("{name} is there twice"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::response::IntoResponse;

    #[test]
    fn a_byte_order_mark_is_skipped_and_utf_16_is_named() {
        let mut headers = HeaderMap::new();
        headers.insert(CONTENT_TYPE, "application/json".parse().expect("a type"));
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_time().build().expect("a runtime");
        let read = |bytes: &'static [u8]| runtime.block_on(object(&headers, Body::from(bytes)));
        let cycles = read(b"\xEF\xBB\xBF{\"cycles\": 5}").expect("JSON");
        assert_eq!(cycles["cycles"], 5);
        assert!(read(b"\xEF\xBB\xBF").expect("empty").is_empty());
        let refused = read(b"\xFF\xFE{\0}\0").expect_err("no UTF-8");
        let answer = to_bytes(refused.into_response().into_body(), LONGEST_BODY);
        let answer = runtime.block_on(answer).expect("in memory");
        let said = String::from_utf8_lossy(&answer);
        assert!(said.contains("UTF-16"), "{said}");
    }
}
