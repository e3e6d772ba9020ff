//! The test vectors of `cortex/vectors`.

use cortex::body::{decode, encode, hex, unhex};
use cortex::json::{Json, text};
use cortex::link::{Counters, Link};
use cortex::schema;
use cortex::wire::{Header, key, parse_answer, parse_control};

fn load(name: &str) -> Json {
    let path = format!("{}/../../vectors/{name}", env!("CARGO_MANIFEST_DIR"));
    Json::parse(&std::fs::read_to_string(path).unwrap()).unwrap()
}

#[test]
fn bodies() {
    let folder = format!("{}/../../vectors", env!("CARGO_MANIFEST_DIR"));
    let mut counts = (0, 0);
    for entry in std::fs::read_dir(folder).unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        if !name.ends_with(".json") || ["types.json", "frames.json"].contains(&name.as_str()) {
            continue;
        }
        let vector = load(&name);
        let schema = schema::parse(vector.get("schema").text()).unwrap();
        assert_eq!(format!("{:016x}", schema::fingerprint(&schema)), vector.get("fingerprint").text());
        for case in vector.get("cases").items() {
            let what = format!("{name}: {}", case.get("name"));
            let body = case.get("body").text();
            assert_eq!(hex(&encode(&schema, case.get("value")).unwrap()), body, "{what}");
            assert_eq!(&decode(&schema, &unhex(body).unwrap()).unwrap(), case.get("value"), "{what}");
            counts.0 += 1;
        }
        for case in vector.get("malformed").items() {
            let found = decode(&schema, &unhex(case.get("body").text()).unwrap());
            assert!(found.is_err(), "{name}: {} passes as {found:?}", case.get("name"));
            counts.1 += 1;
        }
    }
    assert!(counts.0 >= 45 && counts.1 >= 40, "{counts:?}");
}

#[test]
fn types() {
    for entry in load("types.json").items() {
        let schema = schema::parse(entry.get("schema").text()).unwrap();
        assert_eq!(schema.get("name"), entry.get("name"));
        assert_eq!(format!("{:016x}", schema::fingerprint(&schema)), entry.get("fingerprint").text());
    }
}

fn number(fields: &Json, name: &str) -> u64 {
    fields.get(name).int() as u64
}

#[test]
fn frames() {
    let file = load("frames.json");
    for case in file.get("frames").items() {
        let (fields, frame) = (case.get("fields"), unhex(case.get("frame").text()).unwrap());
        let (kind, source) = (fields.get("kind").text().as_bytes()[0], number(fields, "source"));
        let stamped = fields.get("stamped") == &Json::Bool(true);
        match kind {
            b'A' | b'R' => {
                let last = number(fields, if kind == b'A' { "options" } else { "sequence" });
                let expected = key(kind, stamped, source, number(fields, "reader"), last);
                assert!(frame.starts_with(&expected), "{}", case.get("name"));
                if fields.get("next") != &Json::Null {
                    let (next, latched) = parse_answer(&frame).unwrap();
                    assert_eq!((next, hex(latched).as_str()), (number(fields, "next"), fields.get("latched").text()));
                }
            }
            b'C' => {
                let (name, message) = parse_control(&frame).unwrap();
                assert_eq!(
                    (text(format!("cortex/{name}")), &message),
                    (fields.get("name").clone(), fields.get("message"))
                );
            }
            _ => {
                let header = Header::parse(&frame).unwrap();
                let numbers = [header.fingerprint, header.sequence, header.size, header.aux];
                let expected = ["fingerprint", "sequence", "body_size", "aux"].map(|name| number(fields, name));
                assert_eq!((header.kind, header.stamped, header.source), (kind, stamped, source));
                assert_eq!((numbers, header.stamp_ns), (expected, fields.get("stamp_ns").int() as i64));
                assert_eq!((&header.pack()[..], header.publish_ns), (&frame[..64], 1 << 62));
            }
        }
    }
    for case in file.get("malformed").items() {
        let frame = unhex(case.get("frame").text()).unwrap();
        let mut link = Link::new(file.get("publisher"), "", true).unwrap();
        let is_answer = frame.get(3) == Some(&b'A');
        let rejected = parse_answer(&frame).is_err() && is_answer;
        assert!(rejected || link.take(&vec![frame], &mut Counters::default()).is_err(), "{}", case.get("name"));
    }
}
