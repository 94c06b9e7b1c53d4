//! A model worker: draws circles in the air as long as the task's prompt is "circle".
//!
//!     cargo run --release --bin worker -- [ENDPOINT] [ROBOT]
//!     vla-zenoh use circles && vla-zenoh prompt circle && vla-zenoh activate

use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

use serde_json::{json, Value};
use sha2::{Digest, Sha256};
use vla_wire::records::{ActionChunk, PoseState, Task};
use vla_wire::{now_ns, open_session, read, AnyError, Header, Node, Record, MUST_ARRIVE, NEWS};
use zenoh::query::Query;
use zenoh::Wait;

const WORKER: &str = "circles";
const STEP_S: f64 = 0.1;
const STEPS: usize = 8;
const RADIUS_M: f64 = 0.05;
const TURN_S: f64 = 6.0;
const VALID_NS: i64 = 1_000_000_000;
const SPEC_PERIOD: Duration = Duration::from_secs(1);

/// A step: x, y, z in m and a quaternion, in the base frame; the gripper stays as it is.
fn spec() -> Value {
    json!({
        "name": WORKER,
        "observation": {
            "cameras": [],
            "state": ["pose"],
            "prompt": true,
            "max_skew_s": 0.1,
            "max_age_s": 0.5,
        },
        "action": {
            "horizon": STEPS,
            "dt_s": STEP_S,
            "kind": "absolute",
            "frame": "base",
            "anchor": "goal",
            "relative_to": "previous",
            "controller": null,
            "rotation": "quaternion",
            "position_scale_m": 1.0,
            "gripper": "none",
            "gripper_open_is_high": true,
            "gripper_threshold": 0.5,
            "normalisation": null,
            "pace": "steady",
            "space": "tcp",
            "joints": [],
        },
    })
}

/// The first 16 hex digits of SHA-256 of the spec as JSON, keys sorted.
fn hash(spec: &Value) -> String {
    let digest = Sha256::digest(spec.to_string());
    digest.iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

/// The newest header and record of a key.
struct Newest<T>(Arc<Mutex<Option<(Header, T)>>>);

impl<T: Record + Clone + Send + 'static> Newest<T> {
    fn new(node: &Node, key: &str) -> Result<Newest<T>, AnyError> {
        let found = Newest(Arc::default());
        let kept = found.0.clone();
        let keep = move |sample| match read(&sample) {
            Ok(record) => *kept.lock().expect("nobody panics with it") = Some(record),
            Err(rejected) => eprintln!("{rejected:?}"),
        };
        let key = format!("{}/{key}", node.robot);
        node.session.declare_subscriber(key).callback(keep).background().wait()?;
        Ok(found)
    }

    fn get(&self) -> Option<(Header, T)> {
        self.0.lock().expect("nobody panics with it").clone()
    }
}

/// The circle of an episode: where it began, and when.
struct Model {
    centre_m: [f64; 3],
    quat_xyzw: [f64; 4],
    began: Option<Instant>,
}

impl Model {
    fn reset(pose: &PoseState, prompt: &str) -> Model {
        let [x, y, z] = pose.position_m;
        Model {
            centre_m: [x, y - RADIUS_M, z],
            quat_xyzw: pose.quat_xyzw,
            began: (prompt == "circle").then(Instant::now),
        }
    }

    /// Rows of x, y, z and the quaternion, beginning now.
    fn infer(&self) -> Vec<Vec<f64>> {
        let passed_s = self.began.map_or(0.0, |at| at.elapsed().as_secs_f64());
        let moves = f64::from(u8::from(self.began.is_some()));
        let row = |step: usize| {
            let at_s = passed_s + moves * STEP_S * (step + 1) as f64;
            let (sin, cos) = (at_s / TURN_S * std::f64::consts::TAU).sin_cos();
            let [x, y, z] = self.centre_m;
            let place = [x, y + RADIUS_M * cos, z + RADIUS_M * sin];
            [&place[..], &self.quat_xyzw].concat()
        };
        (0..STEPS).map(row).collect()
    }
}

fn main() -> Result<(), AnyError> {
    let mut given = std::env::args().skip(1);
    let endpoint = given.next().unwrap_or("tcp/127.0.0.1:7447".into());
    let robot = given.next().unwrap_or("vla/panda".into());
    let mut node = Node::new(open_session(&endpoint)?, &robot, &format!("worker-{WORKER}"))?;
    let (task, pose) =
        (Newest::<Task>::new(&node, "task")?, Newest::<PoseState>::new(&node, "state/pose")?);
    let (spec, key) = (spec(), format!("spec/{WORKER}"));
    let bytes = rmp_serde::to_vec_named(&spec)?;
    let tell = move |query: Query| {
        // Who asked may be gone, which is no fault of this node.
        let _ = query.reply(query.key_expr().clone(), bytes.clone()).wait();
    };
    let _spec = node.session.declare_queryable(format!("{robot}/{key}")).callback(tell).wait()?;
    let spec_hash = hash(&spec);
    let (mut told, mut model, mut episode): (Option<Instant>, _, _) = (None, None, None);
    loop {
        if told.is_none_or(|at| at.elapsed() >= SPEC_PERIOD) {
            told = Some(Instant::now());
            node.publish(&key, &spec, NEWS, now_ns())?;
        }
        node.publish_status("running")?;
        let (Some((_, task)), Some((header, pose))) = (task.get(), pose.get()) else {
            sleep(Duration::from_millis(100));
            continue;
        };
        let began_ns = now_ns();
        if episode != Some(task.episode) {
            episode = Some(task.episode);
            model = Some(Model::reset(&pose, &task.prompt));
        }
        let chunk = ActionChunk {
            worker: WORKER,
            spec_hash: &spec_hash,
            episode: task.episode,
            observation_stamp_ns: header.stamp_wall_ns,
            observation_seq: header.seq,
            valid_until_ns: header.stamp_wall_ns + VALID_NS,
            steps: model.as_ref().map_or(vec![], Model::infer),
            observed_ns: began_ns,
            inference_start_ns: began_ns,
            inference_end_ns: now_ns(),
        };
        node.publish(&format!("delta/{WORKER}"), &chunk, MUST_ARRIVE, now_ns())?;
        sleep(Duration::from_secs_f64(1.0 / task.rate_hz));
    }
}
