//! A node: where nodes of a host meet [D], its record, and the registry that knows the others [C].

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use nix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};
use zmq::{Context, DEALER, DONTWAIT, Socket};

use crate::schema;
use crate::wire::{pack_control, parse_control};

const LEASE: Duration = Duration::from_secs(1);
const HEARTBEAT: Duration = Duration::from_millis(250);
const ANSWER: Duration = Duration::from_millis(300);

pub fn clock_ns(clock: ClockId) -> Result<i64> {
    let time = clock_gettime(clock)?;
    Ok(time.tv_sec() * 1_000_000_000 + time.tv_nsec())
}

pub struct Node {
    id: u64,
    pub host: String,
    /// Records of the other nodes, and how often they have changed.
    pub others: BTreeMap<u64, Value>,
    pub changes: u64,
    directory: PathBuf,
    lock: File,
    registry: Socket,
    record: Value,
    /// What the registry has told: its state, all nodes that it knows, and when it named them.
    state: (u64, u64),
    named: BTreeSet<u64>,
    since: Option<Instant>,
    /// When we last said Hello, if there is no answer yet, and when Heartbeat.
    asked: Option<Instant>,
    beat: Instant,
}

impl Node {
    /// A node that nobody knows yet, in the folder that a registry has made [D1].
    pub fn open(context: &Context) -> Result<Node> {
        let (id, user) = (rand::random(), fs::metadata("/proc/self")?.uid());
        let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        let is_ours =
            |path: &PathBuf| fs::symlink_metadata(path).is_ok_and(|found| found.is_dir() && found.uid() == user);
        let session = variable("XDG_RUNTIME_DIR").filter(is_ours).map(|path| path.join("cortex"));
        let base = variable("CORTEX_RUNTIME_DIR").or(session).unwrap_or_else(|| format!("/tmp/cortex-{user}").into());
        let directory = base.join(std::env::var("CORTEX_DOMAIN").unwrap_or("0".into()));
        for path in [&base, &directory] {
            let found = fs::symlink_metadata(path).with_context(|| format!("no registry in {}", path.display()))?;
            ensure!(is_ours(path) && found.mode() & 0o077 == 0, "{} is not private", path.display());
        }
        let (boot, space) =
            (fs::read_to_string("/proc/sys/kernel/random/boot_id")?, fs::read_link("/proc/self/ns/pid")?);
        let (found, boot, space) = (fs::metadata(&base)?, boot.trim(), space.display());
        let host =
            hex::encode(schema::hash(format!("{boot}\n{space}\n{user}\n{}:{}", found.dev(), found.ino()).as_bytes())); // [D5]
        let path = directory.join(format!("{id:016x}.lock"));
        let lock = loop {
            let file = File::options().write(true).create(true).truncate(false).mode(0o600).open(&path)?;
            file.lock()?;
            if fs::metadata(&path).is_ok_and(|found| file.metadata().is_ok_and(|own| own.ino() == found.ino())) {
                break file; // [D3]
            }
        };
        let registry = context.socket(DEALER)?;
        registry.set_linger(1000)?;
        registry.set_maxmsgsize(17 << 20)?;
        registry.set_immediate(true)?; // nothing is queued while there is no registry
        registry.set_reconnect_ivl(20)?;
        registry.connect(&format!("ipc://{}", directory.join("registry").display()))?;
        let (others, named, record, beat) = (BTreeMap::new(), BTreeSet::new(), Value::Null, Instant::now());
        let (changes, state, since, asked) = (0, (0, 0), None, None);
        Ok(Node { id, host, others, changes, directory, lock, registry, record, state, named, since, asked, beat })
    }

    pub fn path(&self, role: &str) -> PathBuf {
        self.directory.join(format!("{:016x}.{role}", self.id))
    }

    /// Tell the registry of this node, and learn of the others, from now on.
    pub fn announce(&mut self, endpoints: Value, publishers: Value, subscribers: Value) -> Result<()> {
        let offset_ns = clock_ns(ClockId::CLOCK_REALTIME)? - clock_ns(ClockId::CLOCK_MONOTONIC)?;
        self.record = json!({
            "node": self.id, "name": "rust", "host": self.host, "pid": std::process::id(), "revision": 1,
            "clock_offset_ns": offset_ns, "endpoints": endpoints, "publishers": publishers,
            "subscribers": subscribers, "services": [],
        });
        self.hello()
    }

    fn send(&self, name: &str, message: &Value) -> Result<()> {
        let _ = self.registry.send(pack_control(name, message)?, DONTWAIT); // refused while there is no registry
        Ok(())
    }

    fn hello(&mut self) -> Result<()> {
        self.asked = Some(Instant::now());
        self.send("Hello", &json!({"snapshot": true, "record": self.record}))
    }

    /// Hear the registry, and say what is due; to be called all the time.
    pub fn poll(&mut self) -> Result<()> {
        while let Ok(frame) = self.registry.recv_bytes(DONTWAIT) {
            if let Ok((name, message)) = parse_control(&frame) {
                self.hear(name, &message)?;
            }
        }
        if self.since.is_some_and(|since| since.elapsed() > LEASE) {
            let before = self.others.len(); // [C5]
            self.others.retain(|node, _| self.named.contains(node));
            self.changes += (self.others.len() < before) as u64;
        }
        if self.beat.elapsed() > HEARTBEAT {
            self.beat = Instant::now();
            self.send("Heartbeat", &json!({"node": self.id, "revision": 1, "held": 0}))?;
        }
        if self.asked.is_some_and(|since| since.elapsed() > ANSWER) { self.hello() } else { Ok(()) }
    }

    fn hear(&mut self, name: &str, message: &Value) -> Result<()> {
        let number = |name: &str| message[name].as_u64().unwrap_or(0);
        let state = (number("epoch"), number("version"));
        match name {
            "Welcome" => {
                (self.state, self.since, self.asked) = (state, Some(Instant::now()), None);
                self.named = serde_json::from_value(message["nodes"].clone())?;
            }
            "Changed" | "Gone" => {
                self.state.1 += (state.1 == self.state.1 + 1) as u64; // [C2]
                self.changes += 1;
                if let Some(node) = message["record"]["node"].as_u64() {
                    self.named.insert(node);
                    self.others.insert(node, message["record"].clone());
                } else {
                    self.named.remove(&number("node"));
                    self.others.remove(&number("node"));
                }
            }
            "Alive" if self.asked.is_none() => {
                let is_known = |node: &u64| *node == self.id || self.others.contains_key(node);
                if self.state != state || number("held") != 1 || !self.named.iter().all(is_known) {
                    self.hello()?; // [C4]
                }
            }
            "Refused" => eprintln!("the registry refuses this node: {}", message["reason"]),
            _ => {}
        }
        Ok(())
    }

    /// Leave, and remove the node's files, the lock last.
    pub fn close(&self) -> Result<()> {
        for role in ["lossy", "strict", "lock"] {
            let _ = fs::remove_file(self.path(role)); // a subscriber has a lock only
        }
        self.lock.unlock()?;
        self.send("Leave", &json!({"node": self.id}))
    }
}
