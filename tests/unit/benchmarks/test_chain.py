"""Benchmark: statistics, tables, and the other ways of serving as they are on the wire."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import time

import cv2
import msgpack
import numpy as np
import pytest
from rich.console import Console
from vla_zenoh_benchmarks.command_runner import cpu_s

from benchmarks import peers
from benchmarks.chain import report
from benchmarks.chain.our_chain import bench_profile
from benchmarks.chain.process import Server, free_port
from benchmarks.chain.report import CHUNK, LINES, POSE, ROUND_TRIP, STAGES, TICK_WAIT, Result
from benchmarks.chain.rounds import Interval, summarise
from benchmarks.chain.ways import REFERENCE, WAYS, Load, ServingWay
from benchmarks.peers import arrays
from benchmarks.picture import NOISE_SIGMA, noisy_picture
from vla_zenoh.errors import NodeError, how_to_install

SIGMA_TOLERANCE = 0.2  # grey levels
PNG_BYTES = (300_000, 700_000)  # what a camera's picture of this size has
CPU_TOLERANCE_S = 0.05
BUSY_S = 0.2

A_PEER = ServingWay("peer", "peer", "a peer")
ABSENT = ServingWay("absent", "peer", "a way that is not there", ("a_module_that_nobody_has",))
CHAIN = WAYS[0]


def chain_slot(chunk_ms: list[float], lost: int = 0) -> Interval:
    figures = {figure: chunk_ms for figure, _ in LINES["chain"]} | dict.fromkeys(STAGES, chunk_ms)
    return Interval(REFERENCE, figures, {CHUNK: 1.5}, 0.25, lost)


def peer_slot(values_ms: list[float], cpu_ms: float = 2.0) -> Interval:
    return Interval("peer", {ROUND_TRIP: values_ms}, {ROUND_TRIP: cpu_ms})


def shown(result: Result) -> str:
    out = Console(file=io.StringIO(), width=160, markup=False)  # as the command line shows it
    out.print(report.main_table(result))
    stages = report.stage_table(result)
    if stages is not None:
        out.print(stages)
    assert isinstance(out.file, io.StringIO)
    return out.file.getvalue()


# -- statistics -----------------------------------------------------------------------------------
def test_percentiles_are_of_all_requests_of_all_rounds() -> None:
    rounds = [{"peer": peer_slot([float(i) for i in range(first, 101, 2)])} for first in (0, 1)]
    found = summarise(rounds, "peer", ROUND_TRIP, (REFERENCE, CHUNK))
    assert found is not None
    assert (found.p50, found.p95, found.p99, found.requests) == (50.0, 95.0, 99.0, 101)


def test_a_ratio_compares_within_a_round_so_that_a_slow_round_does_not_shift_it() -> None:
    rounds = [
        {REFERENCE: chain_slot([1.0 * slow] * 3), "peer": peer_slot([4.0 * slow] * 3)}
        for slow in (1, 1, 50)
    ]
    found = summarise(rounds, "peer", ROUND_TRIP, (REFERENCE, CHUNK))
    assert found is not None
    assert found.ratio == pytest.approx(4.0)
    assert (found.low, found.high) == (4.0, 200.0)


def test_cpu_time_is_the_median_of_the_rounds() -> None:
    rounds = [{"peer": peer_slot([1.0], cpu)} for cpu in (1.0, 2.0, 90.0)]
    found = summarise(rounds, "peer", ROUND_TRIP, (REFERENCE, CHUNK))
    assert found is not None
    assert found.cpu == 2.0


def test_a_way_that_was_not_measured_has_no_summary_and_no_reference_gives_no_ratio() -> None:
    assert summarise([{}], "peer", ROUND_TRIP, (REFERENCE, CHUNK)) is None
    alone = summarise([{"peer": peer_slot([1.0])}], "peer", ROUND_TRIP, (REFERENCE, CHUNK))
    assert alone is not None
    assert alone.ratio is None


# -- report ---------------------------------------------------------------------------------------
def test_the_table_names_a_missing_library_and_how_to_install_it() -> None:
    result = Result([ABSENT], [{}], {}, Load())
    assert f"not installed: {how_to_install('bench')}" in shown(result)
    assert result.to_dict()["ways"]["absent"]["missing"] == ["a_module_that_nobody_has"]


def test_the_wait_for_the_tick_stands_in_a_line_of_its_own() -> None:
    text = shown(Result([CHAIN], [{REFERENCE: chain_slot([3.25])}], {}, Load()))
    assert f"{STAGES[TICK_WAIT]}" in text
    assert "the same without waiting for the tick" in text
    assert "3.250" in text


def test_lost_requests_and_standing_cost_are_said() -> None:
    result = Result([CHAIN], [{REFERENCE: chain_slot([1.0], lost=3)}], {"cores": 2}, Load())
    told = "\n".join(report.notes(result))
    assert "3 requests were not answered" in told
    assert "25 % of one core" in told


def test_the_result_is_json() -> None:
    rounds = [{REFERENCE: chain_slot([1.0, 2.0]), "peer": peer_slot([4.0, 8.0])}]
    told = json.loads(json.dumps(Result([CHAIN, A_PEER, ABSENT], rounds, {}, Load()).to_dict()))
    assert told["ways"]["peer"][ROUND_TRIP]["ratio"] == pytest.approx(4.0)
    assert told["ways"][REFERENCE][POSE]["requests"] == 2
    assert set(told["ways"][REFERENCE]["stages"]) == set(STAGES)


# -- picture and messages -------------------------------------------------------------------------
def test_the_picture_has_a_cameras_noise_and_a_cameras_size_as_png() -> None:
    picture = noisy_picture()
    assert picture.shape == (480, 640, 3)
    across = np.diff(picture[..., 0].astype(float), axis=0)
    assert np.std(across) / np.sqrt(2) == pytest.approx(NOISE_SIGMA, abs=SIGMA_TOLERANCE)
    _, png = cv2.imencode(".png", picture)
    assert PNG_BYTES[0] < len(png) < PNG_BYTES[1]


def test_arrays_are_written_in_openpis_form() -> None:
    picture = noisy_picture(32, 24)
    plain = msgpack.unpackb(arrays.pack({"observation/image": picture}))["observation/image"]
    assert plain == {
        b"__ndarray__": True,
        b"data": picture.tobytes(),
        b"dtype": "|u1",
        b"shape": [24, 32, 3],
    }
    assert np.array_equal(arrays.unpack(arrays.pack({"a": picture}))["a"], picture)


MANY_ROBOTS = {"groot": ("zmq",), "lerobot": ("lerobot",)}
"""What the peers need that only `benchmarks serving` has."""


@pytest.mark.parametrize("name", sorted(peers.MODULES))
def test_every_other_way_answers_pictures_with_its_seven_floats(name: str) -> None:
    ways = {way.name: way.modules for way in WAYS}
    for module in ways.get(name, MANY_ROBOTS.get(name, ())):
        pytest.importorskip(module)
    port = free_port()
    with Server("peer", name, str(port)) as server:
        server.await_port(port)
        client = peers.load(name).Client(port)
        try:
            for _ in range(2):
                assert client.request([noisy_picture(), noisy_picture(32, 24)]) == pytest.approx(
                    peers.ACTION
                )
        finally:
            client.close()


# -- processes ------------------------------------------------------------------------------------
def test_cpu_time_of_another_process_is_what_it_worked() -> None:
    code = (
        "import time\nwhile time.process_time() < 0.2: pass\nprint(time.process_time(), flush=True)"
        "\ninput()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        said_s = float(child.stdout.readline())
        measured_s = cpu_s(child.pid)
        child.communicate("\n")
    assert said_s >= BUSY_S
    assert measured_s == pytest.approx(said_s, abs=CPU_TOLERANCE_S)


def test_a_server_that_ends_is_told_instead_of_waited_for() -> None:
    began = time.monotonic()
    with (
        Server("peer", "flask", "no port") as server,
        pytest.raises(NodeError, match="peer flask no port"),
    ):
        server.await_port(free_port())
    assert time.monotonic() - began < 10


def test_servers_end_with_the_context() -> None:
    with Server("router", f"tcp/127.0.0.1:{free_port()}") as server:
        pid = server.pid
        os.kill(pid, 0)
    with pytest.raises(NodeError, match="has ended"):
        cpu_s(pid)


def test_the_chain_has_an_address_of_its_own_and_a_worker_that_takes_raw_pictures() -> None:
    pictures = [noisy_picture(224, 160)] * 3
    profile = bench_profile(1000.0, pictures)
    other = bench_profile(250.0, pictures)
    assert profile.session.connect == profile.session.listen != other.session.connect
    assert profile.timing.command_hz == 1000.0
    assert "camera" in profile.hosts["here"].nodes
    assert len(profile.cameras) == 3
    assert {(camera.width, camera.height) for camera in profile.cameras.values()} == {(224, 160)}
