//! A node: where nodes of a host meet [D], its record, and the registry that knows the others [C].

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use nix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};
use zmq::{Context, DEALER, DONTWAIT, Socket};

use crate::schema;
use crate::wire::{HEADER, pack_control, parse_control};

const LEASE: Duration = Duration::from_secs(1);
const HEARTBEAT: Duration = Duration::from_millis(250);
const ANSWER: Duration = Duration::from_millis(300);
const CONTROL_MAX: i64 = (16 << 20) + HEADER as i64;

pub fn clock_ns(clock: ClockId) -> Result<i64> {
    let time = clock_gettime(clock)?;
    Ok(time.tv_sec() * 1_000_000_000 + time.tv_nsec())
}

/// The user of this process.
fn user() -> Result<u32> {
    Ok(fs::metadata("/proc/self")?.uid())
}

/// BASE, where the folders of all domains are.
fn base() -> Result<PathBuf> {
    let user = user()?;
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let is_ours = |path: &PathBuf| fs::metadata(path).is_ok_and(|found| found.is_dir() && found.uid() == user);
    let session = variable("XDG_RUNTIME_DIR").filter(is_ours).map(|path| path.join("cortex"));
    Ok(variable("CORTEX_RUNTIME_DIR").or(session).unwrap_or_else(|| format!("/tmp/cortex-{user}").into()))
}

/// DIR, made if need be [D1].
fn directory() -> Result<PathBuf> {
    let path = base()?.join(std::env::var("CORTEX_DOMAIN").unwrap_or("0".into()));
    fs::DirBuilder::new().recursive(true).mode(0o700).create(&path)?;
    for ours in [&path, &base()?] {
        let found = fs::symlink_metadata(ours)?;
        let is_private = found.is_dir() && found.uid() == user()? && found.mode() & 0o077 == 0;
        ensure!(is_private, "{} is not a directory of ours with mode 0700", ours.display());
    }
    Ok(path)
}

/// The lock that keeps a node's files as long as it is open [D3].
fn lock(path: &Path) -> Result<File> {
    loop {
        let file = File::options().write(true).create(true).truncate(false).mode(0o600).open(path)?;
        file.lock()?;
        if fs::metadata(path).is_ok_and(|found| file.metadata().is_ok_and(|own| own.ino() == found.ino())) {
            return Ok(file);
        }
    }
}

/// What nodes have in common that can share unix sockets [D5].
fn host() -> Result<String> {
    let (boot, space) = (fs::read_to_string("/proc/sys/kernel/random/boot_id")?, fs::read_link("/proc/self/ns/pid")?);
    let base = fs::metadata(base()?)?;
    let text = format!("{}\n{}\n{}\n{}:{}", boot.trim(), space.display(), user()?, base.dev(), base.ino());
    Ok(hex::encode(schema::hash(text.as_bytes())))
}

/// What the registry has told.
#[derive(Default)]
struct Told {
    epoch: u64,
    version: u64,
    /// All nodes that it knows, us among them, and when it named them all.
    nodes: BTreeSet<u64>,
    named: Option<Instant>,
}

pub struct Node {
    pub id: u64,
    pub host: String,
    /// Records of the other nodes, and how often they have changed.
    pub others: BTreeMap<u64, Value>,
    pub changes: u64,
    directory: PathBuf,
    lock: File,
    registry: Socket,
    record: Value,
    told: Told,
    /// When we last said Hello, if there is no answer yet, and when Heartbeat.
    asked: Option<Instant>,
    beat: Instant,
}

impl Node {
    /// A node that nobody knows yet.
    pub fn open(context: &Context) -> Result<Node> {
        let (id, directory, registry) = (rand::random(), directory()?, context.socket(DEALER)?);
        registry.set_linger(1000)?;
        registry.set_maxmsgsize(CONTROL_MAX)?;
        registry.set_immediate(true)?; // nothing is queued while there is no registry
        registry.set_reconnect_ivl(20)?;
        registry.connect(&format!("ipc://{}", directory.join("registry").display()))?;
        let (host, lock) = (host()?, lock(&directory.join(format!("{id:016x}.lock")))?);
        let (others, record, told, beat) = (BTreeMap::new(), Value::Null, Told::default(), Instant::now());
        Ok(Node { id, host, others, changes: 0, directory, lock, registry, record, told, asked: None, beat })
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
        self.hello(true)
    }

    fn send(&self, name: &str, message: &Value) -> Result<()> {
        let _ = self.registry.send(pack_control(name, message)?, DONTWAIT); // refused while there is no registry
        Ok(())
    }

    fn hello(&mut self, snapshot: bool) -> Result<()> {
        self.asked = Some(Instant::now());
        self.send("Hello", &json!({"snapshot": snapshot, "record": self.record}))
    }

    /// Hear the registry, and say what is due; to be called all the time.
    pub fn poll(&mut self) -> Result<()> {
        while let Ok(frame) = self.registry.recv_bytes(DONTWAIT) {
            if let Ok((name, message)) = parse_control(&frame) {
                self.hear(name, &message)?;
            }
        }
        if self.told.named.is_some_and(|since| since.elapsed() > LEASE) {
            let before = self.others.len(); // [C5]
            self.others.retain(|node, _| self.told.nodes.contains(node));
            self.changes += (self.others.len() < before) as u64;
        }
        if self.beat.elapsed() > HEARTBEAT {
            self.beat = Instant::now();
            self.send("Heartbeat", &json!({"node": self.id, "revision": 1, "held": 0}))?;
        }
        if self.asked.is_some_and(|since| since.elapsed() > ANSWER) { self.hello(true) } else { Ok(()) }
    }

    fn hear(&mut self, name: &str, message: &Value) -> Result<()> {
        let number = |name: &str| message[name].as_u64().unwrap_or(0);
        match name {
            "Welcome" => {
                let nodes = serde_json::from_value(message["nodes"].clone())?;
                self.told =
                    Told { epoch: number("epoch"), version: number("version"), nodes, named: Some(Instant::now()) };
                self.asked = None;
            }
            "Changed" | "Gone" => {
                self.told.version += (number("version") == self.told.version + 1) as u64; // [C2]
                self.changes += 1;
                if name == "Gone" {
                    self.told.nodes.remove(&number("node"));
                    self.others.remove(&number("node"));
                } else if let Some(node) = message["record"]["node"].as_u64() {
                    self.told.nodes.insert(node);
                    self.others.insert(node, message["record"].clone());
                }
            }
            "Alive" if self.asked.is_none() => {
                let is_known = |node: &u64| *node == self.id || self.others.contains_key(node);
                let is_current = (self.told.epoch, self.told.version) == (number("epoch"), number("version"))
                    && self.told.nodes.iter().all(is_known);
                if !is_current || number("held") != 1 {
                    self.hello(!is_current)?; // [C4]
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
            let _ = fs::remove_file(self.path(role)); // a tcp port has none
        }
        self.lock.unlock()?;
        self.send("Leave", &json!({"node": self.id}))
    }
}
