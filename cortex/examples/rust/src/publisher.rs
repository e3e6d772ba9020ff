//! A publisher: its readers, how the reliable ones hold it up, and its end [A, E].

use std::collections::HashMap;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use nix::time::ClockId;
use serde_json::{Value, json};
use zmq::{Context, DONTWAIT, Socket, XPUB};

use crate::node::{Node, clock_ns};
use crate::wire::{END, Header, STRICT, number};
use crate::{body, schema};

/// The longest that a reader may ask for [A7], and that we wait at the end for one that asked for less.
const MAX_WAIT_MS: u64 = 60_000;
const LINGER_MS: u64 = 500;
const SILENCE: Duration = Duration::from_millis(100);
const AGAIN: Duration = Duration::from_millis(20);

/// The options of a reader, and below which sequence it has accounted for everything; none: it has no answer yet.
struct Reader {
    options: u64,
    confirmed: Option<u64>,
}

pub struct Publisher {
    node: Node,
    lossy: Socket,
    strict: Socket,
    schema: Value,
    /// What all frames have in common.
    head: Header,
    /// By attach key.
    readers: HashMap<Vec<u8>, Reader>,
    /// The sequence that comes next: how many messages there have been.
    pub next: u64,
    /// Messages that some reliable reader may have lost.
    pub timeouts: u64,
    /// The sequence that a reliable reader must have accounted for before it is in time again.
    lagging: Option<u64>,
    /// When readers are to be told how many messages there were.
    tell_at: Option<Instant>,
}

impl Publisher {
    pub fn open(context: &Context, topic: &str, schema: Value) -> Result<Publisher> {
        let mut node = Node::open(context)?;
        let listen = |role| -> Result<(Socket, String)> {
            let (socket, address) = (context.socket(XPUB)?, format!("ipc://{}", node.path(role).display()));
            socket.set_linger(1000)?;
            socket.set_maxmsgsize(1024)?;
            socket.bind(&address)?;
            Ok((socket, address))
        };
        let ((lossy, lossy_address), (mut strict, strict_address)) = (listen("lossy")?, listen("strict")?);
        set_nodrop(&mut strict, true)?;
        let (source, fingerprint) = (rand::random(), schema::fingerprint(&schema));
        node.announce(
            json!([{"transport": "ipc", "lossy": lossy_address, "strict": strict_address, "control": "",
                    "server_key": ""}]),
            json!([{"topic": topic, "source": source, "type_name": schema["name"], "fingerprint": fingerprint,
                    "schema": schema.to_string(), "latch": false}]),
            json!([]),
        )?;
        let head = Header { source, fingerprint, stamped: schema::is_stamped(&schema), ..Header::default() };
        let (readers, next, timeouts, lagging, tell_at) = (HashMap::new(), 0, 0, None, None);
        Ok(Publisher { node, lossy, strict, schema, head, readers, next, timeouts, lagging, tell_at })
    }

    /// How many readers count what they lose from here on [E7].
    pub fn subscribers(&self) -> usize {
        self.readers.values().filter(|reader| reader.confirmed.is_some()).count()
    }

    /// The longest that reliable readers hold us up [ms], but those that we do not wait for [E4].
    fn wait_ms(&self) -> u64 {
        let strict = self.readers.values().filter(|reader| reader.options & STRICT != 0 && self.lagging.is_none());
        strict.map(|reader| (reader.options >> 32).min(MAX_WAIT_MS)).max().unwrap_or(0)
    }

    /// Send to all, unless a reliable reader has no room in time; false if none of the reliable ones got it.
    fn try_send(&self, frame: &[u8], wait_ms: u64) -> Result<bool> {
        let _ = self.lossy.send(frame, DONTWAIT);
        self.strict.set_sndtimeo(wait_ms as i32)?;
        Ok(self.strict.send(frame, 0).is_ok())
    }

    /// Send to all. Libzmq passes over those reliable readers that have no room in time until they have read: they are lagging.
    fn send(&mut self, frame: &[u8], wait_ms: u64) -> Result<()> {
        if !self.try_send(frame, wait_ms)? {
            set_nodrop(&mut self.strict, false)?;
            self.strict.send(frame, DONTWAIT)?;
            set_nodrop(&mut self.strict, true)?;
            self.lagging = Some(self.next);
        }
        Ok(())
    }

    /// A frame that goes to all, with the time.
    fn frame(&self, header: Header, body: &[u8]) -> Result<Vec<u8>> {
        let (publish_ns, size) = (clock_ns(ClockId::CLOCK_MONOTONIC)?, body.len() as u64);
        Ok([&Header { sequence: self.next, publish_ns, size, ..header }.pack(), body].concat())
    }

    pub fn publish(&mut self, message: &Value) -> Result<()> {
        let stamp_ns = if self.head.stamped { message["stamp_ns"].as_i64().unwrap_or(0) } else { 0 };
        let body = body::encode(&self.schema, message)?;
        let frame = self.frame(Header { kind: b'M', stamp_ns, ..self.head }, &body)?;
        self.next += 1;
        self.send(&frame, self.wait_ms())?;
        self.timeouts += self.lagging.is_some() as u64;
        self.tell_at = Some(Instant::now() + SILENCE);
        Ok(())
    }

    /// See who has come and gone, and tell readers after a silence how many messages there were [G2].
    pub fn poll(&mut self) -> Result<()> {
        self.node.poll()?;
        for strict in [false, true] {
            while let Ok(event) = if strict { &self.strict } else { &self.lossy }.recv_bytes(DONTWAIT) {
                self.hear(&event)?;
            }
        }
        if self.tell_at.is_some_and(|at| at <= Instant::now()) {
            let told = self.tell(0)? && self.lagging.is_none(); // to one that is lagging it may not have come
            self.tell_at = (!told).then(|| Instant::now() + SILENCE);
        }
        Ok(())
    }

    /// Hear that a key was subscribed (1) or unsubscribed.
    fn hear(&mut self, event: &[u8]) -> Result<()> {
        let Some((on, key)) = event.split_first().filter(|(_, key)| key.len() == 32) else { return Ok(()) };
        let (kind, reader, last) = (key[3], number(key, 16), number(key, 24));
        if !key.starts_with(&self.head.prefix(kind)) {
            return Ok(());
        }
        match (kind, on) {
            (b'A', 1) => {
                let confirmed = (last & STRICT == 0).then_some(0);
                self.readers.insert(key.to_vec(), Reader { options: last, confirmed });
                self.send(&[key, &[self.next, 1, 0, 0].map(u64::to_le_bytes).concat()].concat(), 0)?;
            }
            (b'A', _) => drop(self.readers.remove(key)),
            (b'R', 1) => {
                for (_, found) in self.readers.iter_mut().filter(|(key, _)| number(key, 16) == reader) {
                    if found.confirmed.is_some() {
                        self.lagging = self.lagging.filter(|lagging| last < *lagging);
                    } // else it confirms its answer, and was not the one that was lagging [E4]
                    found.confirmed = found.confirmed.max(Some(last));
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Tell readers how many messages there were, or at the end will be; false if a reliable one has no room for it.
    fn tell(&self, aux: u64) -> Result<bool> {
        self.try_send(&self.frame(Header { kind: b'N', aux, ..self.head }, &[])?, 0)
    }

    /// Say that the stream is over [E1], and wait until those that say so have read all of it [E2].
    pub fn close(mut self) -> Result<()> {
        let (begin, wait) = (Instant::now(), Duration::from_millis(self.wait_ms().max(LINGER_MS)));
        while !self.tell(END)? || self.readers.values().any(|reader| reader.confirmed <= Some(self.next)) {
            if begin.elapsed() >= wait {
                break;
            }
            std::thread::sleep(AGAIN);
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
