//! A subscriber: its links to publishers, each with attaching, sequence numbers and what is lost [A, G, E].

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use serde_json::{Value, json};
use zmq::{Context, DONTWAIT, POLLIN, SUB, Socket};

use crate::node::Node;
use crate::wire::{BODY_MAX, END, HEADER, Header, STRICT, number, parse_answer};
use crate::{body, schema};

const JUMP_MAX: u64 = 1 << 32;
/// How long a publisher may wait for us, if it likes to.
const TIMEOUT_MS: u64 = 60_000;
/// How long a publisher that has left may still have something in flight.
const LEAVING: Duration = Duration::from_secs(2);
/// Messages that are read from one publisher before it is another one's turn.
const TURN: usize = 100;

#[derive(Default)]
pub struct Counters {
    pub received: u64,
    pub lost: u64,
    pub rejected: u64,
    pub cut_off: u64,
}

/// The connection to one publisher.
pub struct Link {
    socket: Socket,
    schema: Value,
    /// What all frames of the publisher have in common.
    head: Header,
    reliable: bool,
    /// The attach key, with our number as its reader.
    key: Vec<u8>,
    expected: Option<u64>,
    /// The publisher has given away all sequences below this.
    reached: u64,
    /// The sequence at which the publisher said that the stream ends.
    end: Option<u64>,
    /// When the publisher was seen to have left.
    left: Option<Instant>,
}

impl Link {
    /// Connect and attach: the prefixes first, then the key [A1]. Libzmq connects again where that is lost.
    pub fn open(context: &Context, publisher: &Value, address: &str, reliable: bool) -> Result<Link> {
        let schema = schema::parse(publisher["schema"].as_str().unwrap_or(""))?;
        let (fingerprint, stamped) = (schema::fingerprint(&schema), schema::is_stamped(&schema));
        ensure!(publisher["fingerprint"] == fingerprint, "another fingerprint than its schema's [S7]");
        let source = publisher["source"].as_u64().unwrap_or(0);
        let head = Header { source, fingerprint, stamped, ..Header::default() };
        let options = if reliable { TIMEOUT_MS << 32 | STRICT } else { 0 };
        let (socket, key) = (context.socket(SUB)?, head.key(b'A', rand::random(), options));
        socket.set_maxmsgsize(BODY_MAX as i64 + 4096)?;
        socket.connect(address)?;
        for wanted in [head.prefix(b'M'), head.prefix(b'N'), head.prefix(b'L'), key.clone()] {
            socket.set_subscribe(&wanted)?;
        }
        let (expected, reached, end, left) = (None, 0, None, None);
        Ok(Link { socket, schema, head, reliable, key, expected, reached, end, left })
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
        if sequence > expected && self.reliable {
            self.confirm(sequence)?;
        }
        Ok(true)
    }

    /// Tell the publisher that all below a sequence is accounted for [E3].
    fn confirm(&self, sequence: u64) -> Result<()> {
        let confirmed = self.head.key(b'R', number(&self.key, 16), sequence);
        self.socket.set_subscribe(&confirmed)?;
        Ok(self.socket.set_unsubscribe(&confirmed)?)
    }

    /// The body that a ZeroMQ message brings, if any.
    pub fn take(&mut self, frames: &[Vec<u8>], counters: &mut Counters) -> Result<Option<Vec<u8>>> {
        let frame = &frames[0];
        if frame.starts_with(&self.key) {
            let (next, latched) = parse_answer(frame)?;
            self.reached = self.reached.max(next);
            let known = self.expected.replace(self.expected.unwrap_or(next));
            if self.reliable {
                self.confirm(known.unwrap_or(next))?;
            }
            if known.is_some() || latched.is_empty() {
                return Ok(None);
            }
            let body = latched.get(HEADER..).unwrap_or_default();
            return self.check(latched, body).map(|_| Some(body.to_vec()));
        }
        if frame.starts_with(&self.head.prefix(b'A')) {
            return Ok(None); // the answer to another reader [A4]
        }
        let body = match frames {
            [frame, body] if frame.len() == HEADER && frame[3] == b'L' => body,
            [frame] if frame.len() >= HEADER && frame[3] != b'L' => &frame[HEADER..],
            _ => bail!("{} frames of {} bytes and more", frames.len(), frame.len()),
        };
        let header = self.check(frame, body)?;
        let count = match header.kind {
            b'M' | b'L' => 1,
            b'N' if body.is_empty() => 0,
            kind => bail!("kind {kind}"),
        };
        let is_new = self.advance(header.sequence, count, counters)?;
        if is_new && count == 0 {
            self.end = (header.aux & END != 0).then_some(header.sequence).or(self.end);
            self.confirm(header.sequence + (header.aux & END))?;
        }
        Ok((is_new && count == 1).then(|| body.to_vec()))
    }

    /// A header of this publisher, with the body that it announces [H2, H3, H5].
    fn check(&self, frame: &[u8], body: &[u8]) -> Result<Header> {
        let header = Header::parse(frame)?;
        let same = Header { fingerprint: self.head.fingerprint, kind: header.kind, ..self.head };
        ensure!(
            frame.starts_with(&same.pack()[..24]) && header.size <= BODY_MAX,
            "another publisher, type, or too large"
        );
        ensure!(body.len() as u64 == header.size, "a body of {} bytes, said {}", body.len(), header.size);
        Ok(header)
    }

    /// Whether nothing more comes of a publisher; what has not come of it is counted then [E5, E6].
    fn is_over(&self, counters: &mut Counters) -> bool {
        if self.left.is_none_or(|since| self.end.is_none() && since.elapsed() < LEAVING) {
            return false;
        }
        counters.lost += self.expected.map_or(0, |expected| self.reached.saturating_sub(expected));
        counters.cut_off += (self.reliable && self.end < self.expected) as u64;
        true
    }
}

pub struct Subscriber {
    context: Context,
    node: Node,
    topic: String,
    reliable: bool,
    /// By source.
    links: BTreeMap<u64, Link>,
    changes: u64,
    pub counters: Counters,
    /// Whether publishers were there, and all have left.
    pub ended: bool,
}

impl Subscriber {
    pub fn open(context: &Context, topic: &str, reliable: bool) -> Result<Subscriber> {
        let mut node = Node::open(context)?;
        let policy = if reliable { "reliable" } else { "lossy" };
        node.announce(
            json!([]),
            json!([]),
            json!([{"topic": topic, "type_name": "", "fingerprint": 0, "policy": policy}]),
        )?;
        let (context, topic, links, counters) = (context.clone(), topic.into(), BTreeMap::new(), Counters::default());
        Ok(Subscriber { context, node, topic, reliable, links, changes: 0, counters, ended: false })
    }

    /// Connect to publishers of this host [C8] that have come, and note which have left.
    fn meet(&mut self) -> Result<()> {
        self.links.values_mut().for_each(|link| link.left = link.left.or(Some(Instant::now())));
        for node in self.node.others.values().filter(|node| node["host"] == self.node.host) {
            let endpoints = node["endpoints"].as_array().into_iter().flatten();
            let Some(local) = endpoints.into_iter().find(|each| each["transport"] == "ipc") else { continue };
            let address = local[if self.reliable { "strict" } else { "lossy" }].as_str().unwrap_or("");
            for publisher in node["publishers"].as_array().into_iter().flatten() {
                let source = publisher["source"].as_u64().unwrap_or(0);
                if let Some(link) = self.links.get_mut(&source) {
                    link.left = None;
                } else if publisher["topic"] == self.topic {
                    self.links.insert(source, Link::open(&self.context, publisher, address, self.reliable)?);
                }
            }
        }
        Ok(())
    }

    /// Wait for messages, but not for long; to be called all the time.
    pub fn poll(&mut self, timeout_ms: i64) -> Result<Vec<Value>> {
        self.node.poll()?;
        if self.changes != self.node.changes {
            self.changes = self.node.changes;
            self.meet()?;
        }
        let mut sockets: Vec<_> = self.links.values().map(|link| link.socket.as_poll_item(POLLIN)).collect();
        zmq::poll(&mut sockets, timeout_ms)?;
        let mut messages = vec![];
        for link in self.links.values_mut() {
            for _ in 0..TURN {
                let Ok(frames) = link.socket.recv_multipart(DONTWAIT) else { break };
                let body = link.take(&frames, &mut self.counters);
                match body.and_then(|body| body.map(|body| body::decode(&link.schema, &body)).transpose()) {
                    Ok(message) => messages.extend(message),
                    Err(error) => {
                        eprintln!("{}: rejected: {error:#}", self.topic);
                        self.counters.rejected += 1;
                    }
                }
            }
        }
        self.counters.received += messages.len() as u64;
        let before = self.links.len();
        self.links.retain(|_, link| !link.is_over(&mut self.counters));
        self.ended |= self.links.len() < before && self.links.is_empty();
        Ok(messages)
    }

    pub fn close(self) -> Result<()> {
        self.node.close()
    }
}
