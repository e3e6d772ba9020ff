//! ZMTP 3.0 with the mechanism NULL over tcp and unix sockets [Z].

use std::io::{BufReader, Error, Read, Result, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::{Arc, Mutex};
use std::thread;

pub type Message = Vec<Vec<u8>>;
type Input = Box<dyn Read + Send>;
type Output = Box<dyn Write + Send>;
const MORE: u8 = 1;
const LONG: u8 = 2;
const COMMAND: u8 = 4;

#[derive(Clone)]
pub struct Writer(Arc<Mutex<Output>>);

pub struct Reader {
    input: BufReader<Input>,
    writer: Writer,
    limit: u64,
}

fn split_tcp(stream: TcpStream) -> Result<(Input, Output)> {
    stream.set_nodelay(true)?;
    Ok((Box::new(stream.try_clone()?), Box::new(stream)))
}

fn split_unix(stream: UnixStream) -> Result<(Input, Output)> {
    Ok((Box::new(stream.try_clone()?), Box::new(stream)))
}

/// Connect a socket of a kind ("SUB", "DEALER") to `tcp://host:port` or `ipc://path`; a frame is limited to some bytes.
pub fn connect(address: &str, kind: &str, limit: u64) -> Result<(Reader, Writer)> {
    let halves = match address.strip_prefix("ipc://") {
        Some(path) => split_unix(UnixStream::connect(path)?)?,
        None => split_tcp(TcpStream::connect(address.trim_start_matches("tcp://"))?)?,
    };
    handshake(halves, kind, limit)
}

/// Accept the peers of an XPUB socket on threads of their own, and return its address; port 0 takes a free one.
pub fn listen(address: &str, limit: u64, on_peer: impl Fn(Reader, Writer) + Send + Sync + 'static) -> Result<String> {
    let on_peer = Arc::new(on_peer);
    let accept = move |halves: Result<(Input, Output)>| {
        let on_peer = on_peer.clone();
        let greet = move || handshake(halves?, "XPUB", limit).map(|(reader, writer)| on_peer(reader, writer));
        drop(thread::spawn(greet)); // a peer that cannot be greeted is none
    };
    if let Some(path) = address.strip_prefix("ipc://") {
        let listener = UnixListener::bind(path)?;
        thread::spawn(move || listener.incoming().for_each(|stream| accept(stream.and_then(split_unix))));
        return Ok(address.to_string());
    }
    let listener = TcpListener::bind(address.trim_start_matches("tcp://"))?;
    let bound = format!("tcp://{}", listener.local_addr()?);
    thread::spawn(move || listener.incoming().for_each(|stream| accept(stream.and_then(split_tcp))));
    Ok(bound)
}

fn handshake((input, mut output): (Input, Output), kind: &str, limit: u64) -> Result<(Reader, Writer)> {
    let (mut ours, mut theirs) = ([0; 64], [0; 64]);
    (ours[0], ours[9], ours[10]) = (0xff, 0x7f, 3);
    ours[12..16].copy_from_slice(b"NULL");
    output.write_all(&ours)?;
    let writer = Writer(Arc::new(Mutex::new(output)));
    let mut reader = Reader { input: BufReader::with_capacity(1 << 16, input), writer: writer.clone(), limit };
    reader.input.read_exact(&mut theirs)?;
    let ready = [b"\x05READY\x0bSocket-Type\0\0\0", &[kind.len() as u8][..], kind.as_bytes()].concat();
    writer.write(&[(COMMAND, &ready)])?;
    let (flags, answer) = reader.frame()?;
    let speaks = theirs[0] == 0xff && theirs[10] >= 3 && theirs[12..32] == ours[12..32];
    let is_ready = flags & COMMAND != 0 && answer.starts_with(b"\x05READY");
    if speaks && is_ready { Ok((reader, writer)) } else { Err(Error::other("not a peer of ZMTP 3 with NULL")) }
}

impl Writer {
    pub fn send(&self, message: &[Vec<u8>]) -> Result<()> {
        let flags = |index| if index + 1 < message.len() { MORE } else { 0 };
        self.write(&message.iter().enumerate().map(|(index, frame)| (flags(index), &frame[..])).collect::<Vec<_>>())
    }

    fn write(&self, frames: &[(u8, &[u8])]) -> Result<()> {
        let mut bytes = vec![];
        for (flags, frame) in frames {
            match u8::try_from(frame.len()) {
                Ok(size) => bytes.extend([*flags, size]),
                Err(_) => bytes.extend([&[flags | LONG], &(frame.len() as u64).to_be_bytes()[..]].concat()),
            }
            bytes.extend_from_slice(frame);
        }
        self.0.lock().unwrap().write_all(&bytes)
    }
}

impl Reader {
    /// The next message; a PING is answered on the way.
    pub fn receive(&mut self) -> Result<Message> {
        let mut message = vec![];
        loop {
            let (flags, frame) = self.frame()?;
            if flags & COMMAND == 0 {
                message.push(frame);
                if flags & MORE == 0 {
                    return Ok(message);
                }
            } else if frame.starts_with(b"\x04PING") && frame.len() >= 7 {
                self.writer.write(&[(COMMAND, &[b"\x04PONG", &frame[7..]].concat())])?;
            }
        }
    }

    fn frame(&mut self) -> Result<(u8, Vec<u8>)> {
        let (mut flags, mut size, mut frame) = ([0], [0; 8], vec![]);
        self.input.read_exact(&mut flags)?;
        self.input.read_exact(&mut size[if flags[0] & LONG == 0 { 7 } else { 0 }..])?;
        let size = u64::from_be_bytes(size);
        let whole = size <= self.limit && (&mut self.input).take(size).read_to_end(&mut frame)? as u64 == size;
        if whole { Ok((flags[0], frame)) } else { Err(Error::other("a frame that is too large, or cut off")) }
    }
}
