//! Where the tool of a Panda is.

/// Product of two quaternions x, y, z, w.
pub fn times(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    [
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    ]
}

pub fn inverse([x, y, z, w]: [f64; 4]) -> [f64; 4] {
    [-x, -y, -z, w]
}

/// A vector, rotated.
fn rotate(turn: [f64; 4], [x, y, z]: [f64; 3]) -> [f64; 3] {
    let [x, y, z, _] = times(times(turn, [x, y, z, 0.0]), inverse(turn));
    [x, y, z]
}

const QUARTER: f64 = std::f64::consts::FRAC_PI_2;
/// Denavit and Hartenberg's parameters after Craig: a (m), d (m), alpha (rad), of each joint and of
/// the hand, whose tool centre point is 0.1034 m from the flange.
const LINKS: [(f64, f64, f64); 8] = [
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -QUARTER),
    (0.0, 0.316, QUARTER),
    (0.0825, 0.0, QUARTER),
    (-0.0825, 0.384, -QUARTER),
    (0.0, 0.0, QUARTER),
    (0.088, 0.0, QUARTER),
    (0.0, 0.107 + 0.1034, 0.0),
];
const HAND_RAD: f64 = -QUARTER / 2.0;

/// Position (m) and quaternion of the TCP in the base frame.
pub fn tool(joints_rad: &[f64; 7]) -> ([f64; 3], [f64; 4]) {
    let (mut place, mut turn) = ([0.0; 3], [0.0, 0.0, 0.0, 1.0]);
    for ((a, d, alpha), angle) in LINKS.into_iter().zip(joints_rad.iter().chain([&HAND_RAD])) {
        turn = times(turn, [(alpha / 2.0).sin(), 0.0, 0.0, (alpha / 2.0).cos()]);
        let way = rotate(turn, [a, 0.0, d]);
        place = std::array::from_fn(|axis| place[axis] + way[axis]);
        turn = times(turn, [0.0, 0.0, (angle / 2.0).sin(), (angle / 2.0).cos()]);
    }
    (place, turn)
}
