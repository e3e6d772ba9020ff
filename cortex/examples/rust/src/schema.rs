//! Schemas: their canonical text, what they may say, and the fingerprint [S].

use crate::json::Json;
use crate::{Result, ensure};

#[rustfmt::skip]
pub const DTYPES: [(&str, usize); 14] = [
    ("bool", 1), ("int8", 1), ("int16", 2), ("int32", 4), ("int64", 8), ("uint8", 1), ("uint16", 2),
    ("uint32", 4), ("uint64", 8), ("float16", 2), ("float32", 4), ("float64", 8), ("complex64", 8), ("complex128", 16),
];

pub fn itemsize(dtype: &str) -> Option<usize> {
    DTYPES.iter().find(|(name, _)| *name == dtype).map(|(_, size)| *size)
}

/// Size of a number or truth value in a body.
pub fn scalar_size(name: &str) -> Option<usize> {
    itemsize(name).filter(|_| name != "float16" && !name.starts_with("complex"))
}

/// What a type is ("int8", "list", …), and of what.
pub fn kind(of: &Json) -> (&str, &Json) {
    of.members().first().map_or((of.text(), &Json::Null), |(name, inner)| (name, inner))
}

pub fn is_fixed_array(of: &Json) -> bool {
    of.get("array").text() != "any" && of.get("shape").items().iter().all(|size| matches!(size, Json::Int(_)))
}

/// Read a canonical text [S1].
pub fn parse(text: &str) -> Result<Json> {
    ensure!(text.len() <= 1 << 16, "a schema of {} bytes", text.len());
    let schema = Json::parse(text)?;
    ensure!(schema.to_string() == text, "a schema that is not canonical");
    let nodes = check_message(&schema, 1)?;
    ensure!(nodes <= 2048, "a schema of {nodes} fields, values and dimensions");
    Ok(schema)
}

/// Whether a message has a stamp of its own [H3].
pub fn is_stamped(schema: &Json) -> bool {
    let stamp = schema.get("fields").items().iter().find(|field| field.get("name").text() == "stamp_ns");
    stamp.is_some_and(|field| field.get("type").text().contains("int"))
}

fn keys(value: &Json) -> Vec<&str> {
    value.members().iter().map(|(name, _)| name.as_str()).collect()
}

/// Names of fields, dimensions and enum values, each there once [S2].
fn check_names(names: &[&str]) -> Result<()> {
    for (index, name) in names.iter().enumerate() {
        let letters = name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        let starts = !name.starts_with(|c: char| c.is_ascii_digit()) && !name.starts_with("__");
        let good = letters && starts && (1..=64).contains(&name.len()) && !names[..index].contains(name);
        ensure!(good, "{name:?} is not a name, or there twice");
    }
    Ok(())
}

fn check_type_name(name: &str) -> Result<()> {
    let letters = name.chars().all(|c| c.is_ascii_alphanumeric() || "_./".contains(c));
    ensure!(letters && (1..=128).contains(&name.len()), "{name:?} is not the name of a type");
    Ok(())
}

/// Check a message, and count the fields, enum values and dimensions in it [S2 to S5].
fn check_message(schema: &Json, depth: usize) -> Result<usize> {
    ensure!(keys(schema) == ["name", "fields"] && depth <= 8, "a message is name and fields, 8 deep");
    check_type_name(schema.get("name").text())?;
    let fields = schema.get("fields").items();
    ensure!(fields.len() <= 256 && (depth == 1 || !fields.is_empty()), "{} fields", fields.len());
    check_names(&fields.iter().map(|field| field.get("name").text()).collect::<Vec<_>>())?;
    let mut nodes = fields.len();
    for field in fields {
        ensure!(keys(field) == ["name", "type", "unit", "frame"], "a field is name, type, unit and frame");
        for label in [field.get("unit"), field.get("frame")].map(Json::text) {
            let plain = !label.contains(|c: char| c < ' ' || "\x7f\"\\".contains(c));
            ensure!(plain && label.chars().count() <= 64, "{label:?} is not a unit or frame");
        }
        nodes += check_type(field.get("type"), depth)?;
    }
    let size = crate::body::layout(schema)?.0;
    ensure!(size <= 1 << 30, "a block of {size} bytes");
    Ok(nodes)
}

fn check_type(of: &Json, depth: usize) -> Result<usize> {
    let (name, inner) = kind(of);
    ensure!(depth <= 8, "nested more than 8 deep");
    match (name, keys(of).as_slice()) {
        ("enum", ["enum", "values"]) => {
            let values = of.get("values").members();
            let numbers = values.iter().all(|(_, value)| matches!(value, Json::Int(n) if i32::try_from(*n).is_ok()));
            ensure!(numbers && !values.is_empty(), "an enum without values, or with some that are not int32");
            check_type_name(inner.text()).and(check_names(&keys(of.get("values"))))?;
            Ok(values.len())
        }
        ("array", ["array", "shape"]) => {
            let shape = of.get("shape").items();
            ensure!(itemsize(inner.text()).is_some() || inner.text() == "any", "an array of {inner}");
            ensure!(shape.len() <= 32, "an array of {} dimensions", shape.len());
            for size in shape {
                match size {
                    Json::Int(size) => ensure!((1..1 << 32).contains(size), "a dimension of {size}"),
                    name => check_names(&[name.text()])?,
                }
            }
            Ok(shape.len())
        }
        ("optional", ["optional"]) if kind(inner).0 != "optional" => check_type(inner, depth + 1),
        ("list", ["list"]) => check_type(inner, depth + 1),
        ("message", ["message"]) => check_message(inner, depth + 1),
        ("str" | "bytes", []) => Ok(0),
        (name, []) if scalar_size(name).is_some() => Ok(0),
        _ => Err(format!("{of} is not a type")),
    }
}

/// The fingerprint of a type [S6].
pub fn fingerprint(schema: &Json) -> u64 {
    hash(schema.to_string().as_bytes())
}

/// BLAKE2b (RFC 7693) with a digest of 8 bytes, as a little-endian number.
pub fn hash(data: &[u8]) -> u64 {
    let mut state = IV;
    state[0] ^= 0x0101_0000 ^ 8;
    let last = data.len().saturating_sub(1) / 128;
    for block in 0..=last {
        let end = data.len().min(128 * (block + 1));
        let mut bytes = [0; 128];
        bytes[..end - 128 * block].copy_from_slice(&data[128 * block..end]);
        let word = |index: u64| u64::from_le_bytes(bytes[8 * index as usize..][..8].try_into().unwrap());
        let mut v = [state, IV].concat();
        v[12] ^= end as u64;
        v[14] ^= if block == last { u64::MAX } else { 0 };
        for round in 0..12 {
            for (index, [a, b, c, d]) in MIXED.into_iter().enumerate() {
                let order = SIGMA[round % 10] >> (56 - 8 * index);
                v[a] = v[a].wrapping_add(v[b]).wrapping_add(word(order >> 4 & 15));
                v[d] = (v[d] ^ v[a]).rotate_right(32);
                v[c] = v[c].wrapping_add(v[d]);
                v[b] = (v[b] ^ v[c]).rotate_right(24);
                v[a] = v[a].wrapping_add(v[b]).wrapping_add(word(order & 15));
                v[d] = (v[d] ^ v[a]).rotate_right(16);
                v[c] = v[c].wrapping_add(v[d]);
                v[b] = (v[b] ^ v[c]).rotate_right(63);
            }
        }
        (0..8).for_each(|index| state[index] ^= v[index] ^ v[index + 8]);
    }
    state[0]
}

#[rustfmt::skip]
const IV: [u64; 8] = [
    0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b, 0xa54ff53a5f1d36f1,
    0x510e527fade682d1, 0x9b05688c2b3e6c1f, 0x1f83d9abfb41bd6b, 0x5be0cd19137e2179,
];
#[rustfmt::skip]
const SIGMA: [u64; 10] = [
    0x0123456789abcdef, 0xea489fd61c02b753, 0xb8c052fdae367194, 0x7931dcbe265a40f8, 0x905724afe1bc683d,
    0x2c6a0b834d75fe19, 0xc51fed4a0763928b, 0xdb7ec13950f4862a, 0x6fe9b308c2d714a5, 0xa2847615fb9e3cd0,
];
#[rustfmt::skip]
const MIXED: [[usize; 4]; 8] = [
    [0, 4, 8, 12], [1, 5, 9, 13], [2, 6, 10, 14], [3, 7, 11, 15],
    [0, 5, 10, 15], [1, 6, 11, 12], [2, 7, 8, 13], [3, 4, 9, 14],
];
