"""python -m benchmarks depth."""

from __future__ import annotations

import statistics
import threading
import time
from typing import Annotated, Any

import numpy as np
import typer
import zenoh
from numpy.typing import NDArray
from vla_zenoh_benchmarks.result_file import ResultOptions, write_json

from vla_zenoh.bus.session import open_session
from vla_zenoh.cli.options import options
from vla_zenoh.codec import records
from vla_zenoh.codec.image import decode_depth, encode_depth
from vla_zenoh.lab.cli.loopback import free_port
from vla_zenoh.nodes.camera.node import CameraNode
from vla_zenoh.profile import SessionProfile, load_profile
from vla_zenoh.profile.schema import CameraProfile
from vla_zenoh.simulation.render import Renderer
from vla_zenoh.simulation.robot_model import robot_model
from vla_zenoh.simulation.world import build_world
from vla_zenoh.types import Depth, Header, SceneState

RATE_HZ = 30.0
NOISE_SIGMA_M = 0.002
"""Of every pixel, as of a stereo camera at about a metre: without it files would be too small."""
HOLES = 0.05
"""Share of the pixels that are not measured."""
SEED = 0
TURNS = 50


@options
def depth(
    output: ResultOptions,
    seconds: Annotated[float, typer.Option("--seconds", "-s", min=1.0)] = 10.0,
    width: Annotated[int, typer.Option(min=16)] = 640,
    height: Annotated[int, typer.Option(min=16)] = 480,
) -> None:
    """Measure depth images at 30 Hz: time to encode and decode, bytes, and latency of the wire.

    The latency is from the publication of the simulator's scene to the decoded image in another
    session of this computer, with rendering in it. Images as the simulator draws them, and with the
    noise and holes of a camera.
    """
    from rich.table import Table

    rows = [*_codec_rows(width, height), _wire_row(width, height, seconds)]
    with output.open() as file:
        write_json(file, rows)
    table = Table(title=f"depth of {width}x{height}, 1 mm a count, at {RATE_HZ:g} Hz")
    for name in ("what", "bytes", "MB/s at 30 Hz", "encode ms", "decode ms", "latency ms p50, p95"):
        table.add_column(name, justify="left" if name == "what" else "right")
    for row in rows:
        late = f"{row['p50_ms']:.1f}, {row['p95_ms']:.1f}" if "p50_ms" in row else ""
        times = (f"{row[name]:.1f}" if name in row else "" for name in ("encode_ms", "decode_ms"))
        size = row["bytes"]
        table.add_row(row["name"], f"{size:.0f}", f"{size * RATE_HZ / 1e6:.2f}", *times, late)
    output.show(rows, table)


def _codec_rows(width: int, height: int) -> list[dict[str, Any]]:
    profile = load_profile("panda_sim")
    with Renderer(profile.sim.scene, [robot_model(profile.robot)]) as renderer:
        renderer.set_qpos(build_world(profile).qpos())
        drawn_m = renderer.render_depth("front", width, height)
    random = np.random.default_rng(SEED)
    noisy_m = drawn_m + random.normal(0.0, NOISE_SIGMA_M, drawn_m.shape)
    noisy_m[random.random(drawn_m.shape) < HOLES] = 0.0
    return [_codec_row("as drawn", drawn_m), _codec_row("with noise and holes", noisy_m)]


def _codec_row(name: str, depth_m: NDArray[np.float64]) -> dict[str, Any]:
    picture = Depth.of_metres(depth_m, 0.001)
    taken: dict[str, list[float]] = {"encode_ms": [], "decode_ms": []}
    for _ in range(TURNS):
        began = time.perf_counter()
        data = encode_depth(picture)
        encoded = time.perf_counter()
        decode_depth(data, "depth16;0.001")
        taken["encode_ms"].append((encoded - began) * 1e3)
        taken["decode_ms"].append((time.perf_counter() - encoded) * 1e3)
    medians = {key: statistics.median(values) for key, values in taken.items()}
    return {"name": name, "bytes": len(encode_depth(picture)), **medians}


def _wire_row(width: int, height: int, seconds: float) -> dict[str, Any]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    camera = CameraProfile(
        source="sim:front", width=width, height=height, rate_hz=RATE_HZ, depth_unit_m=0.001
    )
    session = SessionProfile(listen=(endpoint,), connect=(endpoint,))
    shipped = load_profile("panda_sim")
    profile = shipped.model_copy(update={"cameras": {"front": camera}, "session": session})
    qpos = build_world(profile).qpos()
    late_ms: list[float] = []
    sizes: list[int] = []

    def take(sample: zenoh.Sample) -> None:
        data, attachment = sample.payload.to_bytes(), sample.attachment
        decode_depth(data, str(sample.encoding).partition(";")[2])
        assert attachment is not None
        stamp_ns = records.decode_header(attachment.to_bytes()).stamp_wall_ns
        late_ms.append((time.time_ns() - stamp_ns) / 1e6)
        sizes.append(len(data))

    with (
        open_session(profile.session, mode="router"),
        open_session(profile.session) as watcher,
        open_session(profile.session) as own,
    ):
        node, stop = CameraNode(profile, own), threading.Event()
        thread = threading.Thread(target=node.run, args=(stop,))
        thread.start()
        heard = watcher.declare_subscriber(
            profile.keys.camera_depth("front"), zenoh.handlers.Callback(take, indirect=False)
        )
        scenes = watcher.declare_publisher(profile.keys.sim_scene)
        began, warm, number = time.monotonic(), 0, 0
        counted = began
        while len(sizes) - warm < RATE_HZ * seconds and time.monotonic() - began < 60 + 3 * seconds:
            if not warm and len(sizes) >= RATE_HZ:
                warm, counted = len(sizes), time.monotonic()
            header = records.encode_header(Header(time.time_ns(), number, "sim#bench"))
            scenes.put(records.encode(SceneState(profile.sim.scene, qpos)), attachment=header)
            number += 1
            time.sleep(1 / RATE_HZ)
        took_s = time.monotonic() - counted
        heard.undeclare()
        stop.set()
        thread.join()
    p50, p95 = np.percentile(late_ms[warm:], [50, 95])
    return {
        "name": f"scene to decoded picture, {(len(sizes) - warm) / took_s:.1f} Hz",
        "bytes": statistics.mean(sizes[warm:]),
        "p50_ms": float(p50),
        "p95_ms": float(p95),
    }
