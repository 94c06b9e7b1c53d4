"""Wrong profiles: lines that are added to a good one, and the sentence that they get.

`profile check` rejects every one of them, and so does `up`, by the same function. A sentence may be
part of what is said. `WRONG` are wrong by themselves, `CHECKED` on a computer or with a model,
`EXTENDED` contradict the profile that they extend.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import get_args

from vla_zenoh import plugins
from vla_zenoh.profile.schema import NodeKind


def any_of(names: Iterable[str]) -> str:
    """The names as a sentence lists what may be written."""
    *others, last = (repr(name) for name in names)
    return f"{', '.join(others)} or {last}"


DRIVERS = tuple(plugins.installed(plugins.ROBOTS))
"""What `robot.driver` may be."""
CAMERA_SOURCES = plugins.load_all(plugins.CAMERAS)
CAMERAS = ", ".join(kind.written for kind in CAMERA_SOURCES.values())

WRONG: list[tuple[str, str]] = [
    (
        "cameras: {front: {mount: {frame: /eye, link: panda_hand, position_m: [0, 0, 0],"
        " rpy_rad: [0, 0, 0]}}}",
        "cameras.front.mount.frame: begins with a slash",
    ),
    # (text behind "extends: panda_sim", part of one line of what is said)
    (
        "limts: {}",
        r"lab.yaml:2: limts: unknown key; did you mean 'limits'? Known here: about, ",
    ),
    (
        "limits:\n  translation:\n    velocity_ms: 1",
        "lab.yaml:4: limits.translation.velocity_ms: unknown key; did you mean 'velocity_m_s'? "
        "Known here: acceleration_m_s2, jerk_m_s3, velocity_m_s",
    ),
    (
        "cameras:\n  front: {soruce: 'sim:front'}",
        "lab.yaml:3: cameras.front.soruce: unknown key; did you mean 'source'? Known here: ",
    ),
    ("limits: {step_m: true}", "lab.yaml:2: limits.step_m: wants a number (given: True)"),
    ("limits: {step_m: '0.05'}", "lab.yaml:2: limits.step_m: wants a number (given: '0.05')"),
    ("limits: {step_m: .nan}", "lab.yaml:2: limits.step_m: wants a finite number (given: nan)"),
    (
        "limits: {step_m: 1e999}",
        "lab.yaml:2: limits.step_m: wants a finite number (given: inf)",
    ),
    ("limits: {step_m: 50}", "lab.yaml:2: limits.step_m: must be at most 0.2 (given: 50)"),
    ("limits: {step_m: 0}", "lab.yaml:2: limits.step_m: must be greater than 0 (given: 0)"),
    ("sim: {seed: 1.5}", "lab.yaml:2: sim.seed: wants a whole number (given: 1.5)"),
    (
        "limits:",
        "lab.yaml:2: limits: is empty: wants a map of: approach_m_s, approach_rad_s, contact,",
    ),
    (
        "limits: [1]",
        "lab.yaml:2: limits: wants a map of: approach_m_s, approach_rad_s, contact, elbow_rad,",
    ),
    ("workers: scripted", "lab.yaml:2: workers: wants a list (given: 'scripted')"),
    ("workers: [scripted, a, a]", "lab.yaml:2: workers: a: given more than once"),
    ("workers: [scripted, 'a b']", "lab.yaml:2: workers.1: name 'a b' cannot be part of a key"),
    (
        "workers: [scripted, ./nod.py]",
        "lab.yaml:2: workers: './nod.py' is a path: give that model a name, as models: "
        "{nod: ./nod.py}, and write nod here",
    ),
    (
        "models: {scriptd: ./nod.py}",
        "lab.yaml:2: models.scriptd: 'scriptd' is not among workers; did you mean 'scripted'? "
        "Known: scripted",
    ),
    ("models: {scripted: 5}", "lab.yaml:2: models.scripted: wants text; put it in quotes"),
    ("models: {scripted: ''}", "lab.yaml:2: models.scripted: must not be empty"),
    ("models: {'a b': x.py}", "lab.yaml:2: models.a b: name 'a b' cannot be part of a key"),
    ("models: [scripted]", "lab.yaml:2: models: wants a map"),
    (
        "serves: {scriptd: [panda]}",
        "lab.yaml:2: serves.scriptd: 'scriptd' is not among workers; did you mean 'scripted'? "
        "Known: scripted",
    ),
    (
        "serves:\n  scripted: [left, right]",
        "lab.yaml:3: serves.scripted: lacks panda, the robot of this profile: name all that",
    ),
    ("serves: {scripted: panda}", "lab.yaml:2: serves.scripted: wants a list (given: 'panda')"),
    ("serves: {scripted: []}", "lab.yaml:2: serves.scripted: "),
    ("serves: {scripted: [panda, b, b]}", "serves.scripted: b: given more than once"),
    ("serves: {scripted: [panda, b/c]}", "serves.scripted.1: name 'b/c' cannot be part of a"),
    ("serves: [panda]", "lab.yaml:2: serves: wants a map"),
    (
        "options: {scriptd: {a: b}}",
        "lab.yaml:2: options.scriptd: 'scriptd' is not among workers",
    ),
    ("options: {scripted: {a-b: c}}", "options.scripted.a-b: 'a-b' cannot be the name of an"),
    ("options: {scripted: {dt_s: 0.1}}", "options.scripted.dt_s: wants text; put it in quotes"),
    ("about: 5", "lab.yaml:2: about: wants text; put it in quotes (given: 5)"),
    ('about: "\\ud800"', "lab.yaml:2: about: holds half a character (a surrogate)"),
    (
        "session: {shared_memory: yes}",
        "session.shared_memory: wants true or false (given: 'yes')",
    ),
    ("session: {mode: peer}", "session.mode: "),
    ("root: lab/*", "lab.yaml:2: root: root '*' cannot be part of a key"),
    (
        "limits:\n  workspace:\n    x_m: [200, 750]",
        "lab.yaml:4: limits.workspace.x_m: [200, 750] is beyond 3 m; give metres",
    ),
    (
        "limits: {workspace: {z_m: [0.9, 0.1]}}",
        "limits.workspace.z_m: [0.9, 0.1] is empty: give [smallest, largest]",
    ),
    (
        "limits: {workspace: {z_m: [0.9]}}",
        "limits.workspace.z_m.1: is missing: the list is too",
    ),
    (
        "limits: {workspace: {z_m: [0, 1, 2]}}",
        "limits.workspace.z_m: has 3 entries, at most 2 fit",
    ),
    ("limits: {step_m: 0.2}", "limits.step_m: is 0.2, longer than the leash lead_m (0.15)"),
    (
        "limits: {step_rad: 0.7}",
        "limits.step_rad: is 0.7, longer than the leash lead_rad (0.6)",
    ),
    (
        "limits: {reach: {collision_slow_m: 0.01}}",
        "limits.reach.collision_stop_m: is 0.02, which must not be above collision_slow_m",
    ),
    (
        "limits: {reach: {keep_out: {post: {centre_m: [0.5, 0, 0]}}}}",
        "limits.reach.keep_out.post: has no shape; give one of box_m, radius_m, normal",
    ),
    (
        "timing:\n  command_hz: 50\n  command_timeout_s: 0.05",
        "lab.yaml:4: timing.command_timeout_s: is 0.05, less than 3 periods of command_hz (50)",
    ),
    (
        "timing: {command_hz: 50, watchdog_s: 0.05}",
        "timing.watchdog_s: is 0.05, less than 3 periods of command_hz (50)",
    ),
    (
        "timing: {state_hz: 20, state_timeout_s: 0.14}",
        "timing.state_timeout_s: is 0.14, less than 3 periods of state_hz (20)",
    ),
    ("robot:\n  home_rad: [0, 0]", "lab.yaml:3: robot.home_rad: has 2 angles for 7 arm_joints"),
    (
        "robot: {home_rad: [0, -45, 0, -135, 0, 90, 45]}",
        "robot.home_rad.1: is -45: more than a turn; give radians",
    ),
    (
        "robot: {finger_joints: [panda_joint1]}",
        "finger_joints: repeats arm_joints: panda_joint1",
    ),
    (
        "robot: {gripper: {max_width_m: 0.01, dead_band_m: 0.02}}",
        "robot.gripper.dead_band_m: must be less than max_width_m (0.01): nothing would move",
    ),
    (
        "robot: {gripper: {joint_open_rad: 0}}",
        "lab.yaml:2: robot.gripper.joint_open_rad: needs joint_shut_rad beside it",
    ),
    (
        "robot: {gripper: {joint_open_rad: 0, joint_shut_rad: 45}}",
        "robot.gripper.joint_shut_rad: is 45: more than a turn; give radians",
    ),
    (
        "robot: {gripper: {joint_open_m: 0.0, joint_shut_m: 0.0}}",
        "robot.gripper.joint_shut_m: is that of joint_open_m: nothing would move",
    ),
    (
        "robot: {gripper: {joint_open_rad: 0, joint_shut_rad: 1, joint_open_m: 0.1,"
        " joint_shut_m: 0}}",
        "robot.gripper.joint_open_m: is for a joint that slides, joint_open_rad for one",
    ),
    (
        "ros2: {pose_command: {topic: /t, type: geometry_msgs/msg/PoseStamped}, "
        "gripper: {topic: /g, type: control_msgs/action/GripperCommand}}",
        "ros2.gripper.position: is missing: does the driver take the m between the fingers",
    ),
    (
        "ros2: {pose_command: {topic: /t, type: geometry_msgs/msg/PoseStamped}, "
        "gripper: {topic: /g, type: std_msgs/msg/Float64, position: joint}}",
        "ros2.gripper.position: is joint, which needs joint_open_rad and joint_shut_rad",
    ),
    (
        "ros2: {pose_command: {topic: /t, type: geometry_msgs/msg/PoseStamped}, "
        "gripper: {topic: /g, type: franka_msgs/action/Move, position: finger}}",
        "ros2.gripper.position: is not for franka_msgs/action/Move, which takes the width",
    ),
    (
        "robot: {driver: ros}",
        "lab.yaml:2: robot.driver: no robot driver 'ros' is installed; did you mean 'ros2'? "
        f"Installed: {', '.join(DRIVERS)}. Install its package",
    ),
    ("robot: {tcp_frame: ''}", "robot.tcp_frame: must not be empty"),
    (
        "task: {worker: scritped}",
        "task.worker: 'scritped' is not among workers; did you mean 'scrip",
    ),
    ("task: {prompt: true}", "task.prompt: wants text; put it in quotes (given: True)"),
    (
        "cameras: {front: {source: webcam}}",
        f"'webcam' is not a camera: write one of {CAMERAS}",
    ),
    (
        "cameras: {front: {source: 'v4l:0'}}",
        "lab.yaml:2: cameras.front.source: 'v4l:0': no camera source 'v4l' is installed; did you "
        "mean 'v4l2'? Installed: file, realsense, ros2, rtsp, rtsps, sim, v4l2. Install its",
    ),
    (
        "cameras: {front: {source: 'sim:'}}",
        f"'sim:' is not a camera: write one of {CAMERAS}",
    ),
    (
        "cameras: {front: {source: 'rtsp://'}}",
        "'rtsp://' lacks the host: write rtsp://HOST/PATH",
    ),
    ("cameras: {front: {source: 'ros2:/a'}}", "is 'ros2:/a', which needs a section ros2"),
    ("cameras: {'a/b': {source: 'sim:x'}}", "cameras.a/b: name 'a/b' cannot be part of a key"),
    ("hosts: {}", "lab.yaml:2: hosts: is empty: name at least one host and its nodes"),
    (
        "hosts: {a: {nodes: []}}",
        "lab.yaml:2: hosts.a.nodes: is empty: give the host a node, or remove it",
    ),
    ("hosts: {a: {}}", "lab.yaml:2: hosts.a.nodes: is missing"),
    (
        "hosts:\n  a:\n    nodes: [router, camer]",
        f"lab.yaml:4: hosts.a.nodes.1: wants {any_of(get_args(NodeKind))}; did you mean 'camera'?",
    ),
    ("hosts: {a: {nodes: [sim, sim]}}", "hosts.a.nodes: sim: given more than once"),
    (
        "hosts:\n  a: {nodes: [camera], cameras: [frnt]}",
        "lab.yaml:3: hosts.a.cameras: 'frnt' is not among cameras; did you mean 'front'? "
        "Known: front, wrist",
    ),
    (
        "hosts: {a: {nodes: [worker], workers: [vla]}}",
        "hosts.a.workers: 'vla' is not among workers. Known: scripted",
    ),
    (
        "hosts: {a: {nodes: [command]}, b: {nodes: [command]}}",
        "hosts.b.nodes: command runs on a and b: the robot follows one command node",
    ),
    (
        "hosts: {a: {nodes: [router]}, b: {nodes: [router]}}",
        "hosts.b.link: is missing: routers do not discover each other, and a runs one as well",
    ),
    (
        "hosts: {a: {nodes: [worker]}, b: {nodes: [worker]}}",
        "hosts.b.workers: scripted runs on a and b: each key has one writer. List on each host",
    ),
    (
        "hosts: {a: {nodes: [camera], cameras: [wrist]}, b: {nodes: [camera]}}",
        "hosts.b.cameras: wrist runs on a and b: each key has one writer",
    ),
    (
        "session: {listen: [tcp/10.0.0.2:7447]}",
        "session.listen.0: lets anyone on that network command the robot. Make certificates",
    ),
    (
        "session: {listen: [tls/10.0.0.2:7447]}",
        "session.listen.0: tls needs certificates: make them with `vla-zenoh secure init`",
    ),
    (
        "session: {security: {}, listen: [tls/a:1], connect: [tcp/a:1]}",
        "session.connect.0: tcp verifies no certificate, but there is a section security",
    ),
    (
        "session: {security: {}, listen: [tls/a:1], connect: [tls/a:1], insecure: true}",
        "session.insecure: is true, beside a section security: leave one out",
    ),
    (
        "session: {security: {people: {desk: boss}}, listen: [tls/a:1], connect: [tls/a:1]}",
        "session.security.people.desk: wants 'operator', 'viewer' or 'replay'",
    ),
    (
        "session: {separate_links: true, connect: [tcp/127.0.0.1:65535]}",
        "session.connect.0: separate_links needs PROTOCOL/HOST:PORT, and the next port too",
    ),
    (
        "hosts: {a: {nodes: [router], listen: [tcp/10.0.0.3:7447]}}",
        "hosts.a.listen.0: lets anyone on that network command the robot",
    ),
    (
        "hosts: {a: {nodes: [command], link: [tcp/127.0.0.1:7447]}}",
        "hosts.a.link: is for a router, and this host runs none",
    ),
    ("robot: {driver: ros2}", "ros2: is missing: robot.driver is ros2"),
    ("robot: {driver: ros2}", "cameras.wrist.source: is 'sim:wrist', and robot.driver is ros2"),
    ("robot: {driver: ros2}", "hosts.here.nodes: has sim, and robot.driver is ros2"),
    (
        "ros2: {pose_command: {topic: pose, type: a}}",
        "'pose' is not a ROS topic: write its full name",
    ),
    (
        "ros2: {pose_command: {topic: /p, type: a}}",
        "ros2.pose_command.type: 'a' is not a ROS type: write package/msg/Name",
    ),
    (
        "robot: {driver: ros2}\nros2: {domain: 1}",
        "ros2: lacks pose_command: robot.command is pose",
    ),
    (
        "cameras: {front: {source: 'ros2:/a'}}\nros2: {cameras: {front: {topic: /b}}}",
        "ros2.cameras.front.topic: is not that of cameras.front: 'ros2:/a'",
    ),
    (
        "ros2: {gripper: {topic: /g, type: std_msgs/msg/Float64, grasp: /h}}",
        "ros2.gripper.grasp: goes with type franka_msgs/action/Move only",
    ),
    (
        "ros2: {joint_command: {topic: /j, type: std_msgs/msg/Float64}}",
        "ros2.joint_command.type: is std_msgs/msg/Float64: joints are sent as trajectory_msgs/",
    ),
    (
        "hosts: {a: {nodes: [ros2]}}",
        "hosts.a.nodes: has ros2, which needs a section ros2",
    ),
    (
        "ros2: {cameras: {frotn: {topic: /f}}}",
        "ros2.cameras.frotn: 'frotn' is not among cameras; did you mean 'front'?",
    ),
    ("session: {connect: []}", "session.connect: is empty: nodes need a router"),
    ("session: {listen: []}", "session.listen: is empty: the router needs an address"),
    ("session: {connect: ['tcp/a:0']}", "session.connect.0: port 0 leads nowhere"),
    ("session: {lease_ms: 10}", "session.lease_ms: must be at least 200 (given: 10)"),
    ("extends: panda_simm", "extends is given twice"),
]

ARM = """\
robot: {driver: arm}
cameras: {front: {source: "v4l2:/dev/video0"}, wrist: null}
hosts: {here: {nodes: [router, arm, camera, command, worker]}}
"""
ROS2 = """\
robot: {driver: ros2}
cameras: {front: {source: "ros2:/front"}, wrist: null}
hosts: {here: {nodes: [router, ros2, command, worker]}}
"""
FIVE = """\
robot:
  arm_joints: [panda_joint1, panda_joint2, panda_joint3, panda_joint4, panda_joint5]
  home_rad: [0.0, 0.0, 0.0, -2.0, 0.0]
limits: {joint: {velocity_rad_s: 1.0, acceleration_rad_s2: 3.0, jerk_rad_s3: 50.0}}
"""
ELSEWHERE = "session: {connect: [tcp/127.0.0.1:7448]}"
POSE = "pose_command: {topic: /goal, type: geometry_msgs/msg/PoseStamped}"
FILES = {
    "no_urdf.urdf": "no robot",
    "syntax.py": "def broken(:\n",
    "nothing.py": "x = 1\n",
    "two.py": "class A:\n    def infer(self, o): ...\nclass B:\n    def infer(self, o): ...\n",
    "no_spec.py": "class A:\n    def infer(self, o): ...\n",
    "wide.py": "from vla_zenoh.policy import *\nclass A:\n"
    "    spec = ModelSpec(name='a', observation=ObservationSpec(cameras=(CameraSpec(\n"
    "        camera='front', width=32, height=32),)), action=ActionSpec(horizon=1, dt_s=0.1))\n"
    "    def infer(self, o): ...\n",
    "posing.py": "from vla_zenoh.policy import *\nclass A:\n"
    "    spec = ModelSpec(name='a', action=ActionSpec(horizon=1, dt_s=0.1, kind='absolute'))\n"
    "    def infer(self, o): ...\n",
    "joints.py": "from vla_zenoh.policy import *\nclass A:\n"
    "    def __init__(self):\n"
    "        self.spec = ModelSpec(name='a', action=ActionSpec(\n"
    "            horizon='8', dt_s=0.1, kind='joint_position'))\n"
    "    def infer(self, o): ...\n",
    "needs.py": "# /// script\n# dependencies = ['no-such-package-here']\n# ///\nclass A:\n"
    "    def __init__(self, checkpoint: str, size: str = '1', **more: str): ...\n"
    "    def infer(self, o): ...\n",
    "python.py": "# /// script\n# requires-python = '>=3.99'\n# ///\nclass A:\n"
    "    def __init__(self, checkpoint: str): ...\n    def infer(self, o): ...\n",
    "arm.py": "class Arm:\n    def __init__(self, port: str = 'x'): ...\n"
    "    def read(self): ...\n    def move(self, command): ...\n",
    "blind_arm.py": "class Arm:\n    def move(self, command): ...\n",
    "stiff_arm.py": "class Arm:\n    def read(self): ...\n    def move(self): ...\n",
    "Bad.msg": "this is no definition\n",
}
"""Beside the profile."""


def model(file: str, options: str = "") -> str:
    """Lines that add the model in `file` as worker m."""
    more = f"\noptions: {{m: {{{options}}}}}" if options else ""
    return f"workers: [scripted, m]\nmodels: {{m: ./{file}}}{more}"


CHECKED: list[tuple[str, str]] = [
    (
        "cameras: {front: {mount: {frame: eye, link: panda_hnad, position_m: [0, 0, 0],"
        " rpy_rad: [0, 0, 0]}}}",
        "cameras.front.mount.link: is 'panda_hnad', no link of robot.description; did you mean",
    ),
    # Valid by themselves: `up` would start, and lose a node or refuse every activation.
    ("sim: {scene: kitchen}", "lab.yaml:2: sim.scene: no scene called 'kitchen'. Known: bricks, d"),
    (
        "limits: {reach: {keep_out: {post: {centre_m: [0.45, 0, 0.3], radius_m: 0.1}}}}",
        "lab.yaml:2: limits.reach.keep_out.post: panda_link7 is -0.118 m from the keep-out 'post'",
    ),
    ("sim: {scene: brick}", "sim.scene: no scene called 'brick'; did you mean 'bricks'? Known"),
    ("sim: {vary: [table]}", "lab.yaml:2: sim.vary: the scene has no material"),
    (
        "cameras: {front: {source: 'sim:frnt'}}",
        "lab.yaml:2: cameras.front.source: scene 'table' has no camera 'frnt'; did you mean "
        "'front'? Known: front, wrist",
    ),
    (
        "robot: {tcp_frame: panda_hand_tpc}",
        "lab.yaml:2: robot: panda.urdf has no link 'panda_hand_tpc'; did you mean 'panda_hand_tcp'",
    ),
    ("robot: {base_frame: panda_hand}", "lab.yaml:2: robot: base_frame 'panda_hand' of panda.urdf"),
    ("robot: {finger_joints: [panda_finger]}", "robot: panda.urdf has no joint 'panda_finger'; di"),
    (
        "robot: {gripper: {joint_open_rad: 0.0, joint_shut_rad: 0.8}}",
        "slides: write gripper: {joint_open_m: ..., joint_shut_m: ...}",
    ),
    (
        "robot: {description: absent.urdf}",
        "lab.yaml:2: robot.description: robot description '{here}/absent.urdf' is not a file",
    ),
    (
        "robot: {description: example-robot-data:panda/panda.urdf}",
        "robot.description: robot description 'example-robot-data:panda/panda.urdf' is not in",
    ),
    ("robot: {description: no_urdf.urdf}", "robot.description: no_urdf.urdf is no XML"),
    (
        "robot: {home_rad: [0, 0, 0, -3.5, 0, 2.58, 0.78]}",
        "lab.yaml:2: robot.home_rad: puts panda_joint4 at -3.5 rad, its range is -3.07 to -0.0698",
    ),
    (
        "limits: {workspace: {x_m: [0.6, 0.75]}}",
        "lab.yaml:2: robot.home_rad (",
    ),
    (
        "limits: {workspace: {x_m: [0.6, 0.75]}}",
        "panda_sim.yaml:20): puts the TCP at (0.430, 0.000, 0.160) m",
    ),
    ("workers: [scripted, pi9]", "lab.yaml:2: workers: no model called 'pi9'. Known: brick, gro"),
    (
        "workers: [scripted, replay]",
        "replay.py: Replay needs the option 'file': give file=VALUE, with --set or in the profile",
    ),
    (
        "options: {scripted: {camra: front}}",
        "lab.yaml:2: options.scripted: {models}/scripted.py: Scripted has no option 'camra'; did y"
        "ou mean 'camera'? Its options: camera, horizon, dt_s, delay_ms, jitter, profile",
    ),
    (
        "options: {scripted: {horizon: many}}",
        "Scripted cannot be made: horizon is 'many', wanted a number",
    ),
    (
        "options: {scripted: {camera: ceiling}}",
        "workers: worker 'scripted': needs camera 'ceiling', the profile has: front, wrist; add it",
    ),
    (
        "cameras: {front: null}",
        "workers: worker 'scripted': needs camera 'front', the profile has: wrist; add it to camer",
    ),
    (
        "cameras: {front: {rate_hz: 1}}",
        "worker 'scripted': camera 'front' gives an image every 1.00 s, the spec allows none olde",
    ),
    ("models: {scripted: ./absent.py}", "models.scripted: there is no file or folder '{here}/abse"),
    (
        model("syntax.py"),
        "models.m: {here}/syntax.py cannot be imported: SyntaxError: invalid",
    ),
    (
        model("nothing.py"),
        "nothing.py: wanted one class with a method infer, found: none; name",
    ),
    (
        model("two.py"),
        "two.py: wanted one class with a method infer, found: A, B; name the",
    ),
    (model("no_spec.py"), "no_spec.py: A needs a property `spec` (a vla_zenoh.policy.ModelSpec)"),
    (
        model("wide.py"),
        "worker 'm': camera 'front' sends 640x480, the spec asks for 32x32 and",
    ),
    (
        model("joints.py"),
        "A cannot be made: ActionSpec is wrong: horizon: wants a whole number (given: '8'); kind: "
        "'joint_position' is not a kind of action; joints are declared as space='joint' with",
    ),
    (
        model("needs.py"),
        "needs.py needs the option 'checkpoint': give checkpoint=VALUE, with",
    ),
    (
        model("needs.py", "chekpoint: ./w"),
        "options.m: {here}/needs.py has no option 'chekpoint'; did you mean 'checkpoint'? Its opti",
    ),
    (model("python.py", "size: '1'"), "python.py has no option 'size'. Its options: checkpoint"),
    (
        "workers: [scripted, openpi]\noptions: {openpi: {preset: libro}}",
        "OpenPi cannot be made: preset is 'libro', allowed: libero, droid, own, none",
    ),
    (
        "workers: [scripted, openvla]\noptions: {openvla: {chekpoint: ./weights}}",
        "model.py has no option 'chekpoint'; did you mean 'checkpoint'? Its options: checkpoint, ",
    ),
    (
        FIVE + model("posing.py"),
        "worker 'm': robot 'panda' has 5 arm joints, a pose of the TCP needs six: it cannot go st",
    ),
    (ARM + "arm: {file: absent.py}", "lab.yaml:5: arm.file: there is no file {here}/absent.py"),
    (ARM + "arm: {file: syntax.py}", "arm: {here}/syntax.py cannot be imported: SyntaxError"),
    (ARM + "arm: {file: nothing.py}", "nothing.py: wanted one class with a method move, found: no"),
    (
        ARM + "arm: {file: arm.py, options: {prot: COM1}}",
        "arm: {here}/arm.py: Arm has no option 'prot'; did you mean 'port'? Its options: port",
    ),
    (ARM + "arm: {file: blind_arm.py}", "blind_arm.py: Arm needs methods `read()` and `move(comm"),
    (ARM + "arm: {file: stiff_arm.py}", "stiff_arm.py: Arm needs methods `read()` and `move(comm"),
    (
        ROS2 + "ros2: {pose_command: {topic: /goal, type: geometry_msgs/msg/PoseStmped}}",
        "ros2: geometry_msgs/msg/PoseStmped is not a type of ROS 2 jazzy; did you mean 'geometry_m",
    ),
    (
        ROS2 + "ros2: {pose_command: {topic: /goal, type: std_msgs/msg/String}}",
        "ros2: std_msgs/msg/String has no field of type",
    ),
    (
        ROS2 + f"ros2: {{{POSE}, messages: {{my_msgs/msg/A: absent.msg}}}}",
        "ros2: ros2.messages.my_msgs/msg/A: {here}/absent.msg cannot be read",
    ),
    (
        ROS2 + f"ros2: {{{POSE}, messages: {{my_msgs/msg/A: Bad.msg}}}}",
        "ros2: my_msgs/msg/A.is is a my_msgs/msg/this, which is not known: give its text as well",
    ),
    (
        "cameras: {front: {source: 'file:absent.mp4'}}",
        "cameras.front.source: there is no file or folder {here}/absent.mp4",
    ),
    (
        ELSEWHERE,
        "lab.yaml:2: session.connect: leads to tcp/127.0.0.1:7448, and the router of this host "
        "listens on tcp/127.0.0.1:7447: its nodes would not find it. Give both the same port",
    ),
    (
        "hosts: {here: {nodes: [router, sim, command], connect: [tcp/127.0.0.1:9]}}",
        "lab.yaml:2: hosts.here.connect: leads to tcp/127.0.0.1:9, and the router of this host",
    ),
    (
        "session: {security: {folder: ./absent}, connect: [tls/127.0.0.1:7447], "
        "listen: [tls/127.0.0.1:7447]}",
        "session.security: ",
    ),
]

BASE = """\
extends: panda_sim
workers: [scripted, second]
models: {second: scripted}
options: {second: {dt_s: "0.2"}}
serves: {second: [panda, left]}
task: {worker: second}
ros2: {cameras: {wrist: {topic: /wrist}}}
"""
EXTENDED: list[tuple[str, str]] = [
    # (text behind "extends: base", part of what is said): the line is that of the loaded file
    (
        "workers: [scriptd]",
        "lab.yaml:2: task.worker ({here}/base.yaml:6): 'second' is not among workers. Known: scri",
    ),
    (
        "workers: [scripted, secnd]",
        "lab.yaml:2: task.worker ({here}/base.yaml:6): 'second' is not among workers; did you mean "
        "'secnd'? Known: scripted, secnd",
    ),
    (
        "workers: [scripted]\ntask: {worker: scripted}",
        "lab.yaml:2: options.second ({here}/base.yaml:4): 'second' is not among workers. "
        "Known: scripted. To remove it: options: {second: null}",
    ),
    (
        "workers: [scripted]\ntask: {worker: scripted}",
        "lab.yaml:2: models.second ({here}/base.yaml:3): 'second' is not among workers. "
        "Known: scripted. To remove it: models: {second: null}",
    ),
    (
        "workers: [scripted]\ntask: {worker: scripted}\nmodels: null\noptions: null",
        "lab.yaml:2: serves.second ({here}/base.yaml:5): 'second' is not among workers. Known: scr",
    ),
    (
        "cameras: {wrist: null}",
        "lab.yaml:2: ros2.cameras.wrist ({here}/base.yaml:7): 'wrist' is not among cameras. "
        "Known: front. To remove it: ros2: {cameras: {wrist: null}}",
    ),
    (
        "cameras: null",
        "lab.yaml:2: hosts.here.nodes (",
    ),
    ("options: {third: {a: b}}", "lab.yaml:2: options.third: 'third' is not among workers. Known"),
    ("task: {worker: first}", "lab.yaml:2: task.worker: 'first' is not among workers. Known: scri"),
    ("cameras: {front: {depth: true}}", "cameras.front.depth: depth images are published where"),
]
