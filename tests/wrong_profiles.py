"""Wrong profiles: lines that are added to a good one, and the sentence that they get.

`profile check` rejects every one of them, and so does `up`, by the same function. A sentence may be
the beginning of what is said; `EXTENDED` are whole files beside a good one called ``base.yaml``.
"""

from __future__ import annotations

WRONG: list[tuple[str, str]] = [
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
    (
        "session: {router: zenod}",
        "wants 'own' or 'zenohd'; did you mean 'zenohd'? (given: 'zenod')",
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
        "wants 'sim', 'ros2' or 'arm'; did you mean 'ros2'? (given: 'ros')",
    ),
    ("robot: {tcp_frame: ''}", "robot.tcp_frame: must not be empty"),
    (
        "task: {worker: scritped}",
        "task.worker: 'scritped' is not among workers; did you mean 'scrip",
    ),
    ("task: {prompt: true}", "task.prompt: wants text; put it in quotes (given: True)"),
    (
        "cameras: {front: {source: webcam}}",
        "'webcam' is not a camera: write one of sim:CAMERA, v4l2",
    ),
    ("cameras: {front: {source: 'sim:'}}", "'sim:' is not a camera: write one of sim:CAMERA"),
    (
        "cameras: {front: {source: 'rtsp://'}}",
        "'rtsp://' lacks the host: write rtsp://HOST/PATH",
    ),
    ("cameras: {front: {source: 'ros2:/a'}}", "is 'ros2:/a', which needs a section ros2"),
    ("cameras: {'a/b': {source: 'sim:x'}}", "cameras.a/b: name 'a/b' cannot be part of a key"),
    ("hosts: {}", "lab.yaml:2: hosts: is empty: name at least one host and its nodes"),
    ("hosts: {a: {nodes: []}}", "lab.yaml:2: hosts.a.nodes: has 0 entries, wants at least 1"),
    ("hosts: {a: {}}", "lab.yaml:2: hosts.a.nodes: is missing"),
    (
        "hosts:\n  a:\n    nodes: [router, camer]",
        "lab.yaml:4: hosts.a.nodes.1: wants 'router', 'sim', 'ros2', 'arm', 'camera', "
        "'command' or 'worker'; did you mean 'camera'?",
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
        "hosts.b.nodes: command runs on a and b: the robot obeys one command node",
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
        "hosts: {a: {nodes: [router, sim, camera, command], pictures: {rate_hz: 5}}}",
        "hosts.a.pictures: is for workers, and this host runs none",
    ),
    (
        "hosts: {a: {nodes: [router, sim, camera, command, worker], pictures: {}}}",
        "hosts.a.pictures: is for cameras elsewhere, and this host has its own",
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
