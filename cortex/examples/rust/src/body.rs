//! Bodies [B]: values are JSON as in the test vectors; bytes and the items of arrays are hexadecimal there.

use std::collections::HashMap;

use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;
use serde_json::{Map, Value, json};

use crate::schema::{Dimension, Dtype, Schema, Type, fixed_shape};

/// Write a body. It is read once more, so that nothing is sent that a receiver must reject.
pub fn encode(schema: &Schema, value: &Value) -> Result<Vec<u8>> {
    let mut body = vec![0; schema.layout().size.next_multiple_of(8)];
    write_message(&mut body, 0, schema, value)?;
    decode(schema, &body)?;
    Ok(body)
}

fn write_message(body: &mut Vec<u8>, at: usize, schema: &Schema, value: &Value) -> Result<()> {
    for (field, offset) in schema.places() {
        let given = value.get(&field.name).with_context(|| format!("no value for {}", field.name))?;
        write(body, at + offset, &field.of, given).with_context(|| field.name.clone())?;
    }
    Ok(())
}

fn put(body: &mut [u8], at: usize, bytes: &[u8]) {
    body[at..at + bytes.len()].copy_from_slice(bytes);
}

/// Append an item to the tail, and put its offset into the block: 0 if it is empty [B6].
fn append(body: &mut Vec<u8>, at: usize, data: &[u8], alignment: usize) -> usize {
    let mut start = 0;
    if !data.is_empty() {
        start = body.len().next_multiple_of(alignment);
        body.resize(start, 0);
        body.extend_from_slice(data);
    }
    put(body, at, &(start as u32).to_le_bytes());
    start
}

fn write(body: &mut Vec<u8>, at: usize, of: &Type, value: &Value) -> Result<()> {
    match (of, value) {
        (Type::Plain(dtype @ (Dtype::Str | Dtype::Bytes)), Value::String(text)) => {
            let data = if *dtype == Dtype::Str { text.clone().into_bytes() } else { hex::decode(text)? };
            append(body, at, &data, 8);
            put(body, at + 4, &(data.len() as u32).to_le_bytes());
        }
        (Type::Plain(Dtype::Bool), Value::Bool(value)) => body[at] = *value as u8,
        (Type::Plain(dtype @ (Dtype::Float32 | Dtype::Float64)), value) => {
            let number = value.as_f64().or_else(|| value.as_str()?.parse().ok()).context("not a number")?;
            match dtype {
                Dtype::Float32 => put(body, at, &(number as f32).to_le_bytes()),
                _ => put(body, at, &number.to_le_bytes()),
            }
        }
        (Type::Plain(dtype), Value::Number(number)) if dtype.is_signed() || dtype.is_unsigned() => {
            let number = number.as_i64().map(i128::from).or(number.as_u64().map(i128::from));
            let (number, size) = (number.context("not an integer")?, dtype.itemsize());
            let low = if dtype.is_signed() { -1 << (8 * size - 1) } else { 0 };
            ensure!((low..low + (1 << (8 * size))).contains(&number), "{number} is not of {dtype:?}");
            put(body, at, &number.to_le_bytes()[..size]);
        }
        (Type::Enum { values, .. }, Value::String(name)) => {
            let number = values.get(name).and_then(Value::as_i64).with_context(|| format!("no value {name}"))?;
            put(body, at, &(number as i32).to_le_bytes());
        }
        (Type::Array { array, shape }, Value::Object(_)) => {
            let data = hex::decode(value["items"].as_str().context("an array without items")?)?;
            let sizes = Vec::<u32>::deserialize(&value["shape"])?;
            if fixed_shape(*array, shape).is_some() {
                ensure!(data.len() == of.layout().size && json!(sizes) == json!(shape), "another shape");
                put(body, at, &data);
                return Ok(());
            }
            ensure!(sizes.len() == shape.len(), "another number of dimensions");
            append(body, at, &data, if data.len() >= 1024 { 64 } else { 8 });
            put(body, at + 4, &[Dtype::deserialize(&value["dtype"])? as u8, sizes.len() as u8]);
            put(body, at + 8, &sizes.iter().flat_map(|size| size.to_le_bytes()).collect::<Vec<_>>());
        }
        (Type::Optional { .. }, Value::Null) => {}
        (Type::Optional { optional }, value) => {
            body[at] = 1;
            write(body, at + optional.layout().alignment, optional, value)?;
        }
        (Type::List { list }, Value::Array(items)) => {
            let layout = list.layout();
            let start = append(body, at, &vec![0; layout.stride() * items.len()], layout.alignment.max(8));
            put(body, at + 4, &(items.len() as u32).to_le_bytes());
            for (index, item) in items.iter().enumerate() {
                write(body, start + index * layout.stride(), list, item)?;
            }
        }
        (Type::Message { message }, value) => write_message(body, at, message, value)?,
        (of, value) => bail!("{value} where {of:?} was expected"),
    }
    Ok(())
}

/// Read a body, or say what is wrong with it.
pub fn decode(schema: &Schema, body: &[u8]) -> Result<Value> {
    let layout = schema.layout();
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

    fn message(&mut self, at: usize, schema: &Schema) -> Result<Value> {
        let (mut sizes, mut members) = (HashMap::new(), Map::new());
        for (field, offset) in schema.places() {
            let value = self.read(at + offset, &field.of, &mut sizes).with_context(|| field.name.clone())?;
            members.insert(field.name.clone(), value);
        }
        Ok(Value::Object(members))
    }

    /// Read a value; `sizes` are those of the dimensions with names in this message [B4].
    fn read<'b>(&mut self, at: usize, of: &'b Type, sizes: &mut HashMap<&'b str, u64>) -> Result<Value> {
        Ok(match of {
            Type::Plain(dtype @ (Dtype::Str | Dtype::Bytes)) => {
                let data = self.item(self.number(at, 4), self.number(at + 4, 4))?;
                json!(if *dtype == Dtype::Str { str::from_utf8(data)?.to_string() } else { hex::encode(data) })
            }
            Type::Plain(Dtype::Bool) => json!(self.flag(at)?),
            Type::Plain(dtype) => {
                let size = dtype.itemsize();
                let (bits, shift) = (self.number(at, size), 64 - 8 * size);
                match dtype {
                    Dtype::Float32 => float(f32::from_bits(bits as u32) as f64),
                    Dtype::Float64 => float(f64::from_bits(bits)),
                    _ if dtype.is_signed() => json!((bits << shift) as i64 >> shift),
                    _ => json!(bits),
                }
            }
            Type::Enum { values, .. } => {
                let number = json!(self.number(at, 4) as i32);
                let (name, _) = values.iter().find(|(_, value)| **value == number).context("a number without name")?;
                json!(name)
            }
            Type::Array { array, shape } => self.array(at, *array, shape, of.layout().size, sizes)?,
            Type::Optional { optional } if self.flag(at)? => {
                self.read(at + optional.layout().alignment, optional, sizes)?
            }
            Type::Optional { .. } => Value::Null,
            Type::List { list } => {
                let (offset, count, layout) = (self.number(at, 4), self.number(at + 4, 4), list.layout());
                self.item(offset, count * layout.stride() as u64)?;
                self.values += count as usize * layout.values;
                ensure!(self.values <= 1 << 20, "lists of more than 2^20 values");
                let place = |index| offset as usize + index as usize * layout.stride();
                let elements = (0..count).map(|index| self.read(place(index), list, &mut HashMap::new()));
                Value::Array(elements.collect::<Result<_>>()?)
            }
            Type::Message { message } => self.message(at, message)?,
        })
    }

    fn array<'b>(
        &mut self,
        at: usize,
        array: Dtype,
        shape: &'b [Dimension],
        size: usize,
        sizes: &mut HashMap<&'b str, u64>,
    ) -> Result<Value> {
        if fixed_shape(array, shape).is_some() {
            let items = hex::encode(&self.body[at..at + size]);
            return Ok(json!({"dtype": array, "shape": shape, "items": items}));
        }
        let dtype = Dtype::CODES.get(self.body[at + 4] as usize).context("no such dtype")?;
        ensure!(array == Dtype::Any || array == *dtype, "{dtype:?} where {array:?} was expected");
        ensure!(self.body[at + 5] as usize == shape.len() && self.number(at + 6, 2) == 0, "another head");
        let (mut found, mut product) = (vec![], dtype.itemsize() as i64);
        for (index, dimension) in shape.iter().enumerate() {
            let size = self.number(at + 8 + 4 * index, 4);
            let expected = match dimension {
                Dimension::Size(size) => *size as u64,
                Dimension::Name(name) => *sizes.entry(name).or_insert(size),
            };
            ensure!(size == expected, "a dimension of {size} where {expected} was expected");
            product = product.checked_mul(size.max(1) as i64).context("too many items")?; // [B9]
            found.push(size);
        }
        let size = if found.contains(&0) { 0 } else { product };
        let data = self.item(self.number(at, 4), size as u64)?;
        Ok(json!({"dtype": dtype, "shape": found, "items": hex::encode(data)}))
    }
}

/// A float as the vectors have it: by name where JSON has no number for it.
fn float(value: f64) -> Value {
    if value.is_finite() { json!(value) } else { json!(value.to_string().to_lowercase()) }
}
