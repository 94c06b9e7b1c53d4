//! What every client of the wire does, written by docs/reference/wire.md.

use std::collections::HashMap;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::de::{DeserializeOwned, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{Query, Queryable};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session, Wait};

pub mod panda;
pub mod records;

pub const SCHEMA: u64 = 2;
const OLDEST_NS: i64 = 1_000_000_000;
const STATUS_PERIOD: Duration = Duration::from_millis(500);

pub type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// A sample that is not used: the name of its counter, and why.
#[derive(Debug)]
pub struct Rejected(pub &'static str, pub String);

pub fn rejected<T>(reason: &'static str, why: impl ToString) -> Result<T, Rejected> {
    Err(Rejected(reason, why.to_string()))
}

/// Nanoseconds since 1970.
pub fn now_ns() -> i64 {
    let passed = SystemTime::now().duration_since(UNIX_EPOCH);
    passed.expect("the clock is set").as_nanos() as i64
}

/// A client of the router at `endpoint`.
pub fn open_session(endpoint: &str) -> Result<Session, AnyError> {
    let mut config = Config::default();
    config.insert_json5("mode", "\"client\"")?;
    config.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]"))?;
    config.insert_json5("scouting/multicast/enabled", "false")?;
    config.insert_json5("scouting/gossip/enabled", "false")?;
    zenoh::open(config).wait()
}

/// Congestion control, priority, express: the table "Quality of service".
pub type Quality = (CongestionControl, Priority, bool);
pub const STATE: Quality = (CongestionControl::Drop, Priority::InteractiveHigh, false);
pub const MUST_ARRIVE: Quality = (CongestionControl::Block, Priority::RealTime, true);
pub const NEWS: Quality = (CongestionControl::Drop, Priority::Data, false);

#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct Header {
    pub schema: u64,
    pub stamp_wall_ns: i64,
    pub seq: u64,
    #[serde(deserialize_with = "text")]
    pub source: String,
}

#[derive(Serialize)]
struct ClockReply {
    heard_ns: i64,
    said_ns: i64,
}

#[derive(Serialize)]
struct NodeStatus<'a> {
    node: &'a str,
    state: &'a str,
    host: &'a str,
    pid: u32,
    started_wall_ns: i64,
    counters: &'a HashMap<String, u64>,
}

/// A node: liveliness token, clock, status, and samples with headers.
pub struct Node {
    pub session: Session,
    /// The beginning of all keys, such as `vla/panda`.
    pub robot: String,
    name: String,
    source: String,
    counters: HashMap<String, u64>,
    next_seq: HashMap<String, u64>,
    started_ns: i64,
    told: Option<Instant>,
    _clock: Queryable<()>,
    _token: LivelinessToken,
}

impl Node {
    pub fn new(session: Session, robot: &str, name: &str) -> Result<Node, AnyError> {
        let clock = format!("{robot}/clock/{name}");
        let alive = format!("{robot}/alive/{name}");
        Ok(Node {
            _clock: session.declare_queryable(clock).callback(tell_time).wait()?,
            _token: session.liveliness().declare_token(alive).wait()?,
            session,
            robot: robot.to_string(),
            name: name.to_string(),
            source: format!("{name}#{:x}", now_ns()),
            counters: HashMap::new(),
            next_seq: HashMap::new(),
            started_ns: now_ns(),
            told: None,
        })
    }

    /// Put a record with its header.
    pub fn publish<T: Serialize>(
        &mut self,
        key: &str,
        record: &T,
        quality: Quality,
        stamp_ns: i64,
    ) -> Result<(), AnyError> {
        let next = self.next_seq.entry(key.to_string()).or_default();
        let (seq, source) = (*next, self.source.clone());
        *next += 1;
        let header = Header { schema: SCHEMA, stamp_wall_ns: stamp_ns, seq, source };
        let (congestion, priority, express) = quality;
        self.session
            .put(format!("{}/{key}", self.robot), rmp_serde::to_vec_named(record)?)
            .attachment(rmp_serde::to_vec_named(&header)?)
            .encoding(Encoding::from("application/msgpack"))
            .congestion_control(congestion)
            .priority(priority)
            .express(express)
            .wait()
    }

    /// Put the status, twice a second at most.
    pub fn publish_status(&mut self, state: &str) -> Result<(), AnyError> {
        if self.told.is_some_and(|at| at.elapsed() < STATUS_PERIOD) {
            return Ok(());
        }
        self.told = Some(Instant::now());
        let (node, counters) = (self.name.clone(), self.counters.clone());
        let status = NodeStatus {
            node: &node,
            state,
            host: "",
            pid: std::process::id(),
            started_wall_ns: self.started_ns,
            counters: &counters,
        };
        self.publish(&format!("status/{node}"), &status, NEWS, now_ns())
    }

    /// Count a sample that is not used.
    pub fn count(&mut self, stream: &str, reason: &str) {
        let name = format!("refused.{stream}_{reason}");
        *self.counters.entry(name).or_default() += 1;
    }
}

fn tell_time(query: Query) {
    let heard_ns = now_ns();
    let reply = ClockReply { heard_ns, said_ns: now_ns() };
    let bytes = rmp_serde::to_vec_named(&reply).expect("numbers can be written");
    // Who asked may be gone, which is no fault of this node.
    let _ = query.reply(query.key_expr().clone(), bytes).wait();
}

/// Text, and no bytes, which serde would take for it.
pub fn text<'de, D: Deserializer<'de>>(from: D) -> Result<String, D::Error> {
    struct Text;

    impl Visitor<'_> for Text {
        type Value = String;

        fn expecting(&self, to: &mut std::fmt::Formatter) -> std::fmt::Result {
            to.write_str("text")
        }

        fn visit_str<E>(self, found: &str) -> Result<String, E> {
            Ok(found.to_string())
        }
    }

    from.deserialize_any(Text)
}

/// A record of the wire: what its types do not say is checked here.
pub trait Record: DeserializeOwned {
    fn check(&self) -> Result<(), Rejected>;
}

impl Record for Header {
    fn check(&self) -> Result<(), Rejected> {
        if i64::try_from(self.seq).is_err() || self.source.chars().count() > 128 {
            return rejected("invalid", "seq is below 2^63, source has at most 128 characters");
        }
        Ok(())
    }
}

#[derive(Deserialize)]
struct Version {
    schema: u64,
}

impl Record for Version {
    fn check(&self) -> Result<(), Rejected> {
        match self.schema {
            SCHEMA => Ok(()),
            other => rejected("schema", format!("version {other}, this program has {SCHEMA}")),
        }
    }
}

/// The record in some bytes.
pub fn decode<T: Record>(bytes: &[u8]) -> Result<T, Rejected> {
    // serde would take a list of the fields for a map of them.
    if !matches!(bytes.first(), Some(0x80..=0x8f | 0xde | 0xdf)) {
        return rejected("malformed", "not a map");
    }
    let record: T = rmp_serde::from_slice(bytes).or_else(|error| rejected("invalid", error))?;
    record.check()?;
    Ok(record)
}

/// The header in an attachment.
pub fn decode_header(bytes: &[u8]) -> Result<Header, Rejected> {
    decode::<Version>(bytes)?;
    decode(bytes)
}

/// Header and record of a sample.
pub fn read<T: Record>(sample: &Sample) -> Result<(Header, T), Rejected> {
    if sample.kind() != SampleKind::Put {
        return rejected("deleted", "only puts count");
    }
    let Some(attachment) = sample.attachment() else {
        return rejected("no_header", "no attachment");
    };
    let bytes = |found: &ZBytes| found.to_bytes().into_owned();
    Ok((decode_header(&bytes(attachment))?, decode(&bytes(sample.payload()))?))
}

/// Lets the samples of one source through, each once and in order.
#[derive(Default)]
pub struct OneWriter {
    /// Empty: nobody writes.
    pub source: String,
    last: Option<(String, u64)>,
}

impl OneWriter {
    /// Reject a sample that is not the writer's next.
    pub fn check(&self, header: &Header) -> Result<(), Rejected> {
        if !self.source.is_empty() && header.source != self.source {
            return rejected("foreign", format!("{} is writing", self.source));
        }
        if let Some((source, seq)) = &self.last {
            if *source == header.source && header.seq <= *seq {
                return rejected("replayed", format!("sample {} was there before", header.seq));
            }
        }
        if now_ns() - header.stamp_wall_ns > OLDEST_NS {
            return rejected("stale", "it is over a second old");
        }
        Ok(())
    }

    /// Note that the sample is used.
    pub fn accept(&mut self, header: &Header) {
        self.source.clone_from(&header.source);
        self.last = Some((self.source.clone(), header.seq));
    }

    /// The writer fell silent: another one may begin, and the old samples are still old.
    pub fn release(&mut self) {
        self.source.clear();
    }
}
