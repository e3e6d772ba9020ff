//! A subscriber and a publisher of Cortex, written from WIRE.md; "[B3]" in a comment is a rule there. Everything goes
//! through sockets: of what the specification leaves open there is no shared memory, CURVE, service or control ROUTER.

pub mod body;
pub mod json;
pub mod link;
pub mod node;
pub mod publisher;
pub mod schema;
pub mod wire;
pub mod zmtp;

pub type Result<T> = std::result::Result<T, String>;

/// Return an error with a text unless a condition holds.
#[macro_export]
macro_rules! ensure {
    ($condition:expr, $($text:tt)*) => { if !$condition { return Err(format!($($text)*)); } };
}
