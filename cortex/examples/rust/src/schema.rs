//! Schemas: their canonical text, what they may say, their fingerprint [S], and how a type lies in a block [B1].

use anyhow::{Result, bail, ensure};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

const BLOCK_MAX: usize = 1 << 30;

#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
#[rustfmt::skip]
pub enum Dtype {
    Bool, Int8, Int16, Int32, Int64, UInt8, UInt16, UInt32, UInt64, Float16, Float32, Float64, Complex64, Complex128,
    Str, Bytes, Any,
}

impl Dtype {
    /// By their numbers in a body.
    #[rustfmt::skip]
    pub const CODES: [Dtype; 14] = {
        use Dtype::*;
        [Bool, Int8, Int16, Int32, Int64, UInt8, UInt16, UInt32, UInt64, Float16, Float32, Float64, Complex64, Complex128]
    };

    pub fn itemsize(self) -> usize {
        [1, 1, 2, 4, 8, 1, 2, 4, 8, 2, 4, 8, 8, 16].get(self as usize).copied().unwrap_or(1)
    }

    pub fn is_signed(self) -> bool {
        (Dtype::Int8 as u8..=Dtype::Int64 as u8).contains(&(self as u8))
    }

    pub fn is_unsigned(self) -> bool {
        (Dtype::UInt8 as u8..=Dtype::UInt64 as u8).contains(&(self as u8))
    }
}

#[derive(Debug, Deserialize, Serialize)]
pub struct Schema {
    pub name: String,
    pub fields: Vec<Field>,
}

#[derive(Debug, Deserialize, Serialize)]
pub struct Field {
    pub name: String,
    #[serde(rename = "type")]
    pub of: Type,
    unit: String,
    frame: String,
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(untagged)]
pub enum Type {
    Plain(Dtype),
    Enum { r#enum: String, values: Map<String, Value> },
    Array { array: Dtype, shape: Vec<Dimension> },
    Optional { optional: Box<Type> },
    List { list: Box<Type> },
    Message { message: Schema },
}

#[derive(Debug, Deserialize, Serialize)]
#[serde(untagged)]
pub enum Dimension {
    Size(u32),
    Name(String),
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

impl Type {
    pub fn layout(&self) -> Layout {
        let (size, alignment, has_tail) = match self {
            Type::Plain(Dtype::Str | Dtype::Bytes) | Type::List { .. } => (8, 4, true),
            Type::Plain(dtype) => (dtype.itemsize(), dtype.itemsize(), false),
            Type::Enum { .. } => (4, 4, false),
            Type::Array { array, shape } => match fixed_shape(*array, shape) {
                None => (8 + 4 * shape.len(), 4, true),
                Some(sizes) => {
                    let size = sizes.iter().fold(array.itemsize(), |all, size| (all * size).min(BLOCK_MAX + 1));
                    (size, if size >= 1024 { 64 } else { array.itemsize() }, false)
                }
            },
            Type::Optional { optional } => {
                let inner = optional.layout();
                return Layout { size: (inner.alignment + inner.size).next_multiple_of(inner.alignment), ..inner };
            }
            Type::Message { message } => return message.layout(),
        };
        Layout { size, alignment, has_tail, values: 1 }
    }

    /// Count the fields, enum values and dimensions in a type, unless it is over the limits [S4].
    fn count(&self, depth: usize) -> Result<usize> {
        ensure!(depth <= 8, "nested more than 8 deep");
        match self {
            Type::Plain(Dtype::Float16 | Dtype::Complex64 | Dtype::Complex128 | Dtype::Any) => {
                bail!("{self:?} in a field")
            }
            Type::Plain(_) => Ok(0),
            Type::Enum { values, .. } => Ok(values.len()),
            Type::Array { array, shape } => {
                let is_one =
                    shape.len() <= 32 && self.layout().size <= BLOCK_MAX && !matches!(array, Dtype::Str | Dtype::Bytes);
                ensure!(is_one, "an array of {} dimensions of {array:?}", shape.len());
                Ok(shape.len())
            }
            Type::Optional { optional: inner } | Type::List { list: inner } => inner.count(depth + 1),
            Type::Message { message } => message.count(depth + 1),
        }
    }
}

/// The shape of an array that lies in the block.
pub fn fixed_shape(dtype: Dtype, shape: &[Dimension]) -> Option<Vec<usize>> {
    let size = |dimension: &Dimension| match dimension {
        Dimension::Size(size) => Some(*size as usize),
        Dimension::Name(_) => None,
    };
    if dtype == Dtype::Any { None } else { shape.iter().map(size).collect() }
}

impl Schema {
    /// Read a canonical text [S1].
    pub fn parse(text: &str) -> Result<Schema> {
        ensure!(text.len() <= 1 << 16, "a schema of {} bytes", text.len());
        let schema: Schema = serde_json::from_str(text)?;
        ensure!(schema.to_json() == text, "a schema that is not canonical");
        let parts = schema.count(1)?;
        ensure!(parts <= 2048, "a schema of {parts} fields, values and dimensions");
        Ok(schema)
    }

    pub fn to_json(&self) -> String {
        serde_json::to_string(self).unwrap()
    }

    /// The fingerprint of the type [S6].
    pub fn fingerprint(&self) -> u64 {
        u64::from_le_bytes(hash(self.to_json().as_bytes()))
    }

    /// Whether a message has a stamp of its own [H3].
    pub fn is_stamped(&self) -> bool {
        let is_stamp = |of: &Type| matches!(of, Type::Plain(dtype) if dtype.is_signed() || dtype.is_unsigned());
        self.fields.iter().any(|field| field.name == "stamp_ns" && is_stamp(&field.of))
    }

    /// The fields of a message, and where they begin after it.
    pub fn places(&self) -> Vec<(&Field, usize)> {
        let mut end: usize = 0;
        let place = |field: &'_ Field| {
            let layout = field.of.layout();
            end = end.next_multiple_of(layout.alignment) + layout.size;
            end - layout.size
        };
        let offsets: Vec<usize> = self.fields.iter().map(place).collect();
        self.fields.iter().zip(offsets).collect()
    }

    pub fn layout(&self) -> Layout {
        let mut whole = Layout { size: 0, alignment: 1, has_tail: false, values: 1 };
        for (field, offset) in self.places() {
            let inner = field.of.layout();
            whole.size = offset + inner.size;
            whole.alignment = whole.alignment.max(inner.alignment);
            whole.has_tail |= inner.has_tail;
            whole.values += inner.values;
        }
        Layout { size: whole.size.next_multiple_of(whole.alignment), ..whole }
    }

    fn count(&self, depth: usize) -> Result<usize> {
        ensure!(self.fields.len() <= 256 && depth <= 8, "a message of {} fields, {depth} deep", self.fields.len());
        let inner: usize = self.fields.iter().map(|field| field.of.count(depth)).sum::<Result<_>>()?;
        ensure!(self.layout().size <= BLOCK_MAX, "a block of more than {BLOCK_MAX} bytes");
        Ok(self.fields.len() + inner)
    }
}

/// BLAKE2b with a digest of 8 bytes.
pub fn hash(data: &[u8]) -> [u8; 8] {
    blake2b_simd::Params::new().hash_length(8).hash(data).as_bytes().try_into().unwrap()
}
