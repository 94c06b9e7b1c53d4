"""Camera, policy, commander, guard and robot in one loop: the whole way from an image to a motion.

Without Zenoh, threads and real time; the nodes do the same, with streams between them.
"""

from ten_line_model import Lift

from vla_zenoh import Image, Stamped, load_profile
from vla_zenoh.control.commander import Commander, Inputs, Setting
from vla_zenoh.control.preflight import PeerSnapshot
from vla_zenoh.control.reachability import ReachabilityFilter
from vla_zenoh.guard.arm_guard import ArmGuard, Measured
from vla_zenoh.kinematics.so3 import Pose
from vla_zenoh.policy import check_steps
from vla_zenoh.policy.inference import make_chunk
from vla_zenoh.policy.observation import Streams, assemble
from vla_zenoh.profile import override
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import robot_models
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import Header

TICK_MS, STATE_MS, COMMAND_MS, IMAGE_MS = 1, 5, 4, 200


def run(seconds, policy):
    """Let `policy` move a simulated arm; returns the height of the TCP (m) at each image."""
    profile = override(load_profile("panda_sim"), {"task": {"prompt": "lift"}})
    name, spec = profile.task.worker, policy.spec
    robot, camera = build_world(profile), Renderer(profile.sim.scene, robot_models(profile))
    reach = ReachabilityFilter(profile)
    commander, velocity_rad_s = Commander(profile, reach=reach), reach.kinematics.velocity_rad_s

    def measured():
        joints = robot.joint_state()
        return Measured(Pose(*robot.tcp()), joints.position_rad, joints.velocity_rad_s)

    joints = robot.joint_range_rad, velocity_rad_s, robot.slides
    guard = ArmGuard(profile, measured, *joints, TICK_MS / 1e3)
    alive = frozenset({"sim", "camera", f"worker-{name}"})
    seen_by = {"camera_ages_s": {"front": 0.0}, "camera_nodes": {"front": "camera"}}
    peers = PeerSnapshot(alive, "sim", {name: spec}, {name: name}, same_host=alive, **seen_by)
    streams, inputs, heights_m, now_ns = Streams.of(spec.observation), Inputs(), [], 10**18

    def stamped(record, source):
        return Stamped(Header(now_ns, now_ns // 10**6, source), record, now_ns)

    for now_ms in range(0, round(seconds * 1e3), TICK_MS):
        now_ns += TICK_MS * 10**6
        if now_ms % STATE_MS == 0:  # the robot tells its state
            inputs.pose = stamped(robot.pose_state(guard.reference), "sim")
            inputs.joint = stamped(robot.joint_state(), "sim")
            inputs.gripper = stamped(robot.gripper_state(), "sim")
            streams.states["pose"].add(inputs.pose)
            streams.states["gripper"].add(inputs.gripper)
        if now_ms % IMAGE_MS == 0:  # an image for the policy, whose answer is a chunk of steps
            camera.set_qpos(robot.qpos())
            image = Image(camera.render("front", 224, 224))
            streams.images["front"].add(stamped(image, "camera"))
            seen = assemble(spec, commander.task, streams, not_before_ns=0, now_ns=now_ns)
            steps, times_ns = check_steps(spec.action, policy.infer(seen).steps), (now_ns,) * 3
            chunk = make_chunk(name, spec, seen, steps, False, patience_s=1.0, times_ns=times_ns)
            inputs.chunks = [stamped(chunk, name)]
            heights_m.append(float(robot.tcp()[0][2]))
        if now_ms % COMMAND_MS == 0:  # the commander makes the next set-point of states and chunks
            inputs.settings = () if commander.task.active else (Setting("active", True),)
            inputs.peers = peers
            command, inputs = commander.step(inputs, now_ns).pose, Inputs()
            if command is not None:
                guard.offer(stamped(command, "command"), now_ns)
        robot.tick(guard.tick(now_ns))  # the guard passes what keeps the limits, else it brakes
    return heights_m


if __name__ == "__main__":
    print(*(f"{height_m:.3f}" for height_m in run(3.0, Lift())), "m")
