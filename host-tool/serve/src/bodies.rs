//! Reads the body of a request, within limits of size and time.

use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::http::header::CONTENT_TYPE;
use axum::http::{HeaderMap, StatusCode};
use client::wording;
use serde_json::{Map, Value};
use tokio::time::timeout;

use crate::answers::{Instead, refused};

/// Maximum length of a body, bytes.
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
    match serde_json::from_slice(&bytes) {
        Ok(Value::Object(object)) => Ok(object),
        Ok(_) => Err(refused(
            StatusCode::BAD_REQUEST,
            "the body is no JSON object; nothing was done",
            "send for example {\"cycles\": 5}",
        )),
        Err(why) => Err(refused(
            StatusCode::BAD_REQUEST,
            &format!(
                "the body cannot be read: {}; nothing was done",
                wording::unreadable(&why)
            ),
            "send for example {\"cycles\": 5}",
        )),
    }
}
