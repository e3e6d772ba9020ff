//! A subscriber and a publisher of Cortex, written from WIRE.md; "[B3]" in a comment is a rule there. See README.md.

pub mod body;
pub mod node;
pub mod publisher;
pub mod schema;
pub mod subscriber;
pub mod wire;
