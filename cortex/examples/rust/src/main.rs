//! `cortex-peer pub TOPIC` reads a schema from the first line of its input and a message from each further one (JSON as in
//! the test vectors), and publishes them. `cortex-peer sub TOPIC [--reliable] [--once]` prints each message of a topic as a
//! line of JSON; `--once` ends when the publishers have left. Both say at their end what they have counted.

use std::io::{Write, stdin, stdout};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

use anyhow::{Context, Result, bail};
use cortex::subscriber::{Counters, Subscriber};
use cortex::{publisher::Publisher, schema};

const TICK_MS: u64 = 5;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match &arguments[..] {
        [role, topic] if role == "pub" => publish(topic),
        [role, topic, flags @ ..] if role == "sub" => subscribe(topic, flags),
        _ => bail!("usage: cortex-peer pub TOPIC, or cortex-peer sub TOPIC [--reliable] [--once]"),
    }
}

fn publish(topic: &str) -> Result<()> {
    let schema = schema::parse(&stdin().lines().next().context("no schema")??)?;
    let mut publisher = Publisher::open(&zmq::Context::new(), topic, schema)?;
    let (sender, lines) = sync_channel(1);
    std::thread::spawn(move || stdin().lines().try_for_each(|line| sender.send(line)));
    let mut before = usize::MAX;
    loop {
        match lines.recv_timeout(Duration::from_millis(TICK_MS)) {
            Ok(line) => publisher.publish(&serde_json::from_str(&line?)?)?,
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        publisher.poll()?;
        if std::mem::replace(&mut before, publisher.subscribers()) != before {
            println!("{{\"subscribers\":{before}}}");
        }
    }
    println!("{{\"published\":{},\"timeouts\":{}}}", publisher.next, publisher.timeouts);
    publisher.close()
}

fn subscribe(topic: &str, flags: &[String]) -> Result<()> {
    let has = |name: &str| flags.iter().any(|flag| flag == name);
    let mut subscriber = Subscriber::open(&zmq::Context::new(), topic, has("--reliable"))?;
    while !(has("--once") && subscriber.ended) {
        for message in subscriber.poll(TICK_MS as i64)? {
            writeln!(stdout(), "{message}")?;
        }
    }
    let Counters { received, lost, rejected, cut_off } = subscriber.counters;
    eprintln!("{{\"received\":{received},\"lost\":{lost},\"rejected\":{rejected},\"cut_off\":{cut_off}}}");
    subscriber.close()
}
