//! `cortex-pub TOPIC [--tcp]` reads a schema from the first line of its input and a message from each further one (JSON as
//! in the test vectors), and publishes them. It prints how many subscribers there are, and at its end what it has counted.

use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result};
use cortex::{publisher::Publisher, schema::Schema};

const TICK: Duration = Duration::from_millis(5);

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let topic = arguments.first().context("usage: cortex-pub TOPIC [--tcp]")?;
    let transport = if arguments.contains(&"--tcp".into()) { "tcp" } else { "ipc" };
    let schema = Schema::parse(&std::io::stdin().lines().next().context("no schema")??)?;
    let mut publisher = Publisher::open(&zmq::Context::new(), topic, schema, transport)?;
    let (sender, lines) = sync_channel(1);
    thread::spawn(move || std::io::stdin().lines().try_for_each(|line| sender.send(line)));
    let mut before = None;
    loop {
        match lines.recv_timeout(TICK) {
            Ok(line) => drop(publisher.publish(&serde_json::from_str(&line?)?)?),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        publisher.poll()?;
        if before.replace(publisher.subscribers()) != Some(publisher.subscribers()) {
            println!("{{\"subscribers\":{}}}", publisher.subscribers());
        }
    }
    let (published, timeouts) = (publisher.next, publisher.timeouts);
    publisher.close()?;
    println!("{{\"published\":{published},\"timeouts\":{timeouts}}}");
    Ok(())
}
