"""Doctor: what is missing is found, and the advice names the package or setting."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import threading
from pathlib import Path

import pytest
import typer
from peer_rig import free_port
from typer.testing import CliRunner, Result
from vla_zenoh_franka.check import network_card
from vla_zenoh_franka.plugin import FrankaOptions

from vla_zenoh.errors import ProfileError, how_to_install
from vla_zenoh.lab.cli.doctor import doctor as doctor_command
from vla_zenoh.lab.cli.doctor import report, try_zenoh
from vla_zenoh.lab.doctor import HostFinding, computer, needs_of
from vla_zenoh.lab.doctor.access import router
from vla_zenoh.lab.doctor.computer import (
    TIME_ERROR,
    clock_finding,
    disk,
    governor,
    kernel_state,
    niceness,
    processors,
    real_time_priority,
    shared_memory,
    video_devices,
)
from vla_zenoh.lab.doctor.software import (
    MODULES,
    libraries,
    load_errors,
    opengl,
    robot,
    version_fault,
)
from vla_zenoh.lab.doctor.software import renderer_finding as judge_backend
from vla_zenoh.profile import SessionProfile, load_profile
from vla_zenoh.simulation.backend import Backend

TIBIBYTE_MIB = 1024 * 1024
SEGMENT_BYTES = 3 * 1024 * 1024


def app() -> typer.Typer:
    made = typer.Typer()
    made.command()(doctor_command)
    return made


# -- Python and libraries ---------------------------------------------------------------------


def test_a_missing_library_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MODULES, "control", {"no_such_module": "no-such-distribution"})
    finding = libraries("control", required=True)
    assert finding.level == "fail"
    assert "no_such_module" in finding.found
    assert finding.advice == how_to_install("control")
    assert libraries("control", required=False).level == "warn"


def test_a_library_that_misses_a_system_library_names_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "needs_gomp.py").write_text("import ctypes\nctypes.CDLL('libgomp.so.1.none')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setitem(MODULES, "sim", {"needs_gomp": "numpy"})
    finding = libraries("sim", required=True)
    assert finding.level == "fail"
    assert finding.advice == "sudo apt install libgomp1"


def test_a_library_that_crashes_is_named_and_does_not_crash_the_doctor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "crasher.py").write_text("import os\nos.abort()\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    errors = load_errors(["json", "crasher", "numpy"])
    assert list(errors) == ["crasher"]
    assert "status -6" in errors["crasher"]


@pytest.mark.parametrize(
    ("distribution", "version", "fault"),
    [
        ("eclipse-zenoh", "1.10.0", ""),
        ("eclipse-zenoh", "1.9.4", "eclipse-zenoh 1.9.4 is too old"),
        ("eclipse-zenoh", "2.0.0", "eclipse-zenoh 2.0.0 is too new"),
        ("numpy", "1.26.4", ""),
        ("numpy", "1.24.0", "numpy 1.24.0 is too old"),
        ("mujoco-core", "3.9.1", "mujoco-core 3.9.1 is too old"),
        ("mujoco-core", "5.0.0", "mujoco-core 5.0.0 is too new"),
        ("pyyaml", "1.0", ""),
    ],
)
def test_versions_are_judged(distribution: str, version: str, fault: str) -> None:
    assert version_fault(distribution, version) == fault


# -- OpenGL -----------------------------------------------------------------------------------
def test_where_opengl_draws_nothing_is_advised() -> None:
    finding = judge_backend(Backend("egl"))
    assert (finding.level, finding.advice) == ("ok", "")


def test_where_opengl_is_missing_the_packages_are_named() -> None:
    finding = judge_backend(Backend("raycast", "egl: no libEGL", "libegl1 libopengl0"))
    assert finding.level == "warn"
    assert "egl: no libEGL" in finding.found
    assert finding.advice.startswith("sudo apt install libegl1 libopengl0 ")


def test_ray_casting_that_is_asked_for_is_well() -> None:
    assert opengl("raycast").level == "ok"


def test_an_unknown_renderer_fails() -> None:
    finding = opengl("vulkan")
    assert finding.level == "fail"
    assert "vulkan" in finding.found


# -- time -------------------------------------------------------------------------------------
def test_looking_at_niceness_leaves_the_process_as_it_was() -> None:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    finding = niceness()
    assert os.getpriority(os.PRIO_PROCESS, 0) == before
    if finding.level != "ok":
        assert "nice" in finding.advice


def test_looking_at_real_time_priority_leaves_the_thread_as_it_was() -> None:
    before = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
    finding = real_time_priority()
    assert (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority) == before
    if finding.level == "warn":
        assert "/etc/security/limits.d/" in finding.advice
        assert "rtprio" in finding.advice


def test_one_processor_is_too_few() -> None:
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert processors().level == "warn"
    finally:
        os.sched_setaffinity(0, allowed)


@pytest.mark.parametrize(
    ("kinds", "level"), [([], "ok"), (["performance"] * 2, "ok"), (["performance", "slow"], "warn")]
)
def test_only_the_performance_governor_is_well(
    kinds: list[str], level: str, tmp_path: Path
) -> None:
    for number, kind in enumerate(kinds):
        folder = tmp_path / f"cpu{number}" / "cpufreq"
        folder.mkdir(parents=True)
        (folder / "scaling_governor").write_text(kind + "\n")
    finding = governor(tmp_path)
    assert finding.level == level
    if level == "warn":
        assert "cpupower frequency-set --governor performance" in finding.advice


def test_an_unsynchronised_clock_is_a_warning() -> None:
    assert clock_finding(TIME_ERROR).level == "warn"
    assert "chrony" in clock_finding(TIME_ERROR).advice
    assert clock_finding(0).level == "ok"


def test_the_kernel_says_how_the_clock_is() -> None:
    assert kernel_state() in {0, 1, 2, 3, 4, TIME_ERROR}


# -- memory and disk --------------------------------------------------------------------------
def test_too_little_shared_memory_names_the_size_to_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(computer, "held_bytes", lambda: 0)  # what other tests hold is theirs
    assert shared_memory(tmp_path, wanted_mib=1).level == "ok"
    finding = shared_memory(tmp_path, wanted_mib=TIBIBYTE_MIB * 1024)
    assert finding.level == "warn"
    assert "--shm-size=" in finding.advice


def test_absent_shared_memory_is_a_warning(tmp_path: Path) -> None:
    assert shared_memory(tmp_path / "absent").level == "warn"


def test_a_full_disk_is_worse_than_a_nearly_full_one(tmp_path: Path) -> None:
    assert disk(tmp_path, wanted_mib=1).level == "ok"
    assert disk(tmp_path, wanted_mib=TIBIBYTE_MIB * 1024).level in {"warn", "fail"}


# -- router -----------------------------------------------------------------------------------
def refuse(_endpoint: str) -> str:
    return "refused"


def accept(_endpoint: str) -> str:
    return ""


def test_a_free_port_is_well_where_the_router_is_to_run_and_a_warning_elsewhere() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    assert router(endpoint, is_router=True, try_zenoh=refuse).level == "ok"
    finding = router(endpoint, is_router=False, try_zenoh=refuse)
    assert finding.level == "warn"
    assert "vla-zenoh up" in finding.advice


def test_a_port_held_by_another_program_fails_and_says_how_to_find_it() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        finding = router(f"tcp/127.0.0.1:{port}", is_router=True, try_zenoh=refuse)
    assert finding.level == "fail"
    assert f"sport = :{port}" in finding.advice


def test_a_real_session_tells_a_program_that_is_no_router() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"

        def hang_up() -> None:
            try:
                while True:
                    server.accept()[0].close()
            except OSError:
                return

        thread = threading.Thread(target=hang_up)
        thread.start()
        try:
            assert try_zenoh(SessionProfile(), endpoint)
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


def test_a_router_that_answers_is_well() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        endpoint = f"tcp/127.0.0.1:{server.getsockname()[1]}"
        assert router(endpoint, is_router=False, try_zenoh=accept).level == "ok"


def test_a_host_that_does_not_exist_is_a_fault_of_the_profile() -> None:
    finding = router("tcp/no-such-host.invalid:7447", is_router=False, try_zenoh=refuse)
    assert finding.level == "fail"
    assert "session.connect" in finding.advice


def test_other_links_than_tcp_are_tried_with_a_session() -> None:
    endpoint = "unixsock-stream/tmp/router.sock"
    assert router(endpoint, is_router=False, try_zenoh=accept).level == "ok"
    assert router(endpoint, is_router=False, try_zenoh=refuse).level == "warn"


# -- cameras ---------------------------------------------------------------------
def test_a_camera_the_profile_names_has_to_be_there(tmp_path: Path) -> None:
    (tmp_path / "video0").write_bytes(b"")
    assert video_devices(["0"], tmp_path).level == "ok"
    finding = video_devices([str(tmp_path / "video4")], tmp_path)
    assert finding.level == "fail"
    assert "video4 not found" in finding.found
    assert "video0" in finding.found


def test_no_camera_is_well_when_none_is_needed(tmp_path: Path) -> None:
    assert video_devices([], tmp_path) == HostFinding("video devices", "ok", "none")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_camera_without_permission_names_the_group(tmp_path: Path) -> None:
    (tmp_path / "video0").write_bytes(b"")
    (tmp_path / "video0").chmod(0)
    finding = video_devices(["0"], tmp_path)
    assert finding.level == "fail"
    assert "--groups video" in finding.advice


# -- needs ------------------------------------------------------------------------------------
def test_a_host_needs_what_its_nodes_need() -> None:
    profile = load_profile("panda_sim_two_hosts")
    robot, gpu = needs_of(profile, "robot"), needs_of(profile, "gpu")
    assert robot.roles == {"base", "camera", "control", "sim"}
    assert robot.is_router
    assert gpu.roles == {"base"}
    assert not gpu.is_router
    assert needs_of(profile).roles == {"base", "camera", "control", "sim"}
    assert needs_of(load_profile("panda_ros2")).roles == {"base", "camera", "control"}


def test_usb_cameras_of_a_profile_are_needed_on_the_host_that_has_them() -> None:
    profile = load_profile("panda_sim")
    camera = profile.cameras["front"].model_copy(update={"source": "v4l2:/dev/video7"})
    profile = profile.model_copy(update={"cameras": {"front": camera}})
    assert needs_of(profile).devices == ("/dev/video7",)


def test_an_unknown_host_gets_the_list() -> None:
    with pytest.raises(ProfileError, match=r"no host 'moon'; it has: robot, gpu"):
        needs_of(load_profile("panda_sim_two_hosts"), "moon")


# -- the whole --------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The command with a profile whose camera is not there."""
    profile = tmp_path_factory.mktemp("doctor") / "lab.yaml"
    profile.write_text(
        "extends: panda_sim\ncameras:\n  front: {source: 'v4l2:/dev/video_absent'}\n"
    )
    return CliRunner().invoke(app(), ["--profile", str(profile), "--json"])


def findings_of(told: Result) -> dict[str, HostFinding]:
    return {each["name"]: HostFinding(**each) for each in json.loads(told.stdout)}


def test_every_finding_that_is_not_well_has_an_advice(told: Result) -> None:
    findings = findings_of(told)
    assert {"Python", "processors", "disk", "wall clock"} <= findings.keys()
    for finding in findings.values():
        assert finding.found
        assert bool(finding.advice) == (finding.level != "ok"), finding


def test_the_environment_of_the_tests_has_every_library(told: Result) -> None:
    found = [each for name, each in findings_of(told).items() if name.startswith("libraries: ")]
    assert len(found) == len(MODULES)
    assert {finding.level for finding in found} == {"ok"}, found


def test_a_missing_camera_makes_the_command_fail(told: Result) -> None:
    assert told.exit_code == 1
    assert any("video_absent" in each.found for each in findings_of(told).values())


def test_only_what_will_not_work_makes_a_report_fail(capsys: pytest.CaptureFixture[str]) -> None:
    findings = [HostFinding("disk", "warn", "full", "tidy up"), HostFinding("Python", "ok", "new")]
    report(findings, as_json=False)
    assert "0 will not work, 1 could work better" in capsys.readouterr().out
    with pytest.raises(typer.Exit) as ended:
        report([*findings, HostFinding("camera", "fail", "absent", "plug it in")], as_json=False)
    assert ended.value.exit_code == 1
    shown = capsys.readouterr().out
    assert "plug it in" in shown
    assert "1 will not work" in shown


def test_a_host_without_a_profile_is_refused() -> None:
    result = CliRunner().invoke(app(), ["--host", "robot"])
    assert result.exit_code == 2


def test_a_robot_that_is_not_here_fails_the_host_that_commands_it_alone(tmp_path: Path) -> None:
    (tmp_path / "lab.yaml").write_text(
        f"extends: panda_sim\nrobot: {{description: {tmp_path}/arm.urdf}}\n"
        "hosts: {desk: {nodes: [router, sim, command]}, gpu: {nodes: [worker, camera]}}\n"
    )
    lab = load_profile(str(tmp_path / "lab.yaml"))
    for host in ("desk", None):
        (found,) = robot(lab, host)
        assert (found.name, found.level) == ("robot", "fail")
        assert "arm.urdf' is not a file" in found.found
    assert list(robot(lab, "gpu")) == []
    (found,) = robot(load_profile("panda_sim"))
    assert found.level == "ok"


@pytest.mark.skipif(shutil.which("ip") is None, reason="needs the program ip")
def test_a_network_card_that_reports_no_speed_is_of_unknown_speed(tmp_path: Path) -> None:
    """Linux writes -1 there, where there is no cable or a driver does not know."""
    address = "192.0.2.1"
    route = subprocess.run(
        ["ip", "-o", "route", "get", address], capture_output=True, text=True, check=False
    )
    card = re.search(r"\bdev (\S+)", route.stdout)
    if card is None or card[1] == "lo":
        pytest.skip("no route to a network")
    (tmp_path / card[1]).mkdir()
    (tmp_path / card[1] / "speed").write_text("-1\n")
    finding = network_card(FrankaOptions(address=address), tmp_path)
    assert (finding.level, finding.found) == ("warn", f"{card[1]}, of unknown speed")
