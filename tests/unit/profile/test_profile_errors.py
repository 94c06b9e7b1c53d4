"""Every fault in a profile is told with file, line, path, and what would have been right."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from wrong_profiles import DRIVERS, WRONG

from vla_zenoh import resources
from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import (
    CameraProfile,
    SessionProfile,
    as_robot,
    load_profile,
    override,
)
from vla_zenoh.profile.schema import SecurityProfile, is_loopback
from vla_zenoh.resources import names

Write = Callable[..., str]

SIM = load_profile("panda_sim")


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a profile that begins with panda_sim, and gives its path."""

    def write(text: str, name: str = "lab.yaml", begin: str = "extends: panda_sim\n") -> str:
        path = tmp_path / name
        path.write_text(begin + text)
        return str(path)

    return write


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "own" / "profiles"
    folder.mkdir(parents=True)
    monkeypatch.setenv(resources.SEARCH_PATH_VARIABLE, str(folder.parent))
    return folder


def told(path: str) -> list[str]:
    """What is said of a profile, without the folder."""
    with pytest.raises(ProfileError) as caught:
        load_profile(path)
    return [line.replace(f"{Path(path).parent}/", "") for line in str(caught.value).splitlines()]


def test_who_names_an_unknown_driver_is_told_how_to_write_one(write: Write) -> None:
    (said,) = told(write("robot: {driver: kinova}\n"))
    assert "no robot driver 'kinova' is installed. Installed: " in said
    assert ", ".join(DRIVERS) in said
    assert said.endswith("arm: {file: my_arm.py}")


@pytest.mark.parametrize(("text", "said"), WRONG)
def test_a_fault_is_told_so_that_it_can_be_mended(write: Write, text: str, said: str) -> None:
    lines = told(write(text))
    assert any(said in line for line in lines), lines
    assert all(re.match(r"[^:]+\.yaml:\d+: ", line) for line in lines), lines


def test_every_fault_of_a_file_is_told_at_once(write: Write) -> None:
    text = "limts: {}\nlimits: {step_m: 9}\ntiming: {state_hz: 1}\nsession: {connect: [x]}\n"
    assert [line.split(":")[1] for line in told(write(text))] == ["3", "4", "5", "2"]


def test_a_fault_in_what_is_extended_is_told_with_its_own_file(write: Write) -> None:
    write("limits: {step_m: 9}\nabout: base\n", "base.yaml")
    child = write("about: child\nlimts: {}\n", "child.yaml", begin="extends: base\n")
    assert told(child) == [
        "base.yaml:2: limits.step_m: must be at most 0.2 (given: 9)",
        told(child)[1],
    ]
    assert told(child)[1].startswith("child.yaml:3: limts: unknown key")


def test_a_replaced_section_does_not_keep_the_lines_of_the_old_one(write: Write) -> None:
    write("hosts:\n  a: {nodes: [worker]}\n", "base.yaml")
    child = write("hosts:\n  a: {}\n", "child.yaml", begin="extends: base\n\n\n")
    assert told(child) == ["child.yaml:5: hosts.a.nodes: is missing"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"lab.yaml:1: robot: is missing: describe the robot, or start from another profile"),
        ("# only a remark\n", "lab.yaml:1: robot: is missing"),
        ("- a\n", "lab.yaml:1: a profile is a map of sections, this is a list"),
        ("robot: {name: a}\n", "lab.yaml:1: robot.description: is missing"),
        ("extends: nobody\n", "lab.yaml:1: extends: no profile called 'nobody'"),
        (
            "\nextends: panda_sin\n",
            "lab.yaml:2: extends: no profile called 'panda_sin'; did you mean",
        ),
        ("extends: [panda_sim]\n", "lab.yaml:1: extends: wants the name of one profile"),
        ("extends:\n", "lab.yaml:1: extends: wants the name of one profile"),
        ("extends: lab\n", "lab.yaml:1: extends: 'lab' is this file, and no other profile"),
        ("extends: ./lab.yaml\n", "profiles extend each other in a circle"),
        ("extends: absent.yaml\n", "lab.yaml:1: extends: there is no file or folder 'absent.yaml'"),
        ('extends: "a\\0b"\n', "lab.yaml:1: extends: "),
        ("extends: ~nobody_here/x.yaml\n", "lab.yaml:1: extends: '~nobody_here/x.yaml' cannot be"),
        (f"extends: {'x' * 5000}\n", "cannot be the name of a profile"),
    ],
)
def test_a_beginning_that_is_wrong_is_told(write: Write, text: str, said: str) -> None:
    assert said in told(write(text, begin=""))[0]


def test_profiles_that_extend_each_other_are_refused(write: Write) -> None:
    one = write("", "one.yaml", begin="extends: two\n")
    write("", "two.yaml", begin="extends: one\n")
    assert "one.yaml:1: profiles extend each other in a circle" in told(one)[0]
    assert "one.yaml -> two.yaml -> one.yaml" in told(one)[0]


def test_a_long_line_of_ancestors_is_refused(write: Write) -> None:
    write("", "p0.yaml")
    for number in range(1, 9):
        path = write("", f"p{number}.yaml", begin=f"extends: p{number - 1}\n")
    assert "too deep" in told(path)[0]


@pytest.mark.parametrize(
    "name", ["", "nobody", "/nobody.yaml", "a\0b", "x" * 5000, "~nobody_here/x.yaml"]
)
def test_a_name_that_leads_nowhere_is_one_error(name: str) -> None:
    with pytest.raises(ProfileError) as caught:
        load_profile(name)
    assert len(str(caught.value)) < 6000


def test_a_folder_or_a_pipe_is_not_a_profile(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    os.mkfifo(tmp_path / "pipe.yaml")
    for name in ("folder", "pipe"):
        with pytest.raises(ProfileError, match=rf"{name}\.yaml is not a file"):
            load_profile(str(tmp_path / f"{name}.yaml"))


# -- own profiles -----------------------------------------------------------------------------
def test_an_own_profile_stands_before_the_shipped_one(own_folder: Path) -> None:
    (own_folder / "panda_sim.yaml").write_text("extends: panda_sim\nabout: mine\nsim: {seed: 7}\n")
    profile = load_profile("panda_sim")
    assert (profile.about, profile.sim.seed, profile.name) == ("mine", 7, "panda_sim")
    assert profile.robot.arm_joints[0] == "panda_joint1"


def test_who_extends_a_name_gets_the_own_one(own_folder: Path) -> None:
    (own_folder / "panda_sim.yaml").write_text("extends: panda_sim\nsim: {seed: 7}\n")
    (own_folder / "lab.yaml").write_text("extends: panda_sim\n")
    assert load_profile("lab").sim.seed == 7
    assert load_profile("panda_sim_two_hosts").sim.seed == 0  # shipped ones keep to each other


def test_the_next_of_three_is_meant(
    own_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = tmp_path / "second" / "profiles"
    second.mkdir(parents=True)
    path = os.pathsep.join([str(own_folder.parent), str(second.parent)])
    monkeypatch.setenv(resources.SEARCH_PATH_VARIABLE, path)
    (own_folder / "panda_sim.yaml").write_text("extends: panda_sim\nsim: {seed: 7}\n")
    (second / "panda_sim.yml").write_text("extends: panda_sim\nabout: second\nsim: {seed: 6}\n")
    profile = load_profile("panda_sim")
    assert (profile.sim.seed, profile.about) == (7, "second")


def test_a_file_elsewhere_may_extend_its_own_name(write: Write) -> None:
    assert load_profile(write("sim: {seed: 7}", "panda_sim.yaml")).sim.seed == 7


def test_a_profile_beside_it_is_extended_first(write: Write) -> None:
    write("sim: {seed: 3}", "base.yml")
    assert load_profile(write("", "a.yaml", begin="extends: base\n")).sim.seed == 3
    assert load_profile(write("", "b.yaml", begin="extends: base.yml\n")).sim.seed == 3


def test_own_names_are_listed(own_folder: Path) -> None:
    (own_folder / "lab.yaml").write_text("extends: panda_sim\n")
    assert "lab" in names("profiles")


# -- merging ----------------------------------------------------------------------------------
def test_sections_are_merged_and_lists_and_hosts_replaced(write: Write) -> None:
    base = load_profile("panda_sim")
    profile = load_profile(
        write(
            "limits: {translation: {velocity_m_s: 0.1}}\nworkers: [scripted, replay]\n"
            "hosts: {lab: {nodes: [router]}}\n"
        )
    )
    assert profile.limits.translation.velocity_m_s == 0.1
    assert profile.limits.translation.jerk_m_s3 == base.limits.translation.jerk_m_s3
    assert profile.limits.workspace == base.limits.workspace
    assert profile.workers == ("scripted", "replay")
    assert list(profile.hosts) == ["lab"]


def test_null_takes_an_inherited_camera_away(write: Write) -> None:
    assert list(load_profile(write("cameras: {wrist: null}")).cameras) == ["front"]
    assert (
        "cameras.side: is empty: wants a map of: check, crop, depth_unit_m, exposure_us"
        in told(write("cameras: {side: null}"))[0]
    )


def test_options_of_a_worker_are_merged_with_those_inherited_and_null_ends_them(
    write: Write,
) -> None:
    write("options: {scripted: {a: b, c: d}}", "base.yaml")
    more = write("options: {scripted: {c: 'no'}}", "more.yaml", begin="extends: base\n")
    assert load_profile(more).options == {"scripted": {"a": "b", "c": "no"}}
    none = write("options: {scripted: null}", begin="extends: base\n")
    assert load_profile(none).options == {}


def test_null_ends_that_a_worker_serves_several_robots(write: Write) -> None:
    several = load_profile(write("serves: {scripted: [panda, left]}", "several.yaml"))
    assert several.serves == {"scripted": ("panda", "left")}
    alone = write("serves: {scripted: null}", begin="extends: several\n")
    assert load_profile(alone).serves == {}


def test_a_robot_called_otherwise_is_served_by_those_who_name_it() -> None:
    served = {"workers": ["scripted", "twin"], "serves": {"scripted": ["panda", "left"]}}
    several = override(SIM, served | {"task": {"worker": "twin"}})
    assert as_robot(several, "left").serves == several.serves
    assert as_robot(several, "other").serves == {}
    with pytest.raises(ProfileError, match="name 'a b' cannot"):
        as_robot(several, "a b")


def test_values_given_otherwise_are_checked_as_a_whole() -> None:
    profile = load_profile("panda_sim")
    other = override(profile, {"session": {"connect": ["tcp/10.0.0.2:7447"]}})
    assert other.session.connect == ("tcp/10.0.0.2:7447",)
    assert other.session.listen == profile.session.listen
    assert override(profile, {}) == profile
    with pytest.raises(ProfileError, match=r"^session\.connect\.0: 'x' is not an endpoint"):
        override(profile, {"session": {"connect": ["x"]}})


# -- endpoints --------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.8.9.1:7447", True),
        ("tcp/localhost:7447#iface=lo", True),
        ("tcp/[::1]:7447", True),
        ("unixsock-stream/run/vla.sock", True),
        ("tcp/localhost.lab.edu:7447", False),
        ("tcp/127.lab:7447", False),
        ("tcp/127.0.0.1.lab.edu:7447", False),
        ("tcp/[::]:7447", False),
        ("tcp/[::1234]:7447", False),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/10.0.0.2:7447", False),
    ],
)
def test_only_what_cannot_be_another_computer_is_loopback(endpoint: str, here: bool) -> None:
    assert is_loopback(endpoint) is here
    if here:
        assert SessionProfile(listen=(endpoint,)).listen == (endpoint,)
    else:
        with pytest.raises(ValueError, match="lets anyone on that network command the robot"):
            SessionProfile(listen=(endpoint,))


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tcp/[fe80::1%eth0]:7447",
        "udp/lab-pc.example.org:7447",
        "tls/robot:7447#root_ca_certificate=ca.pem",
        "quic/10.0.0.2:7447",
        "ws/10.0.0.2:80",
        "tcp/10.0.0.2:7447?prio=1-3#iface=eth0",
        "unixsock-stream/run/vla.sock",
    ],
)
def test_an_endpoint_that_is_taken_is_one_that_zenoh_takes(endpoint: str) -> None:
    security = SecurityProfile() if endpoint.startswith(("tls", "quic")) else None
    listen = ("tls/127.0.0.1:7447" if security else "tcp/127.0.0.1:7447",)
    session = SessionProfile(connect=(endpoint,), listen=listen, security=security)
    assert session.connect == (endpoint,)
    zenoh.Config.from_json5(f'{{connect: {{endpoints: ["{endpoint}"]}}}}')


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("10.0.0.2:7447", "is not an endpoint: write tcp/HOST:PORT"),
        ("", "is not an endpoint"),
        ("tpc/10.0.0.2:7447", r"unknown protocol; did you mean 'tcp'\? Known: tcp, udp, tls, quic"),
        ("http/10.0.0.2:80", "unknown protocol. Known: tcp"),
        ("tcp/10.0.0.2", "write tcp/HOST:PORT, as tcp/10.0.0.2:7447"),
        ("tcp/:7447", "write tcp/HOST:PORT"),
        ("tcp/10.0.0.2:port", "write tcp/HOST:PORT"),
        ("tcp/10.0.0.2:99999", "a port is at most 65535"),
        ("tcp//10.0.0.2:7447", "write tcp/HOST:PORT"),
        ("tcp/::1:7447", "write tcp/HOST:PORT"),
        ("tcp/a b:7447", "write tcp/HOST:PORT"),
        ("unixsock-stream/", "write unixsock-stream/PATH"),
    ],
)
def test_an_endpoint_that_leads_nowhere_is_refused(endpoint: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SessionProfile(connect=(endpoint,))


@pytest.mark.parametrize(
    "source",
    ["sim:front", "v4l2:/dev/video0", "v4l2:0", "rtsp://h/a", "rtsps://h", "file:a.mp4", "ros2:/a"],
)
def test_every_sort_of_camera_is_taken(source: str) -> None:
    assert CameraProfile(source=source).source == source


# -- anything ---------------------------------------------------------------------------------
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3)
    ),
    max_leaves=6,
)
SECTIONS = st.sampled_from(
    [
        "robot",
        "limits",
        "timing",
        "cameras",
        "sim",
        "workers",
        "task",
        "session",
        "hosts",
        "ros2",
        "root",
    ]
)


@given(SECTIONS, VALUES)
def test_a_section_may_hold_anything_and_is_refused_or_read(section: str, value: object) -> None:
    # Any error but ProfileError goes on to pytest.
    with contextlib.suppress(ProfileError):
        assert override(SIM, {section: value}) is not None
