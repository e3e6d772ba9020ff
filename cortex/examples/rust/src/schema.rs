//! Schemas, which are JSON: their canonical text, their fingerprint [S], and how a type lies in a block [B1].

use anyhow::{Context, Result, bail, ensure};
use serde_json::{Map, Value};

/// Names and itemsizes by number.
#[rustfmt::skip]
pub const DTYPES: [(&str, usize); 14] = [
    ("bool", 1), ("int8", 1), ("int16", 2), ("int32", 4), ("int64", 8), ("uint8", 1), ("uint16", 2), ("uint32", 4),
    ("uint64", 8), ("float16", 2), ("float32", 4), ("float64", 8), ("complex64", 8), ("complex128", 16),
];

pub enum Type<'a> {
    /// "str" or "bytes".
    Text(&'a str),
    Number(&'a str, usize),
    Enum(&'a Map<String, Value>),
    /// An array in the block, of so many bytes.
    Fixed(usize),
    /// An array in the tail: its dtype or "any", and its shape.
    Array(&'a str, &'a [Value]),
    Optional(&'a Value),
    List(&'a Value),
    Message(&'a Value),
}

/// How a type lies in a block, whether it may have a tail [B2], and for how many values an element of it counts [B10].
pub struct Layout {
    pub size: usize,
    pub alignment: usize,
    pub has_tail: bool,
    pub values: usize,
}

impl Layout {
    /// Bytes from one element of a list to the next.
    pub fn stride(&self) -> usize {
        self.size.next_multiple_of(self.alignment).max(1)
    }
}

/// A type, and how it lies.
pub fn type_of(json: &Value) -> Result<(Type<'_>, Layout)> {
    let lay = |size, alignment, has_tail| Layout { size, alignment, has_tail, values: 1 };
    let itemsize = |name: &str| DTYPES.iter().find(|(known, _)| *known == name).map(|(_, size)| *size);
    if let Value::String(name) = json {
        return Ok(match name.as_str() {
            "str" | "bytes" => (Type::Text(name), lay(8, 4, true)),
            _ => {
                let size = itemsize(name).with_context(|| format!("no type {name}"))?;
                (Type::Number(name, size), lay(size, size, false))
            }
        });
    }
    let (key, inner) = json.as_object().and_then(|members| members.iter().next()).context("no type")?;
    Ok(match key.as_str() {
        "enum" => (Type::Enum(json["values"].as_object().context("an enum without values")?), lay(4, 4, false)),
        "array" => {
            let (dtype, shape) = inner.as_str().zip(json["shape"].as_array()).context("an array without a shape")?;
            let item = if dtype == "any" { None } else { Some(itemsize(dtype).context("no such dtype")?) };
            let size = |size: u64, of: &Value| Some(size.saturating_mul(of.as_u64()?).min(1 << 32));
            match item.and_then(|item| shape.iter().try_fold(item as u64, size)) {
                None => (Type::Array(dtype, shape), lay(8 + 4 * shape.len(), 4, true)),
                Some(size) => {
                    let alignment = if size >= 1024 { 64 } else { item.unwrap_or(1) };
                    (Type::Fixed(size as usize), lay(size as usize, alignment, false))
                }
            }
        }
        "optional" => {
            let layout = type_of(inner)?.1;
            let size = (layout.alignment + layout.size).next_multiple_of(layout.alignment);
            (Type::Optional(inner), Layout { size, ..layout })
        }
        "list" => (Type::List(inner), lay(8, 4, true)),
        "message" => (Type::Message(inner), places(inner)?.1),
        _ => bail!("no type {key}"),
    })
}

/// The name, type and offset of each field of a message, and how the message lies.
pub fn places(schema: &Value) -> Result<(Vec<(&str, &Value, usize)>, Layout)> {
    let mut whole = Layout { size: 0, alignment: 1, has_tail: false, values: 1 };
    let mut fields = vec![];
    for field in schema["fields"].as_array().context("a message without fields")? {
        let layout = type_of(&field["type"])?.1;
        let offset = whole.size.next_multiple_of(layout.alignment);
        fields.push((field["name"].as_str().context("a field without a name")?, &field["type"], offset));
        whole.size = offset + layout.size;
        whole.alignment = whole.alignment.max(layout.alignment);
        whole.has_tail |= layout.has_tail;
        whole.values += layout.values;
    }
    whole.size = whole.size.next_multiple_of(whole.alignment);
    Ok((fields, whole))
}

/// Read a canonical text [S1].
pub fn parse(text: &str) -> Result<Value> {
    let schema: Value = serde_json::from_str(text)?;
    ensure!(text.len() <= 1 << 16 && schema.to_string() == text, "a schema that is too long or not canonical");
    places(&schema)?;
    Ok(schema)
}

/// The fingerprint of a type [S6].
pub fn fingerprint(schema: &Value) -> u64 {
    u64::from_le_bytes(hash(schema.to_string().as_bytes()))
}

/// Whether a message has a stamp of its own [H3].
pub fn is_stamped(schema: &Value) -> bool {
    let is_integer = |of: &Value| of.as_str().is_some_and(|name| name.contains("int"));
    let mut fields = schema["fields"].as_array().into_iter().flatten();
    fields.any(|field| field["name"] == "stamp_ns" && is_integer(&field["type"]))
}

/// BLAKE2b with a digest of 8 bytes.
pub fn hash(data: &[u8]) -> [u8; 8] {
    blake2b_simd::Params::new().hash_length(8).hash(data).as_bytes().try_into().unwrap()
}
