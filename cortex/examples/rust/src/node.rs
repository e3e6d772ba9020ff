//! A node: where nodes of a host meet [D], its record, and the registry that knows the others [C].

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{Error, Read, Result};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use crate::json::{Json, int, object, text};
use crate::wire::{pack_control, parse_control};
use crate::{schema, zmtp};

const LEASE: Duration = Duration::from_secs(1);
const HEARTBEAT: Duration = Duration::from_millis(250);
const ANSWER: Duration = Duration::from_millis(300);
const RETRY: Duration = Duration::from_millis(20);
const CONTROL_MAX: u64 = (16 << 20) + 64;

unsafe extern "C" {
    fn clock_gettime(clock: i32, time: *mut [i64; 2]) -> i32;
}

/// CLOCK_REALTIME (0) or CLOCK_MONOTONIC (1).
fn clock_ns(clock: i32) -> i64 {
    let mut time = [0; 2];
    unsafe { clock_gettime(clock, &mut time) };
    time[0] * 1_000_000_000 + time[1]
}

pub fn monotonic_ns() -> i64 {
    clock_ns(1)
}

/// A random number that is not 0.
pub fn random() -> u64 {
    let mut bytes = [0; 8];
    File::open("/dev/urandom").and_then(|mut file| file.read_exact(&mut bytes)).expect("random numbers");
    u64::from_le_bytes(bytes).max(1)
}

fn user() -> u32 {
    fs::metadata("/proc/self").map_or(0, |status| status.uid())
}

fn base() -> PathBuf {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let session = variable("XDG_RUNTIME_DIR").filter(|path| fs::metadata(path).is_ok_and(|own| own.uid() == user()));
    let session = session.map(|path| path.join("cortex"));
    variable("CORTEX_RUNTIME_DIR").or(session).unwrap_or_else(|| format!("/tmp/cortex-{}", user()).into())
}

/// DIR, made if need be [D1].
pub fn directory() -> Result<PathBuf> {
    let path = base().join(std::env::var("CORTEX_DOMAIN").unwrap_or("0".into()));
    fs::DirBuilder::new().recursive(true).mode(0o700).create(&path)?;
    for ours in [&path, &base()] {
        let status = fs::symlink_metadata(ours)?;
        if !status.is_dir() || status.uid() != user() || status.mode() & 0o077 != 0 {
            return Err(Error::other(format!("{} is not a directory of ours with mode 0700", ours.display())));
        }
    }
    Ok(path)
}

/// The lock that keeps a node's files as long as it is open [D3].
pub fn lock_files(node: u64) -> Result<File> {
    let path = directory()?.join(format!("{node:016x}.lock"));
    loop {
        let file = File::options().write(true).create(true).truncate(false).mode(0o600).open(&path)?;
        file.lock()?;
        if fs::metadata(&path).is_ok_and(|status| file.metadata().is_ok_and(|own| own.ino() == status.ino())) {
            return Ok(file);
        }
    }
}

/// What nodes have in common that can share unix sockets [D5].
pub fn host() -> Result<String> {
    let (boot, space) = (fs::read_to_string("/proc/sys/kernel/random/boot_id")?, fs::read_link("/proc/self/ns/pid")?);
    let (user, base) = (user(), fs::metadata(base())?);
    let parts = format!("{}\n{}\n{user}\n{}:{}", boot.trim(), space.display(), base.dev(), base.ino());
    Ok(format!("{:016x}", schema::hash(parts.as_bytes()).swap_bytes()))
}

#[derive(Default)]
pub struct Known {
    /// Records by node.
    pub nodes: BTreeMap<i128, Json>,
    /// How often they have changed.
    pub changes: u64,
    writer: Option<zmtp::Writer>,
}

/// What a registry knows, and how to leave it.
#[derive(Clone, Default)]
pub struct Directory(pub Arc<Mutex<Known>>);

impl Directory {
    /// Announce a node to the registry of this host, and learn of the others, from now on.
    pub fn start(node: u64, endpoints: Vec<Json>, publishers: Vec<Json>, subscribers: Vec<Json>) -> Result<Directory> {
        let record = object(&[
            ("node", int(node)),
            ("name", text("rust")),
            ("host", text(host()?)),
            ("pid", int(std::process::id() as u64)),
            ("revision", int(1)),
            ("clock_offset_ns", Json::Int((clock_ns(0) - clock_ns(1)) as i128)),
            ("endpoints", Json::List(endpoints)),
            ("publishers", Json::List(publishers)),
            ("subscribers", Json::List(subscribers)),
            ("services", Json::List(vec![])),
        ]);
        let registry = format!("ipc://{}", directory()?.join("registry").display());
        let started = Directory::default();
        let own = started.clone();
        thread::spawn(move || {
            loop {
                if let Ok((reader, writer)) = zmtp::connect(&registry, "DEALER", CONTROL_MAX) {
                    own.0.lock().unwrap().writer = Some(writer);
                    own.speak(reader, &record);
                }
                thread::sleep(RETRY);
            }
        });
        Ok(started)
    }

    fn send(&self, name: &str, fields: &[(&str, Json)]) {
        if let Some(writer) = self.0.lock().unwrap().writer.clone() {
            let _ = writer.send(&[pack_control(name, &object(fields)).unwrap()]); // whoever reads notices the end
        }
    }

    pub fn leave(&self, node: u64) {
        self.send("Leave", &[("node", int(node))]);
    }

    /// Speak with the registry until the connection ends.
    fn speak(&self, mut reader: zmtp::Reader, record: &Json) {
        let (sender, frames) = mpsc::channel();
        thread::spawn(move || while reader.receive().is_ok_and(|frames| sender.send(frames).is_ok()) {});
        let hello = |snapshot| self.send("Hello", &[("snapshot", Json::Bool(snapshot)), ("record", record.clone())]);
        let beats = [("node", record.get("node").clone()), ("revision", int(1)), ("held", int(0))];
        let (mut epoch, mut version, mut asked) = (Json::Null, -1, Some(Instant::now()));
        let (mut doubted, mut missing, mut beat) = (BTreeMap::new(), vec![], Instant::now());
        hello(true);
        loop {
            let heard = frames.recv_timeout(HEARTBEAT.saturating_sub(beat.elapsed()));
            let (name, message) = match heard.map(|frames| parse_control(&frames[0])) {
                Err(mpsc::RecvTimeoutError::Disconnected) => return,
                Err(_) => {
                    beat = Instant::now();
                    self.send("Heartbeat", &beats);
                    ("", Json::Null)
                }
                Ok(parsed) => parsed.unwrap_or(("", Json::Null)),
            };
            let mut known = self.0.lock().unwrap();
            let number = message.get("version").int();
            match name {
                "Welcome" => {
                    (epoch, version, asked) = (message.get("epoch").clone(), number, None);
                    let named = message.get("nodes").items();
                    let unnamed = known.nodes.keys().filter(|node| !named.contains(&Json::Int(**node)));
                    doubted = unnamed.map(|node| (*node, Instant::now())).collect(); // [C5]
                    missing = named.iter().filter(|node| *node != record.get("node")).map(Json::int).collect();
                    missing.retain(|node| !known.nodes.contains_key(node));
                }
                "Changed" => {
                    let record = message.get("record");
                    doubted.remove(&record.get("node").int());
                    known.nodes.insert(record.get("node").int(), record.clone());
                    known.changes += 1;
                }
                "Gone" => known.changes += known.nodes.remove(&message.get("node").int()).is_some() as u64,
                "Refused" => eprintln!("the registry refuses this node: {}", message.get("reason")),
                _ => {}
            }
            let node = message.get("record").get("node").int() + message.get("node").int();
            missing.retain(|named| *named != node);
            version += (["Changed", "Gone"].contains(&name) && number == version + 1) as i128; // [C2]
            doubted.retain(|node, since| {
                let stays = since.elapsed() <= LEASE;
                known.changes += (!stays && known.nodes.remove(node).is_some()) as u64;
                stays
            });
            drop(known);
            if name == "Alive" && asked.is_none_or(|since| since.elapsed() > ANSWER) {
                let current = message.get("epoch") == &epoch && number == version && missing.is_empty();
                if !current || message.get("held") != &int(1) {
                    asked = Some(Instant::now());
                    hello(!current); // [C4]
                }
            }
        }
    }
}
