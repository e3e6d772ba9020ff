//! A publisher and a subscriber of Cortex, written from WIRE.md; rules in brackets are of that page.

pub mod body;
pub mod node;
pub mod publisher;
pub mod schema;
pub mod subscriber;
pub mod wire;
