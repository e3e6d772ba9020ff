//! The test vectors of `cortex/vectors`.

use cortex::body::{decode, encode};
use cortex::schema;
use cortex::subscriber::{Counters, Link};
use cortex::wire::{Header, number, parse_answer, parse_control};
use serde_json::{Value, json};

fn load(name: &str) -> Value {
    let path = format!("{}/../../vectors/{name}", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn bytes(text: &Value) -> Vec<u8> {
    hex::decode(text.as_str().unwrap()).unwrap()
}

/// The schema of a vector, whose fingerprint is as it says.
fn schema_of(vector: &Value) -> Value {
    let schema = schema::parse(vector["schema"].as_str().unwrap()).unwrap();
    assert_eq!(vector["fingerprint"], format!("{:016x}", schema::fingerprint(&schema)));
    schema
}

#[test]
fn types() {
    let file = load("types.json");
    let types = file.as_array().unwrap();
    assert!(types.iter().all(|entry| schema_of(entry)["name"] == entry["name"]) && types.len() > 30);
}

#[test]
fn bodies() {
    let folder = format!("{}/../../vectors", env!("CARGO_MANIFEST_DIR"));
    let names = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut counts = (0, 0);
    for name in names.filter(|name| !["types.json", "frames.json"].contains(&name.as_str())) {
        let vector = load(&name);
        let schema = schema_of(&vector);
        for case in vector["cases"].as_array().unwrap() {
            let body = bytes(&case["body"]);
            assert_eq!(encode(&schema, &case["value"]).unwrap(), body, "{name}: {}", case["name"]);
            assert_eq!(decode(&schema, &body).unwrap(), case["value"], "{name}: {}", case["name"]);
            counts.0 += 1;
        }
        for case in vector["malformed"].as_array().unwrap() {
            let found = decode(&schema, &bytes(&case["body"]));
            assert!(found.is_err(), "{name}: {} passes as {found:?}", case["name"]);
            counts.1 += 1;
        }
    }
    assert!(counts.0 >= 45 && counts.1 >= 40, "{counts:?}");
}

#[test]
fn frames() {
    let file = load("frames.json");
    for case in file["frames"].as_array().unwrap() {
        let (frame, fields) = (bytes(&case["frame"]), &case["fields"]);
        let kind = fields["kind"].as_str().unwrap().as_bytes()[0];
        if kind == b'C' {
            let (name, message) = parse_control(&frame).unwrap();
            assert_eq!((json!(format!("cortex/{name}")), &message), (fields["name"].clone(), &fields["message"]));
            continue;
        }
        let of = |name: &str| fields[name].as_u64().unwrap_or(0);
        let mut header = Header { kind, stamped: fields["stamped"] == true, source: of("source"), ..Header::default() };
        if kind == b'A' || kind == b'R' {
            let key = header.key(kind, of("reader"), of(if kind == b'A' { "options" } else { "sequence" }));
            assert!(frame.starts_with(&key), "{}", case["name"]);
            if fields["next"].is_u64() {
                assert_eq!(parse_answer(&frame).unwrap(), (of("next"), &bytes(&fields["latched"])[..]));
                assert_eq!(number(&frame, 32), of("next"));
            }
            continue;
        }
        (header.fingerprint, header.sequence, header.size) = (of("fingerprint"), of("sequence"), of("body_size"));
        (header.aux, header.publish_ns) = (of("aux"), 1 << 62);
        header.stamp_ns = fields["stamp_ns"].as_i64().unwrap();
        assert_eq!(Header::parse(&frame).unwrap(), header, "{}", case["name"]);
        assert_eq!(header.pack(), frame[..64], "{}", case["name"]);
    }
    for case in file["malformed"].as_array().unwrap() {
        let frame = bytes(&case["frame"]);
        let mut link = Link::open(&zmq::Context::new(), &file["publisher"], "inproc://none", true).unwrap();
        let is_answer = frame.get(3) == Some(&b'A');
        let rejected = is_answer && parse_answer(&frame).is_err();
        assert!(rejected || link.take(&[frame], &mut Counters::default()).is_err(), "{}", case["name"]);
    }
}
