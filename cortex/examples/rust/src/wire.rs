//! Frames: the header [H], the keys by which readers attach and resume [A, E], control messages [C].

use std::sync::LazyLock;

use anyhow::{Context, Result, ensure};
use serde_json::Value;

use crate::{body, schema};

pub const HEADER: usize = 64;
pub const BODY_MAX: u64 = 1 << 30;
/// An option of an attach key: it is reliable.
pub const STRICT: u64 = 1 << 1;
/// In `aux` of kind `N`: the end of the stream [E1].
pub const END: u64 = 1;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Header {
    pub kind: u8,
    pub stamped: bool,
    pub source: u64,
    pub fingerprint: u64,
    pub sequence: u64,
    pub stamp_ns: i64,
    pub publish_ns: i64,
    pub size: u64,
    pub aux: u64,
}

pub fn number(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap())
}

impl Header {
    /// The first 16 bytes: what a subscription matches.
    pub fn prefix(&self, kind: u8) -> Vec<u8> {
        [b"CTX", &[kind, 1, self.stamped as u8, HEADER as u8, 0][..], &self.source.to_le_bytes()].concat()
    }

    /// A key of 32 bytes: kind `A` with reader and options, kind `R` with reader and sequence.
    pub fn key(&self, kind: u8, reader: u64, last: u64) -> Vec<u8> {
        [self.prefix(kind), [reader, last].map(u64::to_le_bytes).concat()].concat()
    }

    pub fn pack(&self) -> Vec<u8> {
        let (stamp, publish) = (self.stamp_ns as u64, self.publish_ns as u64);
        let rest = [self.fingerprint, self.sequence, stamp, publish, self.size, self.aux];
        [self.prefix(self.kind), rest.map(u64::to_le_bytes).concat()].concat()
    }

    pub fn parse(frame: &[u8]) -> Result<Header> {
        ensure!(frame.len() >= HEADER, "a frame of {} bytes", frame.len());
        let [source, fingerprint, sequence, stamp, publish, size, aux] =
            [8, 16, 24, 32, 40, 48, 56].map(|at| number(frame, at));
        let (kind, stamped, stamp_ns, publish_ns) = (frame[3], frame[5] == 1, stamp as i64, publish as i64);
        let header = Header { kind, stamped, source, fingerprint, sequence, stamp_ns, publish_ns, size, aux };
        ensure!(frame.starts_with(&header.prefix(kind)), "not a frame of Cortex 1");
        Ok(header)
    }
}

/// Sequence of an answer, and the latched message [A4].
pub fn parse_answer(frame: &[u8]) -> Result<(u64, &[u8])> {
    ensure!(frame.len() >= 64 && frame.len() as u64 - 64 == number(frame, 48), "an answer of {} bytes", frame.len());
    Ok((number(frame, 32), &frame[64..]))
}

/// Fingerprints and schemas of the control messages, by name.
static TYPES: LazyLock<Vec<(u64, Value)>> = LazyLock::new(|| {
    let types: Vec<Value> = serde_json::from_str(include_str!("../../../vectors/types.json")).unwrap();
    let schemas = types.iter().map(|entry| schema::parse(entry["schema"].as_str().unwrap()).unwrap());
    schemas.map(|json| (schema::fingerprint(&json), json)).collect()
});

pub fn pack_control(name: &str, message: &Value) -> Result<Vec<u8>> {
    let is_it = |json: &Value| json["name"] == format!("cortex/{name}");
    let (fingerprint, schema) = TYPES.iter().find(|(_, json)| is_it(json)).context("no such control message")?;
    let body = body::encode(schema, message)?;
    let header = Header { kind: b'C', fingerprint: *fingerprint, size: body.len() as u64, ..Header::default() };
    Ok([header.pack(), body].concat())
}

/// Name and content of a control message.
pub fn parse_control(frame: &[u8]) -> Result<(&'static str, Value)> {
    let header = Header::parse(frame)?;
    ensure!(header.kind == b'C' && header.size as usize == frame.len() - HEADER, "not a control message");
    let (_, schema) = TYPES.iter().find(|(known, _)| *known == header.fingerprint).context("of no known type")?;
    let name = schema["name"].as_str().unwrap_or_default().trim_start_matches("cortex/");
    Ok((name, body::decode(schema, &frame[HEADER..])?))
}
