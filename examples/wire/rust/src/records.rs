//! The records that these clients read and write; docs/reference/records.md says what they mean.

use serde::{Deserialize, Serialize};

use crate::{rejected, text, Record, Rejected};

const MOST: f64 = 1e6;

fn finite(name: &str, numbers: &[f64]) -> Result<(), Rejected> {
    // NaN is in no range.
    match numbers.iter().all(|number| (-MOST..=MOST).contains(number)) {
        true => Ok(()),
        false => rejected("invalid", format!("{name} is {numbers:?}")),
    }
}

fn at_most(name: &str, text: &str, characters: usize) -> Result<(), Rejected> {
    match text.chars().count() <= characters {
        true => Ok(()),
        false => rejected("invalid", format!("{name} is longer than {characters}")),
    }
}

fn within(name: &str, number: f64, low: f64, high: f64) -> Result<(), Rejected> {
    match (low..=high).contains(&number) {
        true => Ok(()),
        false => rejected("invalid", format!("{name} is {number}, not from {low} to {high}")),
    }
}

#[derive(Deserialize)]
pub struct JointCommand {
    pub names: Vec<String>,
    pub position_rad: Vec<f64>,
    pub velocity_rad_s: Vec<f64>,
    pub acceleration_rad_s2: Vec<f64>,
    #[serde(deserialize_with = "text")]
    pub state: String,
}

impl Record for JointCommand {
    fn check(&self) -> Result<(), Rejected> {
        let count = self.names.len();
        for numbers in [&self.position_rad, &self.velocity_rad_s, &self.acceleration_rad_s2] {
            finite("a joint", numbers)?;
            if numbers.len() != count || count == 0 {
                return rejected("invalid", "there is one number for each name");
            }
        }
        at_most("state", &self.state, 32)
    }
}

#[derive(Deserialize)]
pub struct GripperCommand {
    pub width_m: f64,
    pub speed_m_s: f64,
    pub force_n: f64,
}

impl Record for GripperCommand {
    fn check(&self) -> Result<(), Rejected> {
        within("width_m", self.width_m, 0.0, 1.0)?;
        within("speed_m_s", self.speed_m_s, 1e-4, 10.0)?;
        within("force_n", self.force_n, 0.0, 1000.0)
    }
}

#[derive(Clone, Deserialize)]
pub struct Task {
    pub episode: u64,
    pub active: bool,
    #[serde(deserialize_with = "text")]
    pub prompt: String,
    #[serde(deserialize_with = "text")]
    pub worker: String,
    pub rate_hz: f64,
    #[serde(default = "full")]
    pub speed_percent: f64,
}

fn full() -> f64 {
    100.0
}

impl Record for Task {
    fn check(&self) -> Result<(), Rejected> {
        at_most("prompt", &self.prompt, 4096)?;
        within("rate_hz", self.rate_hz, 0.01, 1000.0)?;
        within("speed_percent", self.speed_percent, 0.0, 100.0)
    }
}

#[derive(Clone, Deserialize, Serialize)]
pub struct PoseState {
    pub position_m: [f64; 3],
    pub quat_xyzw: [f64; 4],
    pub twist: [f64; 6],
    #[serde(default, skip_serializing)]
    reference_position_m: Option<[f64; 3]>,
    #[serde(default, skip_serializing)]
    reference_quat_xyzw: Option<[f64; 4]>,
}

impl PoseState {
    pub fn new(position_m: [f64; 3], quat_xyzw: [f64; 4], twist: [f64; 6]) -> PoseState {
        PoseState {
            position_m,
            quat_xyzw,
            twist,
            reference_position_m: None,
            reference_quat_xyzw: None,
        }
    }
}

impl Record for PoseState {
    fn check(&self) -> Result<(), Rejected> {
        finite("position_m", &self.position_m)?;
        finite("twist", &self.twist)?;
        let norm = self.quat_xyzw.iter().map(|x| x * x).sum::<f64>().sqrt();
        within("the norm of quat_xyzw", norm, 1.0 - 1e-3, 1.0 + 1e-3)?;
        match self.reference_position_m.is_some() == self.reference_quat_xyzw.is_some() {
            true => Ok(()),
            false => rejected("invalid", "a reference pose has position and quaternion"),
        }
    }
}

#[derive(Serialize)]
pub struct JointState<'a> {
    pub names: &'a [&'a str],
    pub position_rad: &'a [f64],
    pub velocity_rad_s: &'a [f64],
    pub effort_nm: Option<&'a [f64]>,
}

#[derive(Serialize)]
pub struct GripperState<'a> {
    pub width_m: f64,
    pub moving: bool,
    pub holding: bool,
    pub mode: &'a str,
}

#[derive(Serialize)]
pub struct ActionChunk<'a> {
    pub worker: &'a str,
    pub spec_hash: &'a str,
    pub episode: u64,
    pub observation_stamp_ns: i64,
    pub observation_seq: u64,
    pub valid_until_ns: i64,
    pub steps: Vec<Vec<f64>>,
    pub observed_ns: i64,
    pub inference_start_ns: i64,
    pub inference_end_ns: i64,
}
