//! Every test vector of what these clients read: valid ones are read, all others rejected.

use serde_json::Value;
use vla_wire::records::{GripperCommand, JointCommand, PoseState, Task};
use vla_wire::{decode, decode_header, Record, Rejected};

fn read<T: Record>(bytes: &[u8]) -> Result<(), Rejected> {
    decode::<T>(bytes).map(drop)
}

#[test]
fn every_vector_is_read_or_rejected() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../wire/wire.json");
    let text = std::fs::read_to_string(path).expect("the vectors are there");
    let wire: Value = serde_json::from_str(&text).expect("they are JSON");
    let mut judged = 0;
    for vector in wire["vectors"].as_array().expect("a list") {
        let hex = vector["bytes"].as_str().expect("bytes in hex");
        let pairs = (0..hex.len()).step_by(2).map(|at| &hex[at..at + 2]);
        let bytes: Vec<u8> = pairs.map(|two| u8::from_str_radix(two, 16).expect("hex")).collect();
        let found = match vector["kind"].as_str().expect("a name") {
            "Header" => decode_header(&bytes).map(drop),
            "JointCommand" => read::<JointCommand>(&bytes),
            "GripperCommand" => read::<GripperCommand>(&bytes),
            "Task" => read::<Task>(&bytes),
            "PoseState" => read::<PoseState>(&bytes),
            _ => continue,
        };
        judged += 1;
        assert_eq!(found.is_ok(), vector["valid"] == true, "{vector}: {found:?}");
    }
    assert!(judged >= 30, "{judged} vectors");
}
