//! A robot: a Panda without hardware that is where its joints are commanded to be, at 1 kHz.
//!
//!     vla-zenoh up examples/wire/robot.yaml    # everything but the robot
//!     cargo run --release --bin robot -- [ENDPOINT] [ROBOT] [SILENCE_S] [EVERY]
//!
//! EVERY is 1 for states at 1 kHz, 4 for a quarter as many, which leave others more of their time.
//! `chrt -f 10` before the program gives it the real-time priority with which a busy computer holds
//! 1 kHz, too.
//!
//! It has the duties of a robot: it follows one writer, in order, and brakes by itself on a stop,
//! and when its commands fall silent. It limits no speed: that is the task of a real robot's
//! controller.

use std::sync::mpsc::{channel, Sender};
use std::time::{Duration, Instant};

use vla_wire::panda::{inverse, times, tool};
use vla_wire::records::{GripperCommand, GripperState, JointCommand, JointState, PoseState};
use vla_wire::{now_ns, open_session, read, rejected, AnyError, Node, OneWriter, Rejected, STATE};
use zenoh::sample::{Sample, SampleKind};
use zenoh::Wait;

const JOINTS: [&str; 7] = [
    "panda_joint1",
    "panda_joint2",
    "panda_joint3",
    "panda_joint4",
    "panda_joint5",
    "panda_joint6",
    "panda_joint7",
];
const HOME_RAD: [f64; 7] =
    [0.0, -0.0439564754, 0.0, -2.6269994397, 0.0, 2.5830429643, std::f64::consts::FRAC_PI_4];
const MAX_WIDTH_M: f64 = 0.08;
const PERIOD: Duration = Duration::from_millis(1);
const BRAKE_RAD_S2: f64 = 4.0;
/// A command is this near to where the arm stands, or it is meant for another place.
const NEAR_RAD: f64 = 0.05;
const STILL_RAD_S: f64 = 1e-3;
/// States of the command node in which a stream may begin.
const OBEYED: [&str; 2] = ["active", "holding"];
const KEYS: [&str; 4] = ["stop", "reset", "command/joint", "command/gripper"];

/// Joints and fingers, and what moves them: a command stream, or the arm's own brake.
struct Arm {
    position_rad: [f64; 7],
    velocity_rad_s: [f64; 7],
    width_m: f64,
    braking: bool,
    latched: bool,
    silence: Duration,
    heard: Instant,
    writer: OneWriter,
    gripper_writer: OneWriter,
}

impl Arm {
    fn new(silence: Duration) -> Arm {
        Arm {
            position_rad: HOME_RAD,
            velocity_rad_s: [0.0; 7],
            width_m: MAX_WIDTH_M,
            braking: false,
            latched: false,
            silence,
            heard: Instant::now(),
            writer: OneWriter::default(),
            gripper_writer: OneWriter::default(),
        }
    }

    /// As in `GripperState`: "ready" when the arm follows commands.
    fn mode(&self) -> &'static str {
        match (self.latched, self.braking) {
            (true, _) => "latched",
            (false, true) => "braking",
            (false, false) => "ready",
        }
    }

    fn obey(&mut self, key: &str, sample: &Sample) -> Result<(), Rejected> {
        match key {
            "command/joint" => self.follow(sample),
            "command/gripper" => self.grip(sample),
            // Deletions do not count.
            _ if sample.kind() != SampleKind::Put => rejected("deleted", "only puts count"),
            "stop" => {
                self.latched = true;
                self.brake();
                Ok(())
            }
            _ => {
                self.latched = false;
                Ok(())
            }
        }
    }

    fn follow(&mut self, sample: &Sample) -> Result<(), Rejected> {
        let (header, command) = read::<JointCommand>(sample)?;
        self.writer.check(&header)?;
        self.check_ready()?;
        if self.writer.source.is_empty() && !OBEYED.contains(&command.state.as_str()) {
            return rejected("inactive", "no stream begins while its writer brakes or stands");
        }
        if command.names != JOINTS {
            return rejected("names", format!("the joints are {}", JOINTS.join(", ")));
        }
        for (wanted, here) in command.position_rad.iter().zip(self.position_rad) {
            if (wanted - here).abs() > NEAR_RAD {
                return rejected("jump", format!("a joint is at {here}, commanded to {wanted}"));
            }
        }
        self.writer.accept(&header);
        self.heard = Instant::now();
        self.position_rad.copy_from_slice(&command.position_rad);
        self.velocity_rad_s.copy_from_slice(&command.velocity_rad_s);
        Ok(())
    }

    /// Obey a gripper command of the arm's writer.
    fn grip(&mut self, sample: &Sample) -> Result<(), Rejected> {
        let (header, command) = read::<GripperCommand>(sample)?;
        self.gripper_writer.source.clone_from(&self.writer.source);
        self.gripper_writer.check(&header)?;
        self.check_ready()?;
        self.gripper_writer.accept(&header);
        self.width_m = command.width_m.min(MAX_WIDTH_M);
        Ok(())
    }

    fn check_ready(&self) -> Result<(), Rejected> {
        match self.mode() {
            "ready" => Ok(()),
            mode => rejected(mode, "the arm brakes, or is stopped"),
        }
    }

    fn brake(&mut self) {
        self.writer.release();
        self.braking = self.velocity_rad_s.iter().any(|speed| speed.abs() > STILL_RAD_S);
        if !self.braking {
            self.velocity_rad_s = [0.0; 7];
        }
    }

    /// One period: brake if the stream fell silent.
    fn tick(&mut self) {
        if !self.writer.source.is_empty() && self.heard.elapsed() > self.silence {
            self.brake();
        }
        if self.braking {
            let slower = BRAKE_RAD_S2 * PERIOD.as_secs_f64();
            for (place, speed) in self.position_rad.iter_mut().zip(&mut self.velocity_rad_s) {
                *speed = speed.signum() * (speed.abs() - slower).max(0.0);
                *place += *speed * PERIOD.as_secs_f64();
            }
            self.braking = self.velocity_rad_s.iter().any(|speed| *speed != 0.0);
        }
    }
}

/// Publish the three states, with one stamp; `before` is the pose of the last ones.
fn publish(node: &mut Node, arm: &Arm, before: &mut (i64, PoseState)) -> Result<(), AnyError> {
    let stamp_ns = now_ns();
    let (was_ns, was) = before;
    let passed_s = (stamp_ns - *was_ns) as f64 / 1e9;
    let (place, turn) = tool(&arm.position_rad);
    let turned = times(turn, inverse(was.quat_xyzw));
    let twist = std::array::from_fn(|axis| match axis {
        0..=2 => (place[axis] - was.position_m[axis]) / passed_s,
        _ => 2.0 * turned[axis - 3] / passed_s,
    });
    let joints = JointState {
        names: &JOINTS,
        position_rad: &arm.position_rad,
        velocity_rad_s: &arm.velocity_rad_s,
        effort_nm: None,
    };
    let pose = PoseState::new(place, turn, twist);
    let mode = arm.mode();
    let gripper = GripperState { width_m: arm.width_m, moving: false, holding: false, mode };
    node.publish("state/joint", &joints, STATE, stamp_ns)?;
    node.publish("state/pose", &pose, STATE, stamp_ns)?;
    node.publish("state/gripper", &gripper, STATE, stamp_ns)?;
    *before = (stamp_ns, pose);
    Ok(())
}

fn send(key: &'static str, queue: Sender<(&'static str, Sample)>) -> impl Fn(Sample) {
    move |sample| queue.send((key, sample)).expect("the robot's loop runs")
}

fn main() -> Result<(), AnyError> {
    let given: Vec<String> = std::env::args().skip(1).collect();
    let word = |at: usize, otherwise| given.get(at).map_or(otherwise, String::as_str);
    let (endpoint, robot) = (word(0, "tcp/127.0.0.1:7447"), word(1, "vla/panda"));
    // The profile's timing.command_timeout_s.
    let mut arm = Arm::new(Duration::from_secs_f64(word(2, "0.1").parse()?));
    let every: u64 = word(3, "1").parse()?;
    let mut node = Node::new(open_session(endpoint)?, robot, "arm")?;
    let (queue, arrived) = channel();
    for key in KEYS {
        let obey = send(key, queue.clone());
        node.session
            .declare_subscriber(format!("{robot}/{key}"))
            .callback(obey)
            .background()
            .wait()?;
    }
    let (place, turn) = tool(&HOME_RAD);
    let mut before = (now_ns(), PoseState::new(place, turn, [0.0; 6]));
    let mut next = Instant::now();
    for tick in 0.. {
        next = (next + PERIOD).max(Instant::now());
        std::thread::sleep(next - Instant::now());
        for (key, sample) in arrived.try_iter() {
            if let Err(Rejected(reason, _)) = arm.obey(key, &sample) {
                node.count(key.trim_start_matches("command/"), reason);
            }
        }
        arm.tick();
        if tick % every == 0 {
            publish(&mut node, &arm, &mut before)?;
        }
        node.publish_status(if arm.mode() == "ready" { "running" } else { arm.mode() })?;
    }
    Ok(())
}
