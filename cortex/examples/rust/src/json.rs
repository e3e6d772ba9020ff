//! JSON: schemas, the values of messages, and the test vectors. Objects keep the order of their keys.

use std::fmt;

use crate::Result;

#[derive(Clone, Debug, PartialEq)]
pub enum Json {
    Null,
    Bool(bool),
    Int(i128),
    Float(f64),
    Text(String),
    List(Vec<Json>),
    Object(Vec<(String, Json)>),
}

pub fn object(fields: &[(&str, Json)]) -> Json {
    Json::Object(fields.iter().map(|(name, value)| (name.to_string(), value.clone())).collect())
}

pub fn int(number: u64) -> Json {
    Json::Int(number as i128)
}

pub fn text(text: impl Into<String>) -> Json {
    Json::Text(text.into())
}

impl Json {
    pub fn parse(text: &str) -> Result<Json> {
        let mut rest = text;
        let value = value(&mut rest, 0)?;
        if rest.trim().is_empty() { Ok(value) } else { Err(format!("JSON goes on: {rest}")) }
    }

    /// The member of an object; `Null` if there is none.
    pub fn get(&self, name: &str) -> &Json {
        self.members().iter().find(|(key, _)| key == name).map_or(&Json::Null, |(_, value)| value)
    }

    pub fn members(&self) -> &[(String, Json)] {
        if let Json::Object(members) = self { members } else { &[] }
    }

    pub fn items(&self) -> &[Json] {
        if let Json::List(items) = self { items } else { &[] }
    }

    pub fn text(&self) -> &str {
        if let Json::Text(text) = self { text } else { "" }
    }

    pub fn int(&self) -> i128 {
        if let Json::Int(value) = self { *value } else { 0 }
    }
}

impl fmt::Display for Json {
    fn fmt(&self, out: &mut fmt::Formatter) -> fmt::Result {
        let join = |parts: &mut dyn Iterator<Item = String>| parts.collect::<Vec<_>>().join(",");
        match self {
            Json::Null => write!(out, "null"),
            Json::Bool(value) => write!(out, "{value}"),
            Json::Int(value) => write!(out, "{value}"),
            Json::Float(value) => write!(out, "{value:?}"),
            Json::Text(text) => write!(out, "{}", quote(text)),
            Json::List(items) => write!(out, "[{}]", join(&mut items.iter().map(Json::to_string))),
            Json::Object(members) => {
                write!(out, "{{{}}}", join(&mut members.iter().map(|(key, value)| format!("{}:{value}", quote(key)))))
            }
        }
    }
}

fn quote(text: &str) -> String {
    let escape = |letter| match letter {
        '"' | '\\' => format!("\\{letter}"),
        '\0'..='\x1f' => format!("\\u{:04x}", letter as u32),
        _ => letter.to_string(),
    };
    format!("\"{}\"", text.chars().map(escape).collect::<String>())
}

fn take(rest: &mut &str, token: &str) -> bool {
    let found = rest.trim_start().strip_prefix(token);
    *rest = found.unwrap_or(rest);
    found.is_some()
}

fn expect(rest: &mut &str, token: &str) -> Result<()> {
    if take(rest, token) { Ok(()) } else { Err(format!("JSON: {token} expected at {rest:.40}")) }
}

fn value(rest: &mut &str, depth: usize) -> Result<Json> {
    let (mut items, mut members) = (vec![], vec![]);
    if depth > 64 {
        return Err("JSON is nested too deeply".into());
    } else if take(rest, "{") {
        while !take(rest, "}") {
            let open = members.is_empty() || take(rest, ",");
            let key = if open && take(rest, "\"") { string(rest)? } else { return Err("JSON: no key".into()) };
            expect(rest, ":")?;
            members.push((key, value(rest, depth + 1)?));
        }
        return Ok(Json::Object(members));
    } else if take(rest, "[") {
        while !take(rest, "]") {
            if !items.is_empty() {
                expect(rest, ",")?;
            }
            items.push(value(rest, depth + 1)?);
        }
        return Ok(Json::List(items));
    } else if take(rest, "\"") {
        return string(rest).map(Json::Text);
    }
    for (name, value) in [("null", Json::Null), ("true", Json::Bool(true)), ("false", Json::Bool(false))] {
        if take(rest, name) {
            return Ok(value);
        }
    }
    let start = rest.trim_start();
    let (number, after) = start.split_at(start.find(|c| !"+-.eE0123456789".contains(c)).unwrap_or(start.len()));
    *rest = after;
    let float = |_| number.parse().map(Json::Float).map_err(|_| format!("JSON: {number:?} is not a number"));
    number.parse().map(Json::Int).or_else(float)
}

/// The rest of a string whose first quote has been read.
fn string(rest: &mut &str) -> Result<String> {
    let (mut units, mut letters) = (vec![], rest.chars());
    while let Some(letter) = letters.next() {
        let letter = match (letter, if letter == '\\' { letters.next() } else { None }) {
            ('"', _) => {
                *rest = letters.as_str();
                return String::from_utf16(&units).map_err(|error| error.to_string());
            }
            (_, Some('u')) => {
                let code: String = letters.by_ref().take(4).collect();
                units.push(u16::from_str_radix(&code, 16).map_err(|error| error.to_string())?);
                continue;
            }
            (_, Some(letter)) => "bfnrt".find(letter).map_or(letter, |at| ['\x08', '\x0c', '\n', '\r', '\t'][at]),
            (letter, None) => letter,
        };
        units.extend_from_slice(letter.encode_utf16(&mut [0; 2]));
    }
    Err("JSON ends within a string".into())
}
