"""Every reader of bytes that somebody else made, and what it may raise: nothing but our own errors.

`TARGETS` is read by the tests beside this file and by ``fuzz.py``. A reader that is new has one
line here.
"""

from __future__ import annotations

import io
import json
import runpy
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import r2c_peer
import typer
from model_wires import groot, lerobot_server, npy, openpi, openvla_rest, origami, xpolicylab
from vla_zenoh_diagnose import inferences, net
from vla_zenoh_diagnose import keys as cli_keys
from vla_zenoh_diagnose.inference_views import InferenceView
from vla_zenoh_franka_node import wire as franka_node
from vla_zenoh_mcp import protocol
from vla_zenoh_policy_servers import message as arrays
from vla_zenoh_primitives.requests import decode_request
from vla_zenoh_r2c import wire as r2c
from vla_zenoh_ros2 import readers
from vla_zenoh_ros2.bridge_view import read_view
from vla_zenoh_ros2.keys import Attachment
from vla_zenoh_ros2.messages import Messages, parse
from vla_zenoh_ros2.pictures import COMPRESSED_IMAGE, IMAGE
from vla_zenoh_ros2.ros_names import domains_of_bridges, domains_of_rmw
from vla_zenoh_serve import openpi_server
from vla_zenoh_strands import wire as strands

from vla_zenoh.cli import status_table as cli_status
from vla_zenoh.cli.options import model_options
from vla_zenoh.cli.output import Screen
from vla_zenoh.client.answer import Answer, decode_answer
from vla_zenoh.codec import image, message, records, settings
from vla_zenoh.errors import CodecError, PeerError, ProfileError, SpecError, VlaZenohError
from vla_zenoh.keys import Keys
from vla_zenoh.lab.cli.options import number_list
from vla_zenoh.lab.cli.output import plain_types
from vla_zenoh.lab.demo.scripted_motions import parse_scripted
from vla_zenoh.lab.evaluation.mcap_file import evaluate_loaded
from vla_zenoh.lab.recording.record_types import RECORDS, record_from_json, record_to_json
from vla_zenoh.lab.recording.run import load_run
from vla_zenoh.lab.tasks.order import parse_prompt
from vla_zenoh.policy import ActionSpec, ModelSpec, ObservationSpec
from vla_zenoh.policy.loader import find_model, make_policy
from vla_zenoh.profile import load_profile
from vla_zenoh.types import ClockReply, Depth, Event, Header, InferenceDebug, NodeStatus

ENTITY = "@/b1/ros2/dds/010f00/writer/1/rt/joint_states"
OF_TORCH = Path(__file__).parents[1] / "contract" / "lerobot_actions.pickle"
CORPUS = Path(__file__).parent / "corpus"
"""Inputs that once broke a reader, or nearly: a folder for each target."""


MCP_TOOLS = protocol.tools(["front"], list(protocol.DESCRIPTIONS))
MAX_SHOWN = 50_000
"""Characters that a few nodes may fill a screen with."""


class Target(NamedTuple):
    """A reader.

    Args:
        name: of the reader and of its folder in the corpus.
        read: takes the bytes.
        raises: what it may raise.
        seeds: inputs that can be read; fuzzers begin with them.
    """

    name: str
    read: Callable[[bytes], Any]
    raises: tuple[type[Exception], ...]
    seeds: Callable[[], list[bytes]]

    def try_(self, data: bytes) -> bool:
        """Read, and tell whether it could be read; what may not be raised comes through."""
        try:
            self.read(data)
        except self.raises as error:
            if not str(error):
                raise AssertionError("an error without words") from error
            return False
        return True

    def corpus(self) -> list[bytes]:
        """Seeds, and what is kept in the folder."""
        folder = CORPUS / self.name
        kept = sorted(folder.iterdir()) if folder.is_dir() else []
        return [*self.seeds(), *(path.read_bytes() for path in kept)]


# -- what is not one function ---------------------------------------------------------------------
def _franka_node(data: bytes) -> Any:
    """By its size, as the driver knows it by its key."""
    readers = {474: franka_node.decode_state, 40: franka_node.decode_gripper_state}
    return readers.get(len(data), franka_node.decode_reply)(data)


_FRANKA_NODE = [bytes([1]) + bytes(473), bytes([1]) + bytes(39), b'{"ok":false,"error":"no lease"}']


def _raw(data: bytes) -> Any:
    words, _, pixels = data.partition(b"\n")
    return image.decode_raw(pixels, words.decode("latin-1"))


def _depth(data: bytes) -> Any:
    words, _, file = data.partition(b"\n")
    return image.decode_depth(file, words.decode("latin-1"))


def _depths() -> list[bytes]:
    depth = Depth(np.arange(64, dtype=np.uint16).reshape(8, 8) * 900, 0.001)
    return [image.depth_schema(depth).encode() + b"\n" + image.encode_depth(depth)]


@cache
def _messages() -> Messages:
    return Messages("jazzy")


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")


def _in_file(suffix: str, read: Callable[[Path], Any], data: bytes) -> Any:
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        path = Path(folder) / f"input{suffix}"
        path.write_bytes(data)
        return read(path)


def _cli(data: bytes) -> None:
    """What ``echo`` and ``keys`` do with anybody's payload, for people and for programs."""
    words, _, payload = data.partition(b"\n")
    found = cli_keys.decode(payload, _text(words))
    json.dumps(found)
    json.dumps(plain_types(found))
    _display(str(found))


def _display(*renderables: Any) -> int:
    """Print as commands do; without colours nothing but lines may come of it. How much it is."""
    out = io.StringIO()
    screen = Screen(file=out, width=120)
    for each in renderables:
        screen.print(each)
    shown = out.getvalue()
    assert not any(ord(c) < 32 and c not in "\n\t" for c in shown), "it steers the terminal"
    return len(shown)


def _told(data: bytes) -> None:
    """What ``status``, ``net`` and ``keys`` show of nodes that say anything."""
    found = records.decode(NodeStatus, data)
    other = replace(found, host="elsewhere")
    nodes = {"command": found, "a\x1b[2J[/b]": other}
    heard = {name: (status, 0.1, True) for name, status in nodes.items()}
    assert _display(cli_status.render("panda", heard, [])) < MAX_SHOWN
    pairs, lines = net.pairs_of(nodes, []), net.lines_of(nodes)
    _display(*net.tables("panda", pairs, lines, 100.0))
    _display(cli_keys.table(cli_keys.image_keys(Keys("panda"), heard)))


def _event_told(data: bytes) -> None:
    event = records.decode(Event, data)
    happened = [("a\x1b[2J", Header(1, 2, "sim#1"), event)] * 9
    assert _display(cli_status.render("panda", {}, happened)) < MAX_SHOWN


def _sight(data: bytes) -> None:
    sight = InferenceView(records.decode(InferenceDebug, data), {"front": data})
    assert _display(inferences.table({"w": sight})) < MAX_SHOWN


def _options(data: bytes) -> None:
    words = _text(data)
    for read in (lambda: model_options([words]), lambda: number_list("--x", words, 0.0, 1e3)):
        with suppress(typer.BadParameter):
            read()


def _prompt(data: bytes) -> None:
    words = settings.decode_text(data)
    with suppress(SpecError):
        parse_scripted(words)
    parse_prompt(words)


def _peer_actions(data: bytes) -> None:
    for read in (groot.read_answer, groot.read_actions):
        read(data)


def _all_of(*reads: Callable[[bytes], Any]) -> Callable[[bytes], None]:
    """Each of them is tried; the last one's error is raised."""

    def read(data: bytes) -> None:
        failure: VlaZenohError | None = None
        for one in reads:
            try:
                one(data)
            except VlaZenohError as error:
                failure = error
        if failure is not None:
            raise failure

    return read


# -- seeds ----------------------------------------------------------------------------------------
def _spec() -> ModelSpec:
    return ModelSpec(
        name="m", observation=ObservationSpec(), action=ActionSpec(horizon=2, dt_s=0.1)
    )


@cache
def examples() -> dict[type, Any]:
    """One small record of every kind that travels."""
    from vla_zenoh import types as t

    zeros, down = np.zeros(2), np.array([1.0, 0.0, 0.0, 0.0])
    cause = t.Cause("w", 1, 2, 3, 4, 5, 6, 7)
    three, six = np.zeros(3), np.zeros(6)
    made = (
        t.JointState(("a", "b"), zeros, zeros, zeros),
        t.PoseState(three, down, six),
        t.GripperState(0.08, False, False),
        t.PoseCommand(three, down, six, six, three, down, "active", cause),
        t.JointCommand(("a", "b"), zeros, zeros, zeros, "active", cause),
        t.GripperCommand(0.0, 0.1, 10.0),
        t.Task(1, True, "HARD: go up", "w", 5.0),
        t.ActionChunk("w", "0" * 16, 1, 2, 3, 4, np.zeros((2, 7), np.float32), 5, 6, 7),
        _spec(),
        t.NodeStatus("n", "active", "h", 1, 2, {"a": 1.0}, {}, {"l": (1.0, 2.0)}, {"c": 1}, {}),
        t.Event("info", "notice", "loaded", "in 1 s"),
        t.PrivilegedState({"block": three}),
        t.SceneState("table", np.zeros(9)),
        t.ObjectPoses(("red",), np.zeros((1, 3)), down[None]),
        t.InferenceDebug(
            "w", 1, "0" * 16, 1, 2, "up", np.zeros((2, 7), np.float32), 1.0, {"a": 1}, False
        ),
    )
    return {type(record): record for record in made}


def _gray(height: int = 8, width: int = 12) -> Any:
    from vla_zenoh.types import Image

    return Image(np.full((height, width, 3), 128, np.uint8))


def _cdr_seed(kind: str) -> list[bytes]:
    every = _messages()
    pixels = np.zeros(12, np.uint8)
    jpeg = np.frombuffer(image.encode_jpeg(_gray()), np.uint8)
    fields: dict[str, dict[str, Any]] = {
        "JointState": {"name": ["a"], "position": np.zeros(1)},
        "Image": {"height": 2, "width": 2, "step": 6, "encoding": "rgb8", "data": pixels},
        "CompressedImage": {"format": "jpeg", "data": jpeg},
    }
    return [every.encode(every.new(kind, **fields.get(kind.rsplit("/", 1)[-1], {})))]


def _depth_seed(kind: str) -> list[bytes]:
    every, counts = _messages(), np.ones((2, 3), np.uint16)
    png = np.frombuffer(cv2.imencode(".png", counts)[1].tobytes(), np.uint8)
    fields: dict[str, Any] = {"format": "16UC1; compressedDepth png", "data": png}
    if kind == IMAGE:
        fields = {"height": 2, "width": 3, "step": 6, "encoding": "16UC1"}
        fields["data"] = counts.view(np.uint8).ravel()
    return [every.encode(every.new(kind, **fields))]


def _recorded_seed(kind: type) -> list[bytes]:
    text, _ = record_to_json(kind, records.encode(examples()[kind]))
    return [text.encode()]


def _recording() -> list[bytes]:
    from vla_zenoh.keys import Keys
    from vla_zenoh.lab.recording.sample import MSGPACK, TEXT, Sample
    from vla_zenoh.lab.recording.writer import RecordingWriter
    from vla_zenoh.types import Header, PoseState

    keys, at_ns = Keys("panda"), 10**18
    payload = records.encode(examples()[PoseState])

    def write(path: Path) -> bytes:
        out = RecordingWriter(path, keys, profile_yaml="a: 1\n", base_frame="base", began_ns=at_ns)
        for number in range(2):
            head = Header(at_ns + number, number, "sim#1")
            out.write(Sample(keys.state_pose, payload, MSGPACK, head, at_ns + number))
        out.write(Sample(keys.prompt, b"HARD: go up", TEXT, None, at_ns + 9))
        out.finish({"dropped": {}})
        return path.read_bytes()

    return [_in_file(".mcap", write, b"")]


_PROFILE = b"""extends: panda_sim
cameras:
  front: {source: "sim:front", width: 64, height: 48}
limits: {step_m: 0.02}
task: &a {prompt: hold, rate_hz: 1e1}
"""
_STATISTICS = b'{"a": {"action": {"q01": [0,0,0,0,0,0,0], "q99": [1,1,1,1,1,1,1]}}}'


@cache
def _statistics() -> Any:
    """OpenVLA's statistics, as its worker reads them."""
    return runpy.run_path(str(find_model("openvla").path.parent / "statistics.py"))


def _read_statistics(data: bytes) -> None:
    module = _statistics()
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return
    if isinstance(content, dict):
        module["read_range"](content, module["choose"](content, "", "here"))


def _replay(path: Path) -> Any:
    return make_policy(find_model("replay"), {"file": str(path)})


def _replay_seed() -> list[bytes]:
    def write(path: Path) -> bytes:
        steps = np.zeros((1, 2, 7), np.float32)
        spec = json.dumps(_spec().to_dict())
        np.savez(path, spec=spec, steps=steps, length=np.array([2]))
        return path.read_bytes()

    return [_in_file(".npz", write, b"")]


# -- the table ------------------------------------------------------------------------------------
def _targets() -> Iterator[Target]:
    codec, peer = (CodecError,), (PeerError,)
    yield Target(
        "message",
        message.unpack,
        codec,
        lambda: [message.pack({"a": [1, 2.5, None, "x", b"y"], "b": [0.0]})],
    )
    yield Target(
        "arrays",
        arrays.unpack,
        codec,
        lambda: [arrays.pack({"a": [1, 2.5, None, "x", b"y"], "b": np.arange(3.0)})],
    )
    head = _header_bytes
    yield Target("header", records.decode_header, codec, lambda: [head()])
    for kind in RECORDS:
        yield Target(
            f"record-{kind.__name__}",
            partial(records.decode, kind),
            codec,
            lambda kind=kind: [records.encode(examples()[kind])],
        )
    for name, words in (
        ("text", b"put the red brick in the box"),
        ("activation", b"true while anna"),
        ("rate", b"1e1"),
        ("percent", b"30 %"),
        ("name", b"scripted"),
        ("seed", b"17"),
    ):
        yield Target(
            f"setting-{name}",
            getattr(settings, f"decode_{name}"),
            codec,
            lambda words=words: [words],
        )
    for name, asked in (
        ("move_to", b'{"holder": "a", "position_m": [0.5, 0.1, 0.3]}'),
        ("grip", b'{"holder": "a", "width_m": 0.03}'),
        ("run", b'{"holder": "a", "worker": "w", "until": {"gripper": "closed"}}'),
    ):
        yield Target(
            f"primitive-{name}",
            partial(decode_request, name),
            codec,
            lambda asked=asked: [asked],
        )
    yield Target(
        "primitive-answer",
        decode_answer,
        codec,
        lambda: [Answer(True, "reached", position_m=(0.1, 0.2, 0.3)).encode()],
    )
    yield Target("prompt", _prompt, codec, lambda: [b"HARD: go up x3", b"put the red brick down"])
    yield Target("depth", _depth, codec, _depths)
    yield Target("jpeg", image.decode_jpeg, codec, lambda: [image.encode_jpeg(_gray())])
    yield Target("raw", _raw, codec, lambda: [b"rgb8;2x2\n" + bytes(12)])
    yield Target(
        "stamps",
        partial(records.decode, ClockReply),
        codec,
        lambda: [records.encode(ClockReply(1, 2))],
    )
    # -- other systems
    yield Target(
        "mcp",
        lambda data: protocol.read(data, MCP_TOOLS, "1"),
        (),
        lambda: [
            b'{"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": {"name": "home"}}'
        ],
    )
    yield Target(
        "openpi",
        _all_of(openpi.read_metadata, openpi.read_answer, openpi_server.read_observation),
        peer,
        lambda: [arrays.pack({"actions": np.zeros((2, 7), np.float32)})],
    )
    yield Target(
        "groot",
        _peer_actions,
        peer,
        lambda: [groot.pack({"action.arm": np.zeros((2, 7))})],
    )
    yield Target(
        "xpolicylab",
        lambda data: xpolicylab.read_actions(xpolicylab.read_answer(data, "infer", "1")),
        peer,
        lambda: [
            arrays.pack(
                {
                    "message_type": "infer_result",
                    "message_id": "1",
                    "payload": {"actions": [{"ee_pose": [0.0] * 7}]},
                }
            )
        ],
    )
    yield Target(
        "lerobot-server",
        lambda data: lerobot_server.read_actions(data, 7),
        peer,
        lambda: [lerobot_server.policy_setup(OF_TORCH.read_bytes())],
    )
    yield Target("franka-node", _franka_node, codec, lambda: _FRANKA_NODE)
    yield Target("npy", npy.load, peer, lambda: [npy.dump(np.zeros((2, 3)))])
    yield Target(
        "openvla-rest",
        partial(openvla_rest.read_answer, 200),
        peer,
        lambda: [openvla_rest.pack(np.zeros(7)).encode(), b"[[1, 2], [3, 4]]"],
    )
    yield Target(
        "origami",
        lambda data: origami.read_answer(data, "infer", "1"),
        peer,
        lambda: [
            arrays.pack(
                {
                    "protocol_version": origami.PROTOCOL,
                    "operation": "infer",
                    "request_id": "1",
                    "actions": np.zeros((2, 7)),
                }
            )
        ],
    )
    yield Target(
        "r2c-observation",
        r2c.decode_observation,
        codec,
        lambda: [r2c_peer.observation([0.1] * 6)],
    )
    yield Target("r2c-actions", r2c.decode_actions, codec, lambda: [r2c_peer.actions([[0.1] * 6])])
    yield Target(
        "strands-command",
        strands.decode_command,
        codec,
        lambda: [b'{"sender_id": "boss", "turn_id": "1", "command": {"action": "stop"}}'],
    )
    # -- ROS 2
    yield Target(
        "ros2-attachment", Attachment.decode, codec, lambda: [bytes(16) + b"\x10" + bytes(16)]
    )
    for kind in readers.READERS:
        yield Target(
            f"ros2-{kind.rsplit('/', 1)[-1]}",
            lambda data, kind=kind: readers.read(_messages(), kind, data),
            codec,
            lambda kind=kind: _cdr_seed(kind),
        )
    for kind in (IMAGE, COMPRESSED_IMAGE):
        yield Target(
            f"ros2-depth-{kind.rsplit('/', 1)[-1]}",
            lambda data, kind=kind: readers.read_depth(_messages(), kind, data),
            codec,
            lambda kind=kind: _depth_seed(kind),
        )
    yield Target(
        "ros2-request",
        lambda data: readers.read_request(_text(data)),
        codec,
        lambda: [b'{"id": "7", "prompt": "go up", "rate_hz": 5, "active": true}'],
    )
    yield Target(
        "ros2-bridge-view",
        lambda data: read_view([("@/b1/ros2/config", data), (_text(data), b"{}")]),
        codec,
        lambda: [b'{"domain": 3}', b"@/b1/ros2/dds/010f00"],
    )
    yield Target(
        "ros2-names-of-a-bridge",
        lambda data: domains_of_bridges([("@/b1/ros2/config", b"{}"), (ENTITY, data)]),
        codec,
        lambda: [b'{"type_name": "a::msg::dds_::B_", "qos": {"user_data": [1, 2]}}'],
    )
    yield Target(
        "ros2-names-of-rmw-zenoh",
        lambda data: domains_of_rmw([_text(data)]),
        codec,
        lambda: [b"@ros2_lv/3/ab/0/1/MP/%/%/arm/%a/a::msg::dds_::B_/RIHS01_0/::,1:,:,:,,"],
    )
    yield Target(
        "ros2-definition",
        lambda data: parse("a_msgs/msg/A", _text(data)),
        (ProfileError,),
        lambda: [b"float64[] a\nstring<=10 b\nint32 C=4\n"],
    )
    # -- files
    for kind in RECORDS:
        yield Target(
            f"recorded-{kind.__name__}",
            lambda data, kind=kind: record_from_json(kind, _text(data)),
            codec,
            lambda kind=kind: _recorded_seed(kind),
        )
    own = (VlaZenohError,)
    yield Target(
        "recording",
        partial(_in_file, ".mcap", lambda path: evaluate_loaded(load_run(path))),
        own,
        _recording,
    )
    yield Target(
        "profile",
        partial(_in_file, ".yaml", lambda path: load_profile(str(path))),
        (ProfileError,),
        lambda: [_PROFILE],
    )
    yield Target("statistics", _read_statistics, own, lambda: [_STATISTICS])
    yield Target("replay", partial(_in_file, ".npz", _replay), own, _replay_seed)
    # -- the command line
    yield Target(
        "cli-payload",
        _cli,
        codec,
        lambda: [
            b"application/msgpack\n" + message.pack({"a": np.zeros((2, 2)), "b": b"x"}),
            b"text/plain\nwords",
        ],
    )
    status = NodeStatus(
        "command",
        "active",
        "h",
        1,
        2,
        rates_hz={"front": 30.0},
        latency_ms={"inference": (1.0, 2.0)},
        counters={"refused.late": 1},
        detail={
            "rate_hz": 5.0,
            "why": "",
            "cameras": {"front": {}},
            "security": "insecure",
            "listen": ["tcp/0.0.0.0:7447"],
            "clocks": {"command": {"round_trip_ms": 1.0, "offset_ms": 1.0, "uncertainty_ms": 1.0}},
            "net": {
                "links": ["tls/[fe80::1]:7447"],
                "sent": {"a": [1.0, 2.0]},
                "lost": {"a": 1},
            },
        },
    )
    yield Target("cli-told", _told, codec, lambda: [records.encode(status)])
    yield Target("cli-event", _event_told, codec, lambda: [records.encode(examples()[Event])])
    yield Target("cli-seen", _sight, codec, lambda: [records.encode(examples()[InferenceDebug])])
    yield Target("cli-options", _options, own, lambda: [b"horizon=4", b"1,2.5,3"])


def _header_bytes() -> bytes:
    from vla_zenoh.types import Header

    return records.encode_header(Header(1, 2, "sim#1"))


TARGETS = {target.name: target for target in _targets()}
