//! `cortex-sub TOPIC [--reliable] [--tcp] [--once]` prints each message of a topic as a line of JSON, and at its end to
//! the error output what it has counted. `--tcp` passes over unix sockets; `--once` ends when the publishers have left.

use std::collections::BTreeMap;
use std::io::Write;
use std::sync::mpsc::sync_channel;
use std::time::{Duration, Instant};

use cortex::json::{Json, int, object, text};
use cortex::link::{Counters, Event, Link};
use cortex::{body, node};

const QUEUE: usize = 64;
const TICK: Duration = Duration::from_millis(20);
const LEAVING: Duration = Duration::from_secs(2);

/// Where a node is reached from here [C8].
fn reach(node: &Json, host: &str, tcp: bool, reliable: bool) -> Option<String> {
    let usable = |endpoint: &&Json| {
        let lossy = endpoint.get("lossy").text();
        let loopback = lossy.starts_with("tcp://127.") || lossy.starts_with("tcp://[::1]");
        match endpoint.get("transport").text() {
            "ipc" => !tcp && node.get("host").text() == host,
            _ => loopback && endpoint.get("server_key").text().is_empty(),
        }
    };
    let endpoint = node.get("endpoints").items().iter().find(usable)?;
    Some(endpoint.get(if reliable { "strict" } else { "lossy" }).text().to_string())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let flag = |name| arguments.iter().any(|argument| argument == name);
    let topic = arguments.first().ok_or("usage: cortex-sub TOPIC [--reliable] [--tcp] [--once]")?;
    let (reliable, tcp, id, policy) = (flag("--reliable"), flag("--tcp"), node::random(), arguments[1..].join(" "));
    let own = [("topic", text(topic)), ("type_name", text("")), ("fingerprint", int(0)), ("policy", text(policy))];
    node::directory()?;
    let (host, directory) = (node::host()?, node::Directory::start(id, vec![], vec![], vec![object(&own)])?);
    let (events, arrived) = sync_channel::<Event>(QUEUE);
    let (mut links, mut counters): (BTreeMap<u64, Link>, _) = (BTreeMap::new(), Counters::default());
    let (mut changes, mut ended, mut output) = (0, false, std::io::BufWriter::new(std::io::stdout().lock()));
    loop {
        let known = directory.0.lock().unwrap();
        if known.changes != changes {
            changes = known.changes;
            links.values_mut().for_each(|link| link.left = link.left.or(Some(Instant::now())));
            let offered =
                known.nodes.values().flat_map(|node| node.get("publishers").items().iter().map(move |p| (node, p)));
            for (node, publisher) in offered.filter(|(_, publisher)| publisher.get("topic").text() == topic) {
                let source = publisher.get("source").int() as u64;
                match (links.get_mut(&source), reach(node, &host, tcp, reliable)) {
                    (Some(link), _) => link.left = None,
                    (None, Some(address)) => match Link::new(publisher, &address, reliable) {
                        Ok(link) => drop(links.insert(source, link)),
                        Err(error) => eprintln!("{topic}: {error}"),
                    },
                    _ => {}
                }
            }
        }
        drop(known);
        for link in links.values_mut().filter(|link| !link.connected && link.left.is_none()) {
            let _ = link.attach(&events); // tried again until it has left
        }
        match arrived.recv_timeout(TICK) {
            Ok((source, Some(message))) => {
                let Some(link) = links.get_mut(&source) else { continue };
                let bodies = link.take(&message, &mut counters).map(|bodies| bodies.into_iter().map(Ok).collect());
                for bytes in bodies.unwrap_or_else(|error| vec![Err(error)]) {
                    match bytes.and_then(|bytes| body::decode(&link.schema, bytes)) {
                        Ok(message) => {
                            writeln!(output, "{message}")?;
                            counters.received += 1;
                        }
                        Err(error) => {
                            eprintln!("{topic}: rejected: {error}");
                            counters.rejected += 1;
                        }
                    }
                }
                continue;
            }
            Ok((source, None)) => links.get_mut(&source).into_iter().for_each(|link| link.connected = false),
            Err(_) => output.flush()?,
        }
        links.retain(|_, link| {
            let stays = link.left.is_none_or(|since| !link.is_complete() && since.elapsed() < LEAVING);
            if !stays {
                link.end(&mut counters);
            }
            ended |= !stays;
            stays
        });
        if flag("--once") && ended && links.is_empty() {
            break;
        }
    }
    directory.leave(id);
    let Counters { received, lost, rejected, cut_off } = counters;
    eprintln!("{{\"received\":{received},\"lost\":{lost},\"rejected\":{rejected},\"cut_off\":{cut_off}}}");
    Ok(output.flush()?)
}
