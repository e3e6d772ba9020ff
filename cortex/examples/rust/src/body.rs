//! Bodies [B]: values are JSON as in the test vectors; bytes and the items of arrays are hexadecimal there.

use std::collections::HashMap;

use crate::json::{Json, object, text};
use crate::schema::{DTYPES, is_fixed_array, itemsize, kind, scalar_size};
use crate::{Result, ensure};

fn up(position: usize, alignment: usize) -> usize {
    position.div_ceil(alignment) * alignment
}

/// Size and alignment of a type in the block; of a message, given whole or as `{"message": …}` [B1].
pub fn layout(of: &Json) -> Result<(usize, usize)> {
    let (name, inner) = kind(of);
    Ok(match name {
        "enum" => (4, 4),
        "str" | "bytes" | "list" => (8, 4),
        "array" if is_fixed_array(of) => {
            let item = itemsize(inner.text()).unwrap_or(1);
            let sizes = of.get("shape").items().iter().map(|size| size.int() as usize);
            let size = sizes.fold(item, |product, size| product.saturating_mul(size));
            ensure!(size <= 1 << 30, "an array of {size} bytes in a block");
            (size, if size >= 1024 { 64 } else { item })
        }
        "array" => (8 + 4 * of.get("shape").items().len(), 4),
        "optional" => layout(inner).map(|(size, alignment)| (up(alignment + size, alignment), alignment))?,
        "message" => layout(inner)?,
        "name" => {
            let (mut end, mut largest) = (0, 1);
            for field in of.get("fields").items() {
                let (size, alignment) = layout(field.get("type"))?;
                (end, largest) = (up(end, alignment) + size, largest.max(alignment));
            }
            (up(end, largest), largest)
        }
        scalar => scalar_size(scalar).map(|size| (size, size)).unwrap(),
    })
}

/// Bytes from one element of a list to the next.
fn stride(of: &Json) -> Result<usize> {
    layout(of).map(|(size, alignment)| up(size, alignment).max(1))
}

/// Fields of a message, and where they begin after it.
fn places(schema: &Json) -> Result<Vec<(&Json, usize)>> {
    let mut end = 0;
    let place = |field| {
        let (size, alignment) = layout(Json::get(field, "type"))?;
        end = up(end, alignment) + size;
        Ok((field, end - size))
    };
    schema.get("fields").items().iter().map(place).collect()
}

pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

pub fn unhex(text: &str) -> Result<Vec<u8>> {
    let pair = |at| text.get(at..at + 2).and_then(|pair| u8::from_str_radix(pair, 16).ok());
    (0..text.len()).step_by(2).map(|at| pair(at).ok_or("not hexadecimal".into())).collect()
}

/// Write a body. It is read once more, so that nothing is sent that a receiver must reject.
pub fn encode(schema: &Json, value: &Json) -> Result<Vec<u8>> {
    let mut body = vec![0; up(layout(schema)?.0, 8)];
    write_message(&mut body, 0, schema, value)?;
    decode(schema, &body)?;
    Ok(body)
}

fn write_message(body: &mut Vec<u8>, at: usize, schema: &Json, value: &Json) -> Result<()> {
    places(schema)?.iter().try_for_each(|(field, offset)| {
        let name = field.get("name").text();
        let given = value.members().iter().find(|(key, _)| key == name).ok_or(format!("no value for {name}"))?;
        write(body, at + offset, field.get("type"), &given.1).map_err(|error| format!("{name}: {error}"))
    })
}

/// Append an item to the tail; its offset is 0 if it is empty [B6].
fn append(body: &mut Vec<u8>, data: &[u8], alignment: usize) -> u32 {
    if data.is_empty() {
        return 0;
    }
    body.resize(up(body.len(), alignment), 0);
    body.extend_from_slice(data);
    (body.len() - data.len()) as u32
}

fn put(body: &mut [u8], at: usize, bytes: &[u8]) {
    body[at..at + bytes.len()].copy_from_slice(bytes);
}

fn write(body: &mut Vec<u8>, at: usize, of: &Json, value: &Json) -> Result<()> {
    let (name, inner) = kind(of);
    let item = |body: &mut Vec<u8>, data: &[u8]| {
        let offset = append(body, data, 8);
        put(body, at, &offset.to_le_bytes());
        put(body, at + 4, &(data.len() as u32).to_le_bytes());
    };
    match (name, value) {
        ("str", Json::Text(text)) => item(body, text.as_bytes()),
        ("bytes", Json::Text(text)) => item(body, &unhex(text)?),
        ("enum", Json::Text(name)) => {
            let (_, number) = of.get("values").members().iter().find(|(key, _)| key == name).ok_or("no such value")?;
            put(body, at, &(number.int() as i32).to_le_bytes());
        }
        ("array", Json::Object(_)) => {
            let data = unhex(value.get("items").text())?;
            if is_fixed_array(of) {
                ensure!(data.len() == layout(of)?.0 && value.get("shape") == of.get("shape"), "another shape");
                put(body, at, &data);
                return Ok(());
            }
            let shape = value.get("shape").items();
            ensure!(shape.len() == of.get("shape").items().len(), "another number of dimensions");
            let dtype = value.get("dtype").text();
            let code = DTYPES.iter().position(|(name, _)| *name == dtype).ok_or("no such dtype")?;
            let offset = append(body, &data, if data.len() >= 1024 { 64 } else { 8 });
            put(body, at, &offset.to_le_bytes());
            put(body, at + 4, &[code as u8, shape.len() as u8]);
            for (index, size) in shape.iter().enumerate() {
                put(body, at + 8 + 4 * index, &(size.int() as u32).to_le_bytes());
            }
        }
        ("optional", Json::Null) => {}
        ("optional", value) => {
            body[at] = 1;
            write(body, at + layout(inner)?.1, inner, value)?;
        }
        ("list", Json::List(items)) => {
            let stride = stride(inner)?;
            let start = append(body, &vec![0; stride * items.len()], layout(inner)?.1.max(8));
            put(body, at, &start.to_le_bytes());
            put(body, at + 4, &(items.len() as u32).to_le_bytes());
            for (index, item) in items.iter().enumerate() {
                write(body, start as usize + index * stride, inner, item)?;
            }
        }
        ("message", Json::Object(_)) => write_message(body, at, inner, value)?,
        ("bool", Json::Bool(value)) => body[at] = *value as u8,
        ("float32" | "float64", value) => {
            let number = match value {
                Json::Int(value) => *value as f64,
                Json::Float(value) => *value,
                other => other.text().parse().map_err(|_| format!("{other} is not a number"))?,
            };
            let bytes = if name == "float32" { &(number as f32).to_le_bytes()[..] } else { &number.to_le_bytes() };
            put(body, at, bytes);
        }
        (name, Json::Int(value)) if name.contains("int") => {
            let size = scalar_size(name).unwrap();
            let low = if name.starts_with('u') { 0 } else { -1 << (8 * size - 1) };
            ensure!((low..low + (1 << (8 * size))).contains(value), "{value} is not a {name}");
            put(body, at, &value.to_le_bytes()[..size]);
        }
        (name, value) => return Err(format!("{value} where {name} was expected")),
    }
    Ok(())
}

/// Read a body, or say what is wrong with it.
pub fn decode(schema: &Json, body: &[u8]) -> Result<Json> {
    let block = up(layout(schema)?.0, 8);
    ensure!(body.len() >= block && body.len() < 1 << 32, "a body of {} bytes, its block has {block}", body.len());
    let mut reader = Reader { body, claimed: block, values: 0 };
    let value = reader.message(0, schema)?;
    ensure!(has_tail(schema) || body.len() == block, "a body longer than its fixed size");
    Ok(value)
}

/// Whether a body may have a tail [B2].
pub fn has_tail(of: &Json) -> bool {
    match kind(of) {
        ("str" | "bytes" | "list", _) => true,
        ("array", _) => !is_fixed_array(of),
        ("optional" | "message", inner) => has_tail(inner),
        ("name", _) => of.get("fields").items().iter().any(|field| has_tail(field.get("type"))),
        _ => false,
    }
}

/// How many values an element of a list counts for [B10].
fn weight(of: &Json) -> usize {
    match kind(of) {
        ("optional" | "message", inner) => weight(inner),
        ("name", _) => 1 + of.get("fields").items().iter().map(|field| weight(field.get("type"))).sum::<usize>(),
        _ => 1,
    }
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

    /// Bytes of the tail: within the body, and with all others not longer than it [B7, B8].
    fn item(&mut self, offset: usize, size: Option<usize>) -> Result<&'a [u8]> {
        let size = size.filter(|size| *size <= self.body.len()).ok_or("an item beyond the body")?;
        ensure!(offset + size <= self.body.len(), "an item beyond the body");
        self.claimed += size;
        ensure!(self.claimed <= self.body.len(), "items that share bytes");
        Ok(&self.body[offset..offset + size])
    }

    fn message(&mut self, at: usize, schema: &Json) -> Result<Json> {
        let (mut sizes, mut members) = (HashMap::new(), Vec::new());
        for (field, offset) in places(schema)? {
            let name = field.get("name").text();
            let value = self.read(at + offset, field.get("type"), &mut sizes);
            members.push((name.to_string(), value.map_err(|error| format!("{name}: {error}"))?));
        }
        Ok(Json::Object(members))
    }

    fn read<'b>(&mut self, at: usize, of: &'b Json, sizes: &mut HashMap<&'b str, i128>) -> Result<Json> {
        let (name, inner) = kind(of);
        let (offset, count) = match name {
            "str" | "bytes" | "list" => (self.number(at, 4) as usize, self.number(at + 4, 4) as usize),
            _ => (0, 0),
        };
        Ok(match name {
            "str" => text(str::from_utf8(self.item(offset, Some(count))?).map_err(|error| error.to_string())?),
            "bytes" => Json::Text(hex(self.item(offset, Some(count))?)),
            "enum" => {
                let number = Json::Int(self.number(at, 4) as i32 as i128);
                let named = of.get("values").members().iter().find(|(_, value)| *value == number);
                text(&named.ok_or(format!("no value {number}"))?.0)
            }
            "array" => self.array(at, of, sizes)?,
            "bool" | "optional" => {
                let flag = self.body[at];
                ensure!(flag <= 1, "a truth value of {flag}");
                match (name, flag) {
                    ("bool", _) => Json::Bool(flag == 1),
                    (_, 0) => Json::Null,
                    _ => self.read(at + layout(inner)?.1, inner, sizes)?,
                }
            }
            "list" => {
                let stride = stride(inner)?;
                self.item(offset, count.checked_mul(stride))?;
                self.values += count * weight(inner);
                ensure!(self.values <= 1 << 20, "lists of more than 2^20 values");
                let element = |index| self.read(offset + index * stride, inner, &mut HashMap::new());
                Json::List((0..count).map(element).collect::<Result<_>>()?)
            }
            "message" => self.message(at, inner)?,
            scalar => {
                let size = scalar_size(scalar).unwrap();
                let (bits, shift) = (self.number(at, size), 64 - 8 * size);
                match &scalar[..1] {
                    "u" => Json::Int(bits as i128),
                    "i" => Json::Int(((bits << shift) as i64 >> shift) as i128),
                    _ => {
                        let value = if size == 4 { f32::from_bits(bits as u32) as f64 } else { f64::from_bits(bits) };
                        let name = if value.is_nan() { "nan".into() } else { value.to_string() };
                        if value.is_finite() { Json::Float(value) } else { Json::Text(name) }
                    }
                }
            }
        })
    }

    fn array<'b>(&mut self, at: usize, of: &'b Json, sizes: &mut HashMap<&'b str, i128>) -> Result<Json> {
        let (wanted, shape) = (of.get("array").text(), of.get("shape").items());
        let fixed = is_fixed_array(of);
        let (data, dtype, shape) = if fixed {
            (&self.body[at..at + layout(of)?.0], wanted, shape.to_vec())
        } else {
            let (offset, rank, reserved) = (self.number(at, 4), self.number(at + 5, 1), self.number(at + 6, 2));
            let (dtype, itemsize) = *DTYPES.get(self.body[at + 4] as usize).ok_or("no such dtype")?;
            ensure!([dtype, "any"].contains(&wanted), "dtype {dtype}, expected {wanted}");
            ensure!(rank as usize == shape.len() && reserved == 0, "{rank} dimensions");
            let (mut product, mut capacity, mut actual) = (Some(itemsize), Some(itemsize as i64), Vec::new());
            for (index, size) in shape.iter().enumerate() {
                let found = self.number(at + 8 + 4 * index, 4) as i128;
                let expected =
                    if let Json::Text(name) = size { *sizes.entry(name).or_insert(found) } else { size.int() };
                ensure!(found == expected, "a dimension of {found}, expected {expected}");
                product = product.and_then(|product| product.checked_mul(found as usize));
                capacity = capacity.and_then(|product| product.checked_mul(found.max(1) as i64));
                actual.push(Json::Int(found));
            }
            product = if actual.contains(&Json::Int(0)) { capacity.and(Some(0)) } else { product };
            (self.item(offset as usize, product)?, dtype, actual)
        };
        Ok(object(&[("dtype", text(dtype)), ("shape", Json::List(shape)), ("items", Json::Text(hex(data)))]))
    }
}
