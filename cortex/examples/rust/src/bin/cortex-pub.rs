//! `cortex-pub TOPIC [--tcp]` reads a schema from the first line of its input and a message from each further one (JSON as
//! in the test vectors), and publishes them. It prints how many subscribers there are, and at its end what it has counted.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use cortex::json::{Json, int, object, text};
use cortex::publisher::Publisher;
use cortex::{node, schema, zmtp};

const SUBSCRIPTION_MAX: u64 = 1024;
const TICK: Duration = Duration::from_millis(5);

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let topic = arguments.first().ok_or("usage: cortex-pub TOPIC [--tcp]")?;
    let mut lines = std::io::stdin().lines();
    let publisher = Arc::new(Publisher::new(schema::parse(&lines.next().ok_or("no schema")??)?));
    let (id, transport) = (node::random(), if arguments.contains(&"--tcp".into()) { "tcp" } else { "ipc" });
    let path = |role| node::directory().map(|directory| directory.join(format!("{id:016x}.{role}")));
    let _lock = node::lock_files(id)?;
    let listen = |role| -> std::io::Result<Json> {
        let (own, local) = (publisher.clone(), format!("ipc://{}", path(role)?.display()));
        let address = if transport == "tcp" { "tcp://127.0.0.1:0" } else { &local };
        let serve = move |reader, writer| own.serve(role == "strict", reader, writer);
        zmtp::listen(address, SUBSCRIPTION_MAX, serve).map(Json::Text)
    };
    let (lossy, strict, none) = (listen("lossy")?, listen("strict")?, text(""));
    let addresses = [("lossy", lossy), ("strict", strict), ("control", none.clone()), ("server_key", none)];
    let own = object(&[
        ("topic", text(topic)),
        ("source", int(publisher.source)),
        ("type_name", publisher.schema.get("name").clone()),
        ("fingerprint", int(schema::fingerprint(&publisher.schema))),
        ("schema", text(publisher.schema.to_string())),
        ("latch", Json::Bool(false)),
    ]);
    let endpoint = object(&[&[("transport", text(transport))], &addresses[..]].concat());
    let directory = node::Directory::start(id, vec![endpoint], vec![own], vec![])?;
    let (watched, mut before) = (publisher.clone(), usize::MAX);
    thread::spawn(move || {
        loop {
            let readers = watched.readers();
            if readers != before {
                println!("{{\"subscribers\":{readers}}}");
            }
            before = readers;
            watched.tell();
            thread::sleep(TICK);
        }
    });
    let (mut published, mut timeouts) = (0, 0);
    for line in lines {
        timeouts += !publisher.publish(&Json::parse(&line?)?)? as u64;
        published += 1;
    }
    publisher.close();
    directory.leave(id);
    for role in ["lossy", "strict", "lock"] {
        let _ = std::fs::remove_file(path(role)?); // a tcp port has none
    }
    println!("{{\"published\":{published},\"timeouts\":{timeouts}}}");
    Ok(())
}
