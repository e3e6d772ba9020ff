//! A publisher: its readers, each with a bounded queue, and how the reliable ones hold it up [A, E].

use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::json::Json;
use crate::node::{monotonic_ns, random};
use crate::wire::{CONFIRMS, CONFIRMS_END, Header, LAST, number};
use crate::zmtp::{Message, Reader, Writer};
use crate::{Result, body, schema};

const QUEUE: usize = 1000;
/// In the answer: the end of the stream will be said.
const MARKS_END: u64 = 1;
const INLINE_MAX: usize = 16_384;
/// The longest that a reader may ask for.
const MAX_WAIT: Duration = Duration::from_secs(60);
const LINGER: Duration = Duration::from_millis(500);
const SILENCE: Duration = Duration::from_millis(100);
const PAUSE: Duration = Duration::from_micros(200);

/// What a peer has asked for.
#[derive(Default)]
struct Wishes {
    prefixes: Vec<Vec<u8>>,
    reader: u64,
    wait: Duration,
    confirms: bool,
    confirms_end: bool,
    confirmed: u64,
    /// Whether it has its answer, as far as it says so: from then on it counts what it loses [E7].
    counts: bool,
    /// The sequence that it must have accounted for before it is waited for again; 0: it is in time.
    lagging: u64,
}

/// One connection to an XPUB socket.
struct Peer {
    strict: bool,
    queue: SyncSender<Arc<Message>>,
    wishes: Mutex<Wishes>,
}

impl Peer {
    /// Queue a message if it was subscribed to; false if a reliable reader has lost it.
    fn push(&self, message: &Arc<Message>, sequence: u64) -> bool {
        let begin = Instant::now();
        loop {
            let mut wishes = self.wishes.lock().unwrap();
            let matches = wishes.prefixes.iter().any(|prefix| message[0].starts_with(prefix));
            if !matches || !matches!(self.queue.try_send(message.clone()), Err(TrySendError::Full(_))) {
                return true;
            }
            if !self.strict || wishes.lagging > 0 || begin.elapsed() >= wishes.wait {
                wishes.lagging = if wishes.lagging > 0 { wishes.lagging } else { sequence + 1 };
                return !self.strict;
            }
            drop(wishes);
            thread::sleep(PAUSE);
        }
    }
}

pub struct Publisher {
    pub schema: Json,
    pub source: u64,
    fingerprint: u64,
    /// The sequence that comes next, when the last message was sent, and how many messages were told of.
    next: Mutex<(u64, Instant, u64)>,
    peers: Mutex<Vec<Arc<Peer>>>,
}

impl Publisher {
    pub fn new(schema: Json) -> Publisher {
        let (fingerprint, next) = (schema::fingerprint(&schema), Mutex::new((0, Instant::now(), 0)));
        Publisher { schema, source: random(), fingerprint, next, peers: Mutex::default() }
    }

    /// Serve a peer of the lossy or the strict socket until it goes.
    pub fn serve(&self, strict: bool, mut reader: Reader, writer: Writer) {
        let (queue, messages) = sync_channel::<Arc<Message>>(QUEUE);
        let peer = Arc::new(Peer { strict, queue, wishes: Mutex::default() });
        self.peers.lock().unwrap().push(peer.clone());
        thread::spawn(move || messages.iter().all(|message| writer.send(&message).is_ok()));
        while let Ok(message) = reader.receive() {
            if let Some((on, key)) = message[0].split_first() {
                self.subscribe(&peer, *on == 1, key);
            }
        }
        self.peers.lock().unwrap().retain(|other| !Arc::ptr_eq(other, &peer));
    }

    fn subscribe(&self, peer: &Peer, on: bool, key: &[u8]) {
        let ours = key.len() == 32 && number(key, 8) == self.source;
        match (if ours { key[3] } else { 0 }, on) {
            (b'A', true) => {
                let next = self.next.lock().unwrap(); // nothing is published meanwhile
                let (mut wishes, options) = (peer.wishes.lock().unwrap(), number(key, 24));
                wishes.wait = Duration::from_millis(options >> 32).min(MAX_WAIT);
                (wishes.reader, wishes.confirms) = (number(key, 16), options & CONFIRMS != 0);
                wishes.confirms_end = options & CONFIRMS_END != 0;
                wishes.counts = !wishes.confirms_end;
                wishes.prefixes.push(key.to_vec());
                drop(wishes);
                let rest = [next.0, MARKS_END, 0, 0].map(u64::to_le_bytes).concat();
                peer.push(&Arc::new(vec![[key, &rest].concat()]), next.0);
            }
            (b'R', true) => {
                let (mut wishes, sequence) = (peer.wishes.lock().unwrap(), number(key, 24));
                (wishes.confirmed, wishes.counts) = (wishes.confirmed.max(sequence), true);
                wishes.lagging = if sequence >= wishes.lagging { 0 } else { wishes.lagging };
            }
            (_, true) => peer.wishes.lock().unwrap().prefixes.push(key.to_vec()),
            (kind, false) => {
                let mut wishes = peer.wishes.lock().unwrap();
                (wishes.reader, wishes.counts) = if kind == b'A' { (0, false) } else { (wishes.reader, wishes.counts) };
                let found = wishes.prefixes.iter().position(|prefix| prefix == key);
                found.map(|index| wishes.prefixes.swap_remove(index));
            }
        }
    }

    pub fn readers(&self) -> usize {
        self.peers.lock().unwrap().iter().filter(|peer| peer.wishes.lock().unwrap().counts).count()
    }

    fn push(&self, message: Message, sequence: u64) -> bool {
        let (message, peers) = (Arc::new(message), self.peers.lock().unwrap().clone());
        peers.iter().map(|peer| peer.push(&message, sequence)).fold(true, |all, one| all & one)
    }

    fn header(&self, kind: u8, sequence: u64) -> Header {
        let (source, fingerprint, stamped) = (self.source, self.fingerprint, schema::is_stamped(&self.schema));
        Header { kind, stamped, source, fingerprint, sequence, publish_ns: monotonic_ns(), ..Header::default() }
    }

    /// Send a message; false if a reliable reader has lost it.
    pub fn publish(&self, message: &Json) -> Result<bool> {
        let body = body::encode(&self.schema, message)?;
        let mut next = self.next.lock().unwrap();
        let mut header = self.header(if body.len() > INLINE_MAX { b'L' } else { b'M' }, next.0);
        header.stamp_ns = if header.stamped { message.get("stamp_ns").int() as i64 } else { 0 };
        header.size = body.len() as u64;
        (next.0, next.1) = (next.0 + 1, Instant::now());
        let frames = if header.kind == b'L' { vec![header.pack(), body] } else { vec![[header.pack(), body].concat()] };
        Ok(self.push(frames, header.sequence))
    }

    /// Which sequence comes next, or that none does, and the readers to whom that is to be sent.
    fn news(&self, next: u64, aux: u64) -> (Arc<Message>, Vec<Arc<Peer>>) {
        let peers = self.peers.lock().unwrap().clone();
        let readers = peers.into_iter().filter(|peer| peer.wishes.lock().unwrap().reader != 0).collect();
        (Arc::new(vec![Header { aux, ..self.header(b'N', next) }.pack()]), readers)
    }

    /// Tell readers after a silence how many messages there have been [G2]; to be called now and then.
    pub fn tell(&self) {
        let mut next = self.next.lock().unwrap();
        if next.1.elapsed() > SILENCE && next.2 != next.0 {
            let (news, readers) = self.news(next.0, 0);
            let told = readers.iter().all(|peer| peer.queue.try_send(news.clone()).is_ok());
            next.2 = if told { next.0 } else { next.2 };
        }
    }

    /// Say that the stream is over [E1], and wait until reliable readers have confirmed all of it [E2].
    pub fn close(&self) {
        let (next, begin) = (self.next.lock().unwrap().0, Instant::now());
        let (last, mut untold) = self.news(next, LAST);
        loop {
            untold.retain(|peer| matches!(peer.queue.try_send(last.clone()), Err(TrySendError::Full(_))));
            let owes = |peer: &Arc<Peer>| {
                let wishes = peer.wishes.lock().unwrap();
                let needed = next + wishes.confirms_end as u64;
                wishes.confirms && wishes.confirmed < needed && begin.elapsed() < wishes.wait
            };
            let written = untold.is_empty() && Arc::strong_count(&last) == 1; // else it waits in some queue
            if (written || begin.elapsed() > LINGER) && !self.peers.lock().unwrap().iter().any(owes) {
                return;
            }
            thread::sleep(PAUSE);
        }
    }
}
