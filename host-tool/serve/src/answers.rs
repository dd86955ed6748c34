//! Answers to requests.

use axum::body::Body;
use axum::http::StatusCode;
use axum::http::header::{CONNECTION, CONTENT_TYPE, HeaderValue};
use axum::response::Response;
use operations::failure::{self, Failure};
use serde_json::{Value, json};

/// An answer that comes instead of what was asked for.
pub type Instead = Box<Response>;

/// The connection ends with this answer: whoever is refused keeps no place.
pub fn closing(mut response: Response) -> Response {
    let headers = response.headers_mut();
    headers.insert(CONNECTION, HeaderValue::from_static("close"));
    response
}

/// An answer with this status.
pub fn answer(status: StatusCode, value: &Value) -> Response {
    let mut response = Response::new(Body::from(format!("{value}\n")));
    *response.status_mut() = status;
    let json = HeaderValue::from_static("application/json");
    response.headers_mut().insert(CONTENT_TYPE, json);
    response
}

/// The answer to a request that was carried out.
pub fn good(mut value: Value) -> Response {
    if let Some(object) = value.as_object_mut() {
        object.insert("ok".to_owned(), Value::Bool(true));
    }
    answer(StatusCode::OK, &value)
}

/// The answer to a request that cannot be one.
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

/// The same, in place of a value.
pub fn boxed(status: StatusCode, why: &str, help: &str) -> Instead {
    Box::new(bad(status, why, help))
}

/// The status of an answer that tells a failure with this exit code.
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

/// The answer that tells a failure.
pub fn failed(failure: &Failure) -> Response {
    answer(status(failure.exit_code()), &failure.json())
}
