//! The interface of both machines. This crate is the interface document: what is not here is not on the wire.
//!
//! # Frame
//!
//! ```text
//! +------+------------------------------------------------------------------+------+
//! | 0x00 | COBS( kind u8 | session u8 | seq u16 le | body | CRC-32C u32 le ) | 0x00 |
//! +------+------------------------------------------------------------------+------+
//! ```
//!
//! `body` is [postcard](https://postcard.jamesmunns.com/wire-format) of the type that `kind` names and at most
//! [`frame::MAX_BODY`] bytes. The CRC covers everything before it. A body is exactly one message, and no message is a
//! prefix of another. This catches the one damage that the CRC cannot detect: complement the first byte of the CRC and
//! append 0xFF, and the longer frame passes the check. Both delimiters are sent: the leading one ends any garbage
//! before it, so that the first good frame after a disturbance is never lost.
//!
//! | kind | direction | body | `seq` |
//! |---|---|---|---|
//! | [`frame::Kind::Request`] | host to device | [`table::Request`] | one sequence per session |
//! | [`frame::Kind::Reply`] | device to host | [`table::Reply`] | that of the request |
//! | [`frame::Kind::Urgent`] | host to device | [`system::Urgent`] | chosen by the host, echoed |
//! | [`frame::Kind::Telemetry`] | device to host | [`table::Telemetry`] | counts telemetry frames |
//! | [`frame::Kind::Event`] | device to host | [`system::Event`] | low 16 bits of the event's index |
//!
//! # Session
//!
//! [`system::Hello`] is the only request that is valid without a session. The device answers with its
//! [`system::Identity`] and issues the session number that every other request must carry. A request that is
//! sent again (same session, same `seq`, same body) is answered from a cache and never executed twice.
//! [`system::Urgent`] (stop, emergency stop) needs a good CRC and nothing else.
//!
//! docs/protocol.md has the rules of retries, signs of life and stops. Numbers in a body are postcard's varints; the
//! cache treats a request with a padded varint as a different one.
//!
//! # Compatibility
//!
//! - `Hello`, `Identity` and `Urgent` keep their encoding forever, so that any tool can name any device and stop it.
//! - Enum variants are index-coded: append only, never reorder, never reuse.
//! - [`table::SCHEMA_KEY`] is computed from all message types at compile time. Same major version and same
//!   key: everything works. Otherwise the device only identifies itself, returns its last words and obeys stops
//!   ([`table::Request::needs_match`]).
//! - A change of an existing message raises the major version; an appended row raises the minor version.
#![no_std]
#![forbid(unsafe_code)]

pub mod capsule;
pub mod client;
pub mod error;
pub mod events;
pub mod frame;
pub mod rig;
pub mod session;
pub mod settings;
pub mod system;
pub mod table;

/// The protocol's version; see the compatibility rules in the crate documentation.
pub const VERSION: system::Version = system::Version { major: 4, minor: 0 };
