//! A publisher: its readers, how the reliable ones hold it up, and its end [A, E].

use std::collections::HashMap;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use nix::time::ClockId;
use serde_json::{Value, json};
use zmq::{Context, DONTWAIT, Socket, XPUB};

use crate::body;
use crate::node::{Node, clock_ns};
use crate::schema::Schema;
use crate::wire::{CONFIRMS, CONFIRMS_END, Header, LAST, MARKS_END, number};

const SUBSCRIPTION_MAX: i64 = 1024;
/// The longest that a reader may ask for.
const MAX_WAIT: Duration = Duration::from_secs(60);
const LINGER: Duration = Duration::from_millis(500);
const SILENCE: Duration = Duration::from_millis(100);
const AGAIN: Duration = Duration::from_millis(20);
const PAUSE: Duration = Duration::from_micros(200);

/// What a reader has asked for, and below which sequence it has accounted for everything; none: it has no answer yet.
struct Reader {
    strict: bool,
    wait: Duration,
    confirms: bool,
    /// How many sequences more than there were messages it confirms at the end.
    end: u64,
    confirmed: Option<u64>,
}

pub struct Publisher {
    node: Node,
    lossy: Socket,
    strict: Socket,
    schema: Schema,
    /// What all frames have in common.
    head: Header,
    /// By attach key.
    readers: HashMap<Vec<u8>, Reader>,
    /// The sequence that comes next: how many messages there have been.
    pub next: u64,
    /// Messages that some reliable reader may have lost.
    pub timeouts: u64,
    /// The sequence that a reliable reader must have accounted for before it is in time again.
    late: Option<u64>,
    silent: Instant,
    tell_after: Duration,
}

impl Publisher {
    /// Publish a topic over "ipc" or "tcp".
    pub fn open(context: &Context, topic: &str, schema: Schema, transport: &str) -> Result<Publisher> {
        let mut node = Node::open(context)?;
        let listen = |role| -> Result<(Socket, String)> {
            let socket = context.socket(XPUB)?;
            socket.set_linger(1000)?;
            socket.set_maxmsgsize(SUBSCRIPTION_MAX)?;
            let path = format!("ipc://{}", node.path(role).display());
            socket.bind(if transport == "tcp" { "tcp://127.0.0.1:*" } else { &path })?;
            let bound = socket.get_last_endpoint()?.unwrap_or(path);
            Ok((socket, bound))
        };
        let ((lossy, lossy_address), (mut strict, strict_address)) = (listen("lossy")?, listen("strict")?);
        set_nodrop(&mut strict, true)?;
        let (source, fingerprint, stamped) = (rand::random(), schema.fingerprint(), schema.is_stamped());
        node.announce(
            json!([{"transport": transport, "lossy": lossy_address, "strict": strict_address, "control": "",
                    "server_key": ""}]),
            json!([{"topic": topic, "source": source, "type_name": schema.name, "fingerprint": fingerprint,
                    "schema": schema.to_json(), "latch": false}]),
            json!([]),
        )?;
        let head = Header { source, fingerprint, stamped, ..Header::default() };
        let (readers, silent, tell_after) = (HashMap::new(), Instant::now(), SILENCE);
        Ok(Publisher {
            node,
            lossy,
            strict,
            schema,
            head,
            readers,
            next: 0,
            timeouts: 0,
            late: None,
            silent,
            tell_after,
        })
    }

    /// How many readers count what they lose from here on [E7].
    pub fn subscribers(&self) -> usize {
        self.readers.values().filter(|reader| reader.confirmed.is_some()).count()
    }

    /// Send through the lossy or the strict socket; false if a reliable reader has no room.
    fn send(&self, strict: bool, frame: &[u8]) -> Result<bool> {
        match if strict { &self.strict } else { &self.lossy }.send(frame, DONTWAIT) {
            Err(zmq::Error::EAGAIN) => Ok(false),
            sent => Ok(sent.map(|_| true)?),
        }
    }

    /// Send to those reliable readers that have room. Libzmq passes over the others until they have read.
    fn send_anyway(&mut self, frame: &[u8]) -> Result<()> {
        set_nodrop(&mut self.strict, false)?;
        self.send(true, frame)?;
        set_nodrop(&mut self.strict, true)
    }

    /// The longest that readers of the strict socket wait; of those that have not confirmed a sequence.
    fn longest_wait(&self, below: u64) -> Duration {
        let waits = self.readers.values().filter(|reader| reader.strict && reader.confirmed < Some(below));
        waits.map(|reader| reader.wait).max().unwrap_or_default()
    }

    /// Send a message; false if a reliable reader may have lost it.
    pub fn publish(&mut self, message: &Value) -> Result<bool> {
        let body = body::encode(&self.schema, message)?;
        let stamp_ns = if self.head.stamped { message["stamp_ns"].as_i64().unwrap_or(0) } else { 0 };
        let (publish_ns, size) = (clock_ns(ClockId::CLOCK_MONOTONIC)?, body.len() as u64);
        let header = Header { kind: b'M', sequence: self.next, stamp_ns, publish_ns, size, ..self.head };
        let (frame, begin) = ([header.pack(), body].concat(), Instant::now());
        while !self.send(true, &frame)? {
            if begin.elapsed() >= self.longest_wait(u64::MAX) {
                self.send_anyway(&frame)?;
                self.late = Some(self.next + 1);
                break;
            }
            thread::sleep(PAUSE);
            self.poll()?;
        }
        self.send(false, &frame)?;
        (self.next, self.silent, self.tell_after) = (self.next + 1, Instant::now(), SILENCE);
        self.timeouts += self.late.is_some() as u64;
        Ok(self.late.is_none())
    }

    /// See who has come and gone, and tell readers after a silence how many messages there were [G2].
    pub fn poll(&mut self) -> Result<()> {
        self.node.poll()?;
        for strict in [false, true] {
            while let Ok(event) = if strict { &self.strict } else { &self.lossy }.recv_bytes(DONTWAIT) {
                self.hear(strict, &event)?;
            }
        }
        if self.next > 0 && self.silent.elapsed() > self.tell_after {
            self.tell_after *= 2;
            self.tell(0)?;
        }
        Ok(())
    }

    fn hear(&mut self, strict: bool, event: &[u8]) -> Result<()> {
        let Some((on, key)) = event.split_first().filter(|(_, key)| key.len() == 32) else { return Ok(()) };
        let (kind, reader, last) = (key[3], number(key, 16), number(key, 24));
        if !key.starts_with(&self.head.prefix(kind)) {
            return Ok(());
        }
        match (kind, on) {
            (b'A', 1) => {
                let (wait, confirms) = (Duration::from_millis(last >> 32).min(MAX_WAIT), last & CONFIRMS != 0);
                let end = (last & CONFIRMS_END != 0) as u64;
                let confirmed = (end == 0).then_some(0);
                self.readers.insert(key.to_vec(), Reader { strict, wait, confirms, end, confirmed });
                let answer = [key, &[self.next, MARKS_END, 0, 0].map(u64::to_le_bytes).concat()].concat();
                if !self.send(strict, &answer)? {
                    self.send_anyway(&answer)?;
                }
            }
            (b'A', _) => drop(self.readers.remove(key)),
            (b'R', 1) => {
                let Some((_, found)) = self.readers.iter_mut().find(|(key, _)| number(key, 16) == reader) else {
                    return Ok(());
                };
                if found.confirmed.is_some() {
                    self.late = self.late.filter(|late| last < *late);
                } // else it confirms its answer, and was not the one that was late [E4]
                found.confirmed = found.confirmed.max(Some(last));
            }
            _ => {}
        }
        Ok(())
    }

    /// Tell readers how many messages there were, or with `LAST` will be; false if a reliable one has no room for it.
    fn tell(&self, aux: u64) -> Result<bool> {
        let publish_ns = clock_ns(ClockId::CLOCK_MONOTONIC)?;
        let frame = Header { kind: b'N', sequence: self.next, publish_ns, aux, ..self.head }.pack();
        self.send(false, &frame)?;
        self.send(true, &frame)
    }

    /// Say that the stream is over [E1], and wait until those that say so have read all of it [E2].
    pub fn close(mut self) -> Result<()> {
        let (begin, mut told, mut again) = (Instant::now(), false, Duration::ZERO);
        let owes = |readers: &HashMap<_, Reader>, next| {
            readers.values().any(|r| r.confirms && r.confirmed < Some(next + r.end))
        };
        while !told || owes(&self.readers, self.next) {
            if begin.elapsed() >= LINGER.max(self.longest_wait(self.next + 1)) {
                break;
            }
            if begin.elapsed() >= again {
                again = begin.elapsed() + AGAIN;
                told = self.tell(LAST)? && self.late.is_none();
            }
            thread::sleep(PAUSE);
            self.poll()?;
        }
        self.node.close()
    }
}

/// Whether a full queue refuses a message instead of dropping it [D4]; this option the crate does not know.
fn set_nodrop(socket: &mut Socket, on: bool) -> Result<()> {
    let (value, option) = (on as i32, zmq_sys::ZMQ_XPUB_NODROP as i32);
    let code = unsafe { zmq_sys::zmq_setsockopt(socket.as_mut_ptr(), option, (&raw const value).cast(), 4) };
    ensure!(code == 0, "libzmq has no ZMQ_XPUB_NODROP");
    Ok(())
}
