//! A subscriber's connection to one publisher: attaching, sequence numbers, what is lost [A, G, E].

use std::sync::mpsc::SyncSender;
use std::thread;
use std::time::Instant;

use crate::json::Json;
use crate::wire::{BODY_MAX, CONFIRMS, CONFIRMS_END, HEADER, Header, LAST, STRICT, key, parse_answer, prefix};
use crate::zmtp::{Message, Writer, connect};
use crate::{Result, ensure, node, schema};

const JUMP_MAX: u64 = 1 << 32;
/// How long a publisher may wait for us, if it likes to.
const TIMEOUT_MS: u64 = 60_000;

#[derive(Default)]
pub struct Counters {
    pub received: u64,
    pub lost: u64,
    pub rejected: u64,
    pub cut_off: u64,
}

/// What comes from a publisher: its source, and a message or the end of the connection.
pub type Event = (u64, Option<Message>);

pub struct Link {
    pub source: u64,
    pub schema: Json,
    pub connected: bool,
    /// When the publisher was seen to have left.
    pub left: Option<Instant>,
    address: String,
    reliable: bool,
    stamped: bool,
    fingerprint: u64,
    reader: u64,
    writer: Option<Writer>,
    expected: Option<u64>,
    /// The publisher has given away all sequences below this.
    reached: u64,
    /// The sequence at which the publisher said that the stream ends.
    ended: Option<u64>,
}

impl Link {
    pub fn new(publisher: &Json, address: &str, reliable: bool) -> Result<Link> {
        let schema = schema::parse(publisher.get("schema").text())?;
        let fingerprint = schema::fingerprint(&schema);
        ensure!(
            fingerprint as i128 == publisher.get("fingerprint").int(),
            "another fingerprint than its schema's [S7]"
        );
        let (source, address) = (publisher.get("source").int() as u64, address.to_string());
        let (stamped, writer, expected) = (schema::is_stamped(&schema), None, None);
        let (connected, left, reader, reached, ended) = (false, None, 0, 0, None);
        Ok(Link {
            source,
            schema,
            connected,
            left,
            address,
            reliable,
            stamped,
            fingerprint,
            reader,
            writer,
            expected,
            reached,
            ended,
        })
    }

    fn attach_key(&self) -> Vec<u8> {
        let options = if self.reliable { TIMEOUT_MS << 32 | STRICT | CONFIRMS | CONFIRMS_END } else { 0 };
        key(b'A', self.stamped, self.source, self.reader, options)
    }

    /// Connect, and attach as a new reader: the prefixes first, then the key [A1].
    pub fn attach(&mut self, events: &SyncSender<Event>) -> std::io::Result<()> {
        let (mut reader, writer) = connect(&self.address, "SUB", BODY_MAX + 4096)?;
        self.reader = node::random();
        let prefixes = b"MNL".map(|kind| prefix(kind, self.stamped, self.source));
        for wanted in prefixes.into_iter().chain([self.attach_key()]) {
            writer.send(&[[vec![1], wanted].concat()])?;
        }
        (self.writer, self.connected) = (Some(writer), true);
        let (source, events) = (self.source, events.clone());
        thread::spawn(move || {
            while reader.receive().is_ok_and(|message| events.send((source, Some(message))).is_ok()) {}
            events.send((source, None))
        });
        Ok(())
    }

    /// Account for messages from a sequence on; false if they were seen before [K2, K3, E3].
    fn advance(&mut self, sequence: u64, count: u64, counters: &mut Counters) -> Result<bool> {
        let expected = self.expected.unwrap_or(sequence);
        ensure!(sequence.saturating_sub(expected) <= JUMP_MAX, "sequence {sequence} after {expected}");
        if sequence < expected {
            return Ok(false);
        }
        self.expected = Some(sequence + count);
        counters.lost += sequence - expected;
        if sequence > expected {
            self.confirm(sequence);
        }
        Ok(true)
    }

    /// Tell the publisher that all below a sequence is accounted for [E3].
    fn confirm(&self, sequence: u64) {
        if let (true, Some(writer)) = (self.reliable, &self.writer) {
            let confirmed = key(b'R', self.stamped, self.source, self.reader, sequence);
            let _ = [1, 0].map(|on| writer.send(&[[&[on], &confirmed[..]].concat()])); // its end is an event
        }
    }

    /// The bodies that a ZeroMQ message brings.
    pub fn take<'a>(&mut self, message: &'a Message, counters: &mut Counters) -> Result<Vec<&'a [u8]>> {
        let frame = &message[0];
        if frame.starts_with(&self.attach_key()) {
            let (next, latched) = parse_answer(frame)?;
            self.reached = self.reached.max(next);
            let known = self.expected.replace(self.expected.unwrap_or(next));
            self.confirm(known.unwrap_or(next));
            if known.is_some() || latched.is_empty() {
                return Ok(vec![]);
            }
            return self.check(latched, &latched[HEADER.min(latched.len())..]).map(|(_, body)| vec![body]);
        }
        if frame.starts_with(&prefix(b'A', self.stamped, self.source)) {
            return Ok(vec![]); // the answer to an earlier attempt [A4]
        }
        ensure!(frame.len() >= HEADER, "a frame of {} bytes", frame.len());
        let is_large = frame.len() == HEADER && frame[3] == b'L';
        ensure!(message.len() == 1 + is_large as usize, "a message of {} frames", message.len());
        let (header, body) =
            self.check(frame, message.last().map_or(&[], |last| &last[if is_large { 0 } else { HEADER }..]))?;
        let bodies = match header.kind {
            b'M' | b'L' => vec![body],
            b'N' if body.is_empty() => vec![],
            kind => return Err(format!("kind {kind}")),
        };
        let is_new = self.advance(header.sequence, bodies.len() as u64, counters)?;
        if is_new && header.kind == b'N' {
            self.ended = if header.aux & LAST != 0 { Some(header.sequence) } else { self.ended };
            self.confirm(header.sequence + (header.aux & LAST));
        }
        Ok(if is_new { bodies } else { vec![] })
    }

    /// A header of this publisher, with the body that it announces [H2, H3, H5].
    fn check<'a>(&self, frame: &[u8], body: &'a [u8]) -> Result<(Header, &'a [u8])> {
        let header = Header::parse(frame)?;
        ensure!((header.source, header.stamped) == (self.source, self.stamped), "of another publisher");
        ensure!(header.fingerprint == self.fingerprint && header.size <= BODY_MAX, "another type, or too large");
        ensure!(body.len() as u64 == header.size, "a body of {} bytes, said {}", body.len(), header.size);
        Ok((header, body))
    }

    /// Whether the publisher has said that nothing follows, or can say nothing any more.
    pub fn is_complete(&self) -> bool {
        !self.connected || self.ended.is_some()
    }

    /// Count what has not come of a publisher that has left [E5].
    pub fn end(&self, counters: &mut Counters) {
        counters.lost += self.expected.map_or(0, |expected| self.reached.saturating_sub(expected));
        counters.cut_off += (self.reliable && self.expected.is_some() && self.ended < self.expected) as u64;
    }
}
