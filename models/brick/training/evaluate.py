# /// script
# requires-python = ">=3.11"
# dependencies = ["vla-zenoh[sim]", "onnxruntime>=1.20"]
# ///
"""Runs the policy, or its teacher, in closed loop: the chain in lockstep, judged by true poses.

    python evaluate.py --family put --episodes 50 --seed 10000 [--vary all] [--delay 0.14]

The same commander, guard and controller as in the nodes, on a virtual clock, see
`vla_zenoh_benchmarks.lockstep`. With ``--collect DIR`` every situation that the policy reached is
stored with the teacher's action, in the format of generate.py (dataset aggregation: Ross et al.,
AISTATS 2011).
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from expert import Hand as TeacherHand
from expert import Point, foretell
from generate import labelled
from states import Situation
from vla_zenoh_benchmarks.lockstep.loop import Lockstep
from vla_zenoh_benchmarks.lockstep.worker import Delays
from vla_zenoh_benchmarks.statistics import wilson_95
from worker import HORIZON, Brick, Hand, Question, Waypoints

from vla_zenoh.lab.tasks.episode import TaskEpisode, draw_episode, draw_stay
from vla_zenoh.lab.tasks.judge import LIMIT_S, TaskJudge, Verdict
from vla_zenoh.lab.tasks.order import COLOURS, FAMILIES, Order, brick
from vla_zenoh.policy import Observation
from vla_zenoh.profile import Profile, load_profile
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import RobotModel
from vla_zenoh.simulation.scene import VARIATIONS
from vla_zenoh.simulation.world import World, build_world
from vla_zenoh.types import Image, ObjectPoses

PROFILE = "panda_bricks"
LOOK_S = 0.1
WAIT_S = 0.7


def poses_of(world: World) -> ObjectPoses:
    """True poses, as the simulator publishes them."""
    objects = world.objects()
    return ObjectPoses(
        tuple(objects),
        np.array([place for place, _ in objects.values()]),
        np.array([turn for _, turn in objects.values()]),
    )


def point(world: World, name: str) -> Point:
    """Pose of an object."""
    (x, y, z), (qx, qy, qz, qw) = world.objects()[name]
    yaw = math.atan2(2 * (qx * qy + qw * qz), 1 - 2 * (qy * qy + qz * qz))
    return Point(float(x), float(y), float(z), yaw)


def teachers(hand: Hand) -> TeacherHand:
    """The same hand in the teacher's own type."""
    down = None if hand.down_m is None else (float(hand.down_m[0]), float(hand.down_m[1]))
    return TeacherHand(*hand.position_m.tolist(), hand.yaw_rad, hand.width_m, hand.swept_m, down)


def taught(world: World, order: Order, hand: Hand, given: np.ndarray) -> np.ndarray:
    """(H, 5) the teacher's waypoints."""
    now = teachers(hand)
    goal = point(world, brick(order.onto) if order.onto else "box")
    committed = [tuple(row[:5].tolist()) for row in given if row[5]]
    target = point(world, brick(order.target))
    way = foretell(order.family, now, target, goal, order.direction, committed)
    return np.array(way)


@dataclass(slots=True)
class Stage:
    """World, cameras and profile, reused for all episodes."""

    profile: Profile
    vary: tuple[str, ...]
    world: World = field(init=False)
    renderer: Renderer = field(init=False)
    size: tuple[int, int] = (640, 480)

    def __post_init__(self) -> None:
        changed = self.profile.sim.model_copy(update={"vary": self.vary})
        self.profile = self.profile.model_copy(update={"sim": changed})
        self.world = build_world(self.profile)
        self.renderer = Renderer(self.profile.sim.scene, [RobotModel()])

    def picture(self, camera: str) -> Image:
        """Present image of a camera."""
        self.renderer.set_qpos(self.world.qpos())
        return Image(self.renderer.render(camera, *self.size))

    def reset(self, seed: int) -> None:
        """Reset the world and its appearance."""
        self.world.reset(seed)
        self.renderer.vary(seed, self.vary)


class Teacher(Brick):
    """The teacher as a policy: it uses true poses instead of images."""

    def __init__(self, world: World, order: Order, prefix: str) -> None:
        super().__init__(prefix=prefix)
        self._world, self._order = world, order

    def load(self) -> None:
        """Nothing to load."""

    def think(self, questions: Sequence[Question]) -> list[Waypoints]:
        """Waypoints by the teacher."""
        if self._order.family == "stay":
            stay = Waypoints(np.zeros((HORIZON, 4)), np.zeros(HORIZON, bool), False, "")
            return [stay for _ in questions]
        ways = [taught(self._world, self._order, one.hand, one.given) for one in questions]
        return [Waypoints(way[:, :4], way[:, 4] > 0.5, True, "") for way in ways]


class Watched(Brick):
    """The policy, with a record of every situation."""

    def __init__(
        self, weights: str, stage: Stage, order: Order, collect: bool, prefix: str
    ) -> None:
        super().__init__(weights=weights, threads="1", prefix=prefix)
        self._stage, self._order, self._collect = stage, order, collect
        self._random = np.random.default_rng(stage.world.seed)
        self.seen: list[tuple[Observation, Hand]] = []
        self.samples: list[dict[str, np.ndarray]] = []

    def think(self, questions: Sequence[Question]) -> list[Waypoints]:
        """Waypoints by the network."""
        for observation, hand, _ in questions:
            self.seen.append((observation, hand))
            if self._collect and self._order.family != "stay":
                self._note(observation, hand)
        return super().think(questions)

    def _note(self, observation: Observation, hand: Hand) -> None:
        world = self._stage.world
        situation = Situation(
            {colour: point(world, brick(colour)) for colour in COLOURS},
            point(world, "box"),
            self._order,
            teachers(hand),
            (0.0, 0.0),
        )
        pictures = observation.images["front"], observation.images["wrist"]
        self.samples.append(labelled(situation, pictures, self._stage.renderer, self._random))


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of an episode."""

    episode: TaskEpisode
    verdict: Verdict
    watched: Watched | None


def run(stage: Stage, args: argparse.Namespace, seed: int, family: str) -> Outcome:
    """One episode."""
    stage.reset(seed)
    world = stage.world
    before = poses_of(world)
    if family == "stay":
        episode = draw_stay(seed)
    else:
        episode = draw_episode(seed, before, family=family, held_out=args.held_out)
    policy: Brick = (
        Teacher(world, episode.order, args.prefix)
        if args.teacher
        else Watched(args.weights, stage, episode.order, args.collect is not None, args.prefix)
    )
    delays = Delays(inference_s=args.delay, camera_hz=args.camera_hz)
    picture = None if args.teacher else stage.picture
    loop = Lockstep(stage.profile, world, policy, delays=delays, picture=picture)
    loop.put("prompt", episode.prompt)
    loop.put("rate", args.rate)
    loop.run(WAIT_S)
    loop.put("active", True)
    loop.run(0.02)
    if loop.commander.state.value != "active":
        raise SystemExit(f"not active: {loop.commander.why}")
    judge = TaskJudge(episode.order, before, world.tcp()[0])
    begin_ns, verdict = loop.now_ns, None
    limit_s = 5.0 if family == "stay" else args.limit
    while verdict is None and loop.now_ns - begin_ns < limit_s * 1e9:
        loop.run(LOOK_S)
        time_s = (loop.now_ns - begin_ns) / 1e9
        width_m = world.gripper_state().width_m
        verdict = judge.update(poses_of(world), width_m, time_s, world.tcp()[0])
    return Outcome(episode, verdict or judge.end(), policy if isinstance(policy, Watched) else None)


def sheet(watched: Watched, path: Path) -> None:
    """Images of an episode, from its beginning to its end."""
    rows = []
    for index in np.linspace(0, len(watched.seen) - 1, 12).astype(int):
        observation, hand = watched.seen[index]
        pair = [cv2.resize(observation.images[c], (320, 240)) for c in ("front", "wrist")]
        tile = np.ascontiguousarray(np.hstack(pair))
        text = " ".join(f"{v * 1e3:.0f}" for v in (*hand.position_m, hand.width_m, hand.swept_m))
        cv2.putText(tile, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1)
        rows.append(tile)
    grid = np.vstack([np.hstack(rows[i : i + 3]) for i in range(0, 12, 3)])
    cv2.imwrite(str(path), grid[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", default="all", choices=[*FAMILIES, "stay", "all"])
    parser.add_argument("--episodes", type=int, default=20, help="of each family")
    parser.add_argument("--seed", type=int, default=10_000)
    parser.add_argument("--teacher", action="store_true")
    parser.add_argument("--weights", default="", help="folder of an export")
    parser.add_argument("--held-out", action="store_true", help="wordings never trained with")
    parser.add_argument("--vary", default="", help="all, or names with commas between")
    parser.add_argument("--delay", type=float, default=0.0, help="s of one inference")
    parser.add_argument("--prefix", default="off", choices=["on", "off"], help="see model.Brick")
    parser.add_argument("--rate", type=float, default=5.0, help="inferences per second")
    parser.add_argument("--camera-hz", type=float, default=10.0)
    parser.add_argument("--limit", type=float, default=LIMIT_S, help="s for one episode")
    parser.add_argument("--pictures", type=Path, help="folder for picture sheets of failures")
    parser.add_argument("--collect", type=Path, help="folder for what was seen, labelled")
    parser.add_argument("-o", "--output", type=Path)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    names = VARIATIONS if args.vary == "all" else tuple(v for v in args.vary.split(",") if v)
    stage = Stage(load_profile(PROFILE), tuple(names))
    families = FAMILIES if args.family == "all" else (args.family,)
    report: dict[str, object] = {}
    samples: list[dict] = []
    for family in families:
        good, failures, times = 0, Counter[str](), []
        for seed in range(args.seed, args.seed + args.episodes):
            outcome = run(stage, args, seed, family)
            verdict = outcome.verdict
            good += verdict.success
            times += [verdict.time_s] if verdict.success else []
            if not verdict.success:
                failures[verdict.failure] += 1
                print(f"  {seed} {outcome.episode.prompt!r}: {verdict.failure}", flush=True)
                if args.pictures and outcome.watched:
                    args.pictures.mkdir(parents=True, exist_ok=True)
                    sheet(outcome.watched, args.pictures / f"{family}_{seed}.png")
            samples += outcome.watched.samples if outcome.watched else []
        low, high = wilson_95(good, args.episodes)
        print(
            f"{family}: {good} of {args.episodes} ({low:.3f} to {high:.3f}), "
            f"median {np.median(times) if times else math.nan:.1f} s, {dict(failures)}",
            flush=True,
        )
        report[family] = {
            "successes": good,
            "episodes": args.episodes,
            "wilson_95": [low, high],
            "failures": dict(failures),
        }
    if args.output:
        args.output.write_text(json.dumps(report, indent=1) + "\n", "utf-8")
    if args.collect and samples:
        args.collect.mkdir(parents=True, exist_ok=True)
        stacked = {key: np.stack([s[key] for s in samples]) for key in samples[0]}
        # A number that is not one of those kept for validation.
        np.savez(args.collect / f"run{args.seed}-{args.seed * 10 + 1}.npz", **stacked)


if __name__ == "__main__":
    main()
