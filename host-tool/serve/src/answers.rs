//! Builds the answers to requests.

use axum::body::Body;
use axum::http::StatusCode;
use axum::http::header::{CONNECTION, CONTENT_TYPE, HeaderValue};
use axum::response::{IntoResponse, Response};
use lab::operations::failure::{self, Failure};
use serde_json::{Value, json};

/// A refusal, returned in place of a response.
#[derive(Debug)]
pub struct Instead(Box<Response>);

impl From<Response> for Instead {
    fn from(response: Response) -> Self {
        Self(Box::new(response))
    }
}

impl From<Failure> for Instead {
    fn from(failure: Failure) -> Self {
        failed(&failure).into()
    }
}

impl IntoResponse for Instead {
    fn into_response(self) -> Response {
        *self.0
    }
}

/// Closes the connection after this response, so that a refused client does not occupy it.
pub fn closing(mut response: Response) -> Response {
    let headers = response.headers_mut();
    headers.insert(CONNECTION, HeaderValue::from_static("close"));
    response
}

/// A response of this content type.
pub fn typed(kind: &'static str, body: impl Into<Body>) -> Response {
    let mut response = Response::new(body.into());
    let kind = HeaderValue::from_static(kind);
    response.headers_mut().insert(CONTENT_TYPE, kind);
    response
}

/// A response with this status and JSON body.
pub fn answer(status: StatusCode, value: &Value) -> Response {
    let mut response = typed("application/json", format!("{value}\n"));
    *response.status_mut() = status;
    response
}

/// The response to a successful request.
pub fn good(mut value: Value) -> Response {
    if let Some(object) = value.as_object_mut() {
        object.insert("ok".to_owned(), Value::Bool(true));
    }
    answer(StatusCode::OK, &value)
}

pub fn bad(status: StatusCode, why: &str, help: &str) -> Response {
    let code = if status == StatusCode::UNAUTHORIZED || status == StatusCode::FORBIDDEN {
        "retrograde::denied"
    } else {
        "retrograde::request"
    };
    let value = json!({
        "ok": false,
        "exit_code": failure::USAGE,
        "error": { "code": code, "message": why, "help": help },
    });
    answer(status, &value)
}

/// As [`bad`], for use as an error.
pub fn refused(status: StatusCode, why: &str, help: &str) -> Instead {
    bad(status, why, help).into()
}

/// HTTP status for a failure with this exit code.
pub fn status(exit_code: u8) -> StatusCode {
    match exit_code {
        failure::DONE => StatusCode::OK,
        failure::USAGE => StatusCode::BAD_REQUEST,
        failure::REFUSED | failure::FAULT | failure::STOPPED => StatusCode::CONFLICT,
        failure::NO_DEVICE => StatusCode::SERVICE_UNAVAILABLE,
        failure::MISMATCH | failure::NOT_DELIVERED => StatusCode::BAD_GATEWAY,
        failure::UNKNOWN => StatusCode::GATEWAY_TIMEOUT,
        _ => StatusCode::INTERNAL_SERVER_ERROR,
    }
}

/// The response that reports a failure.
pub fn failed(failure: &Failure) -> Response {
    answer(status(failure.exit_code()), &failure.json())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exit_code_has_a_status_of_its_own_kind() {
        for (code, expected) in [
            (failure::DONE, 200),
            (failure::USAGE, 400),
            (failure::REFUSED, 409),
            (failure::FAULT, 409),
            (failure::STOPPED, 409),
            (failure::NO_DEVICE, 503),
            (failure::MISMATCH, 502),
            (failure::NOT_DELIVERED, 502),
            (failure::UNKNOWN, 504),
            (u8::MAX, 500),
        ] {
            assert_eq!(status(code).as_u16(), expected, "{code}");
        }
    }
}
