//! Frames: the header [H], the keys by which readers attach and resume [A, E], control messages [C].

use std::sync::LazyLock;

use crate::body::{decode, encode};
use crate::json::Json;
use crate::{Result, ensure, schema};

pub const HEADER: usize = 64;
pub const BODY_MAX: u64 = 1 << 30;
pub const STRICT: u64 = 1 << 1;
pub const CONFIRMS: u64 = 1 << 2;
pub const CONFIRMS_END: u64 = 1 << 3;
/// In `aux` of kind `N`: the stream ends here [E1].
pub const LAST: u64 = 1;

#[derive(Clone, Copy, Default)]
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

/// The first 16 bytes of a header: what a subscription matches.
pub fn prefix(kind: u8, stamped: bool, source: u64) -> Vec<u8> {
    [b"CTX", &[kind, 1, stamped as u8, HEADER as u8, 0][..], &source.to_le_bytes()].concat()
}

/// A key of 32 bytes: kind `A` with reader and options, kind `R` with reader and sequence.
pub fn key(kind: u8, stamped: bool, source: u64, reader: u64, last: u64) -> Vec<u8> {
    [prefix(kind, stamped, source), [reader, last].map(u64::to_le_bytes).concat()].concat()
}

pub fn number(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap())
}

impl Header {
    pub fn pack(&self) -> Vec<u8> {
        let (stamp, publish) = (self.stamp_ns as u64, self.publish_ns as u64);
        let rest = [self.fingerprint, self.sequence, stamp, publish, self.size, self.aux];
        [prefix(self.kind, self.stamped, self.source), rest.map(u64::to_le_bytes).concat()].concat()
    }

    pub fn parse(frame: &[u8]) -> Result<Header> {
        ensure!(frame.len() >= HEADER, "a frame of {} bytes", frame.len());
        let (kind, stamped, source) = (frame[3], frame[5] == 1, number(frame, 8));
        ensure!(frame[..16] == prefix(kind, stamped, source), "not a frame of Cortex 1");
        let [fingerprint, sequence, stamp, publish, size, aux] = [16, 24, 32, 40, 48, 56].map(|at| number(frame, at));
        let (stamp_ns, publish_ns) = (stamp as i64, publish as i64);
        Ok(Header { kind, stamped, source, fingerprint, sequence, stamp_ns, publish_ns, size, aux })
    }
}

/// Sequence and latched message of an answer [A4].
pub fn parse_answer(frame: &[u8]) -> Result<(u64, &[u8])> {
    ensure!(frame.len() >= 64, "an answer of {} bytes", frame.len());
    let (sequence, latched) = (number(frame, 32), number(frame, 48));
    ensure!(frame.len() as u64 == 64 + latched.min(BODY_MAX), "an answer: {latched}");
    Ok((sequence, &frame[64..]))
}

/// Schemas and fingerprints of the control messages.
static TYPES: LazyLock<Vec<(u64, Json)>> = LazyLock::new(|| {
    let types = Json::parse(include_str!("../../../vectors/types.json")).unwrap();
    let schemas = types.items().iter().map(|entry| schema::parse(entry.get("schema").text()).unwrap());
    schemas.map(|schema| (schema::fingerprint(&schema), schema)).collect()
});

pub fn pack_control(name: &str, message: &Json) -> Result<Vec<u8>> {
    let found = TYPES.iter().find(|(_, schema)| schema.get("name").text() == format!("cortex/{name}"));
    let (fingerprint, schema) = found.ok_or("no such control message")?;
    let body = encode(schema, message)?;
    let header = Header { kind: b'C', fingerprint: *fingerprint, size: body.len() as u64, ..Header::default() };
    Ok([header.pack(), body].concat())
}

/// Name and content of a control message.
pub fn parse_control(frame: &[u8]) -> Result<(&'static str, Json)> {
    let header = Header::parse(frame)?;
    ensure!(header.kind == b'C' && header.size as usize == frame.len() - HEADER, "not a control message");
    let (_, schema) = TYPES.iter().find(|(known, _)| *known == header.fingerprint).ok_or("of no known type")?;
    Ok((schema.get("name").text().trim_start_matches("cortex/"), decode(schema, &frame[HEADER..])?))
}
