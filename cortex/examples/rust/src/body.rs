//! Bodies [B]: values are JSON as in the test vectors; bytes and the items of arrays are hexadecimal there.

use std::collections::HashMap;

use anyhow::{Context, Result, bail, ensure};
use serde_json::{Map, Value, json};

use crate::schema::{DTYPES, Type, places, type_of};

/// Write a body. It is read once more, so that nothing is sent that a receiver must reject.
pub fn encode(schema: &Value, value: &Value) -> Result<Vec<u8>> {
    let mut body = vec![0; places(schema)?.1.size.next_multiple_of(8)];
    write_message(&mut body, 0, schema, value)?;
    decode(schema, &body)?;
    Ok(body)
}

fn write_message(body: &mut Vec<u8>, at: usize, schema: &Value, value: &Value) -> Result<()> {
    let write_field = |(name, of, offset)| write(body, at + offset, of, &value[name]).context(format!("field {name}"));
    places(schema)?.0.into_iter().try_for_each(write_field)
}

fn put(body: &mut [u8], at: usize, bytes: &[u8]) {
    body[at..at + bytes.len()].copy_from_slice(bytes);
}

/// Append an item to the tail, and put its offset, 0 if it is empty [B6], and a second number into the block.
fn append(body: &mut Vec<u8>, at: usize, data: &[u8], alignment: usize, second: usize) -> usize {
    let start = if data.is_empty() { 0 } else { body.len().next_multiple_of(alignment) };
    body.resize(body.len().max(start), 0);
    body.extend_from_slice(data);
    put(body, at, &[start as u32, second as u32].map(u32::to_le_bytes).concat());
    start
}

/// The bits of a number.
fn bits(name: &str, size: usize, value: &Value) -> Result<u64> {
    if name.starts_with("float") {
        let number = value.as_f64().or_else(|| value.as_str()?.parse().ok()).context("not a number")?;
        return Ok(if size == 4 { (number as f32).to_bits() as u64 } else { number.to_bits() });
    }
    let number = value.as_i64().map(i128::from).or(value.as_u64().map(i128::from)).context("not an integer")?;
    let low = if name.starts_with("int") { -1 << (8 * size - 1) } else { 0 };
    ensure!((low..low + (1 << (8 * size))).contains(&number), "{number} is no {name}");
    Ok(number as u64)
}

fn write(body: &mut Vec<u8>, at: usize, of: &Value, value: &Value) -> Result<()> {
    match (type_of(of)?.0, value) {
        (Type::Text(name), Value::String(text)) => {
            let data = if name == "str" { text.clone().into_bytes() } else { hex::decode(text)? };
            append(body, at, &data, 8, data.len());
        }
        (Type::Number("bool", _), Value::Bool(value)) => body[at] = *value as u8,
        (Type::Number(name, size), value) => put(body, at, &bits(name, size, value)?.to_le_bytes()[..size]),
        (Type::Enum(values), Value::String(name)) => {
            let number = values.get(name).with_context(|| format!("no value {name}"))?;
            put(body, at, &bits("int32", 4, number)?.to_le_bytes()[..4]);
        }
        (Type::Fixed(size), Value::Object(_)) => {
            let data = hex::decode(value["items"].as_str().context("an array without items")?)?;
            ensure!(data.len() == size && value["shape"] == of["shape"], "another shape");
            put(body, at, &data);
        }
        (Type::Array(_, shape), Value::Object(_)) => {
            let data = hex::decode(value["items"].as_str().context("an array without items")?)?;
            let dtype = DTYPES.iter().position(|(name, _)| value["dtype"] == *name).context("no such dtype")?;
            let sizes: Vec<u32> = serde_json::from_value(value["shape"].clone())?;
            ensure!(sizes.len() == shape.len(), "another number of dimensions");
            append(body, at, &data, if data.len() >= 1024 { 64 } else { 8 }, dtype | sizes.len() << 8);
            put(body, at + 8, &sizes.into_iter().flat_map(u32::to_le_bytes).collect::<Vec<_>>());
        }
        (Type::Optional(_), Value::Null) => {}
        (Type::Optional(inner), value) => {
            body[at] = 1;
            write(body, at + type_of(inner)?.1.alignment, inner, value)?;
        }
        (Type::List(inner), Value::Array(items)) => {
            let layout = type_of(inner)?.1;
            let elements = vec![0; layout.stride() * items.len()];
            let start = append(body, at, &elements, layout.alignment.max(8), items.len());
            for (index, item) in items.iter().enumerate() {
                write(body, start + index * layout.stride(), inner, item)?;
            }
        }
        (Type::Message(inner), value) => write_message(body, at, inner, value)?,
        _ => bail!("{value} where {of} was expected"),
    }
    Ok(())
}

/// Read a body, or say what is wrong with it.
pub fn decode(schema: &Value, body: &[u8]) -> Result<Value> {
    let layout = places(schema)?.1;
    let block = layout.size.next_multiple_of(8);
    ensure!(body.len() >= block && body.len() < 1 << 32, "a body of {} bytes, its block has {block}", body.len());
    ensure!(layout.has_tail || body.len() == block, "a body longer than its fixed size");
    Reader { body, claimed: block, values: 0 }.message(0, schema)
}

struct Reader<'a> {
    body: &'a [u8],
    claimed: usize,
    values: usize,
}

/// Sizes of the dimensions with names in one message [B4].
type Sizes<'a> = HashMap<&'a str, u64>;

impl<'a> Reader<'a> {
    fn number(&self, at: usize, size: usize) -> u64 {
        self.body[at..at + size].iter().rev().fold(0, |number, byte| number << 8 | *byte as u64)
    }

    fn flag(&self, at: usize) -> Result<bool> {
        ensure!(self.body[at] <= 1, "a truth value of {}", self.body[at]);
        Ok(self.body[at] == 1)
    }

    /// Bytes of the tail: within the body, and with all others not longer than it [B7, B8].
    fn item(&mut self, offset: u64, size: u64) -> Result<&'a [u8]> {
        let end = offset.checked_add(size).filter(|end| *end <= self.body.len() as u64).context("beyond the body")?;
        self.claimed += size as usize;
        ensure!(self.claimed <= self.body.len(), "items that share bytes");
        Ok(&self.body[offset as usize..end as usize])
    }

    fn message(&mut self, at: usize, schema: &Value) -> Result<Value> {
        let (mut sizes, mut members) = (Sizes::new(), Map::new());
        for (name, of, offset) in places(schema)?.0 {
            members.insert(name.into(), self.read(at + offset, of, &mut sizes).context(format!("field {name}"))?);
        }
        Ok(members.into())
    }

    fn read<'b>(&mut self, at: usize, of: &'b Value, sizes: &mut Sizes<'b>) -> Result<Value> {
        Ok(match type_of(of)?.0 {
            Type::Text(name) => {
                let data = self.item(self.number(at, 4), self.number(at + 4, 4))?;
                if name == "str" { str::from_utf8(data)?.into() } else { hex::encode(data).into() }
            }
            Type::Number("bool", _) => self.flag(at)?.into(),
            Type::Number("float32", size) => float(f32::from_bits(self.number(at, size) as u32).into()),
            Type::Number("float64", size) => float(f64::from_bits(self.number(at, size))),
            Type::Number(name, size) => {
                let (bits, shift) = (self.number(at, size), 64 - 8 * size);
                if name.starts_with("int") { ((bits << shift) as i64 >> shift).into() } else { bits.into() }
            }
            Type::Enum(values) => {
                let number = json!(self.number(at, 4) as i32);
                let (name, _) = values.iter().find(|(_, value)| **value == number).context("a number without name")?;
                name.clone().into()
            }
            Type::Fixed(size) => {
                json!({"dtype": of["array"], "shape": of["shape"], "items": hex::encode(&self.body[at..at + size])})
            }
            Type::Array(dtype, shape) => self.array(at, dtype, shape, sizes)?,
            Type::Optional(inner) if self.flag(at)? => self.read(at + type_of(inner)?.1.alignment, inner, sizes)?,
            Type::Optional(_) => Value::Null,
            Type::List(inner) => {
                let (offset, count, layout) = (self.number(at, 4), self.number(at + 4, 4), type_of(inner)?.1);
                self.item(offset, count * layout.stride() as u64)?;
                self.values += count as usize * layout.values;
                ensure!(self.values <= 1 << 20, "lists of more than 2^20 values");
                let place = |index| offset as usize + index as usize * layout.stride();
                (0..count).map(|index| self.read(place(index), inner, &mut Sizes::new())).collect::<Result<_>>()?
            }
            Type::Message(inner) => self.message(at, inner)?,
        })
    }

    fn array<'b>(&mut self, at: usize, of: &str, shape: &'b [Value], sizes: &mut Sizes<'b>) -> Result<Value> {
        let (dtype, itemsize) = DTYPES.get(self.body[at + 4] as usize).context("no such dtype")?;
        ensure!(of == "any" || of == *dtype, "{dtype} where {of} was expected");
        ensure!(self.body[at + 5] as usize == shape.len() && self.number(at + 6, 2) == 0, "another head");
        let (mut found, mut product) = (vec![], *itemsize as i64);
        for (index, dimension) in shape.iter().enumerate() {
            let size = self.number(at + 8 + 4 * index, 4);
            let named = dimension.as_str().map(|name| *sizes.entry(name).or_insert(size));
            let expected = named.or(dimension.as_u64());
            ensure!(Some(size) == expected, "a dimension of {size} where {expected:?} was expected");
            product = product.checked_mul(size.max(1) as i64).context("too many items")?; // [B9]
            found.push(size);
        }
        let data = self.item(self.number(at, 4), if found.contains(&0) { 0 } else { product as u64 })?;
        Ok(json!({"dtype": dtype, "shape": found, "items": hex::encode(data)}))
    }
}

/// A float as the vectors have it: by name where JSON has no number for it.
fn float(value: f64) -> Value {
    if value.is_finite() { json!(value) } else { json!(value.to_string().to_lowercase()) }
}
