//! `cortex-sub TOPIC [--reliable] [--tcp] [--once]` prints each message of a topic as a line of JSON, and at its end to
//! the error output what it has counted. `--tcp` passes over unix sockets; `--once` ends when the publishers have left.

use std::io::Write;

use anyhow::{Context, Result};
use cortex::subscriber::{Counters, Subscriber};

const TICK_MS: i64 = 20;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let flag = |name: &str| arguments.iter().any(|argument| argument == name);
    let topic = arguments.first().context("usage: cortex-sub TOPIC [--reliable] [--tcp] [--once]")?;
    let mut subscriber = Subscriber::open(&zmq::Context::new(), topic, flag("--reliable"), flag("--tcp"))?;
    let mut output = std::io::stdout().lock();
    while !(flag("--once") && subscriber.ended) {
        for message in subscriber.poll(TICK_MS)? {
            writeln!(output, "{message}")?;
        }
    }
    let Counters { received, lost, rejected, cut_off } = subscriber.counters;
    eprintln!("{{\"received\":{received},\"lost\":{lost},\"rejected\":{rejected},\"cut_off\":{cut_off}}}");
    subscriber.close()
}
