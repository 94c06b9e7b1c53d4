"""Values of options are checked where they are given: numbers, addresses, names, files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typed import typed
from typer.main import get_command
from vla_zenoh_policy_servers.adapter import address as address_option

from vla_zenoh.errors import ProfileError, SpecError
from vla_zenoh.profile import load_profile, override
from vla_zenoh.profile.schema import network_address
from vla_zenoh.program.main import app

USAGE, FAILED = 2, 1
SERVING = "secure init --folder keys -o lab.yaml --profile panda_sim_two_hosts"
TALKING = "--connect tcp/127.0.0.1:9"


def parameters(command: Any, path: tuple[str, ...] = ()) -> Iterator[Any]:
    """Every option and argument of every command, with the words of its command."""
    for name, below in getattr(command, "commands", {}).items():
        yield from parameters(below, (*path, name))
    for parameter in command.params:
        if hasattr(parameter, "type_descriptor"):
            yield pytest.param(parameter, id=" ".join((*path, *parameter.opts)))


ALL = [*parameters(get_command(app))]
NUMBERS = [each for each in ALL if each.values[0].type_descriptor.annotation in (int, float)]
TEXTS = {"rate rate_hz"}
"""Numbers that travel as text: the codec of the setting names their range."""


@pytest.mark.parametrize("parameter", [each for each in NUMBERS if each.id not in TEXTS])
def test_every_number_has_a_smallest_and_a_largest_value(parameter: Any) -> None:
    """So neither nan nor inf is one."""
    information = parameter.type_descriptor.parameter_info
    assert information.min is not None
    assert information.max is not None


def test_names_and_addresses_have_parsers() -> None:
    """Options by whose name one sees that they are names in keys, or addresses."""
    for each in ALL:
        parameter, information = each.values[0], each.values[0].type_descriptor.parameter_info
        if ADDRESSED & set(parameter.opts):
            assert information.parser is not None, each.id


ADDRESSED = {"--name", "--bind", "--address", "--connect", "--listen", "--ray", "--endpoint"}
ENDPOINTS = ["127.0.0.1:7447", "127.0.0.1:99999", "10.0.0.300:1", "a b:1", " ", "läb:7447"]
ENDPOINTS += ["a:1;x", "[::::]:1", "[::1]", "-a:1", "a..b:1", "127.0.0.1", "a:1:2", "lab_pc"]
ENDPOINTS += ["a\nb:7", "a:-1"]
GOOD = ENDPOINTS[0]
ROUTED = [each for each in ALL if {"--connect", "--listen", "--ray"} & set(each.values[0].opts)]


@pytest.mark.parametrize("parameter", ROUTED)
def test_every_endpoint_is_checked_where_it_is_given(
    parameter: Any,
) -> None:
    """With a parser, so before the command begins; nothing is started for any of them."""
    ray = "--ray" in parameter.opts
    parse = parameter.type_descriptor.parameter_info.parser
    for text in ENDPOINTS:
        given = text if ray else f"tcp/{text}"
        if text == GOOD:
            assert parse(given) == given
            continue
        with pytest.raises(ValueError, match=r"HOST:PORT|IPv|host name|port is at most|endpoint"):
            parse(given)
    with pytest.raises(ValueError, match=r"HOST:PORT|protocol"):
        parse("nosuch/127.0.0.1:7447")


@pytest.mark.parametrize(
    "line",
    ["net --connect", "bench sim pusht --worker scripted --ray", "bench sim pusht --connect"]
    + ["up panda_sim --listen", "stop --connect", "node router --listen"],
)
def test_the_message_names_the_option_and_comes_at_once(
    line: str, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    done = typed(capsys, *line.split(), "tcp/10.0.0.300:7447")
    assert done.code == USAGE
    assert line.split()[-1] in done.said
    assert "10.0.0.300" in done.said


def test_an_endpoint_of_the_environment_is_checked_as_well(
    capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    monkeypatch.setenv("VLA_ZENOH_CONNECT", "tcp/10.0.0.300:7447")
    done = typed(capsys, "net")
    assert done.code == USAGE
    assert "10.0.0.300 is no IPv4 address" in done.said


ADDRESSES = ["127.0.0.1:7552", "10.0.0.300", "lab_pc", "tcp/10.0.0.3", "a b", "", "0.0.0.0", "::"]
ADDRESSES += ["[::1]", "-a", "a..b", "10.0.0", "x" * 64, "tls/a:1", "10.0.0.2/24"]


@pytest.mark.parametrize("text", ADDRESSES)
def test_what_is_no_address_of_a_computer_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="address"):
        network_address(text)


@pytest.mark.parametrize(
    "text", ["10.0.0.2", "fd00::2", "fe80::1%eth0", "lab-pc", "lab-pc.local", "localhost", "A1"]
)
def test_addresses_and_host_names_are_taken(text: str) -> None:
    assert network_address(text) == text


@pytest.mark.parametrize("address", ["10.0.0.300", "a b"])
@pytest.mark.parametrize("option", ["--at robot={}", "--address {}"])
def test_no_certificate_is_made_for_what_is_no_address(
    capsys: pytest.CaptureFixture[str], monkeypatch: Any, tmp_path: Path, option: str, address: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = typed(capsys, *SERVING.split(), *(word.format(address) for word in option.split()))
    assert done.code == USAGE, done.stderr
    assert option.split()[0] in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("address", [*ADDRESSES[:2], *ADDRESSES[3:-1]])
def test_what_a_profile_connects_to_is_an_address(address: str) -> None:
    for profile, driver in (("ur5e_rtde", "ur"), ("fr3", "franka")):
        with pytest.raises(ProfileError, match=rf"{driver}\.address: .*address"):
            override(load_profile(profile), {driver: {"address": address}})


@pytest.mark.parametrize(
    "source", ["rtsp:camera", "rtsp://10.0.0.300/a", "rtsp://a b/c", "rtsps://me:word@a..b/c"]
)
def test_a_camera_on_the_network_has_an_address(source: str) -> None:
    with pytest.raises(ProfileError, match=r"cameras\.front\.source: .*host"):
        override(load_profile("panda_sim"), {"cameras": {"front": {"source": source}}})
    for good in ("rtsp://me:word@10.0.0.2:554/a", "rtsps://[fd00::2]/a", "rtsp://lab_camera/a"):
        override(load_profile("panda_sim"), {"cameras": {"front": {"source": good}}})


@pytest.mark.parametrize(
    "url", ["ws://10.0.0.300:8000", "ws://a b:1", "ws://a..b", "ws://[::1:80", "ws://:80", ""]
)
def test_a_policy_server_has_an_address(url: str) -> None:
    with pytest.raises(SpecError, match="wanted ws://HOST:PORT"):
        address_option(url, "ws", "wss")
    for good in ("10.0.0.2:8000", "wss://policy_server/x", "ws://[::1]:8000"):
        assert address_option(good, "ws", "wss").hostname


LINES = [
    (f"{SERVING} --at robot=10.0.0.2 --at robot=10.0.0.3", USAGE, "two addresses"),
    (f"{SERVING} --address 10.0.0.2:7447", USAGE, "is no address"),
    ("web --bind 10.0.0.300", USAGE, "'10.0.0.300' is no address"),
    ("web --name lab:80", USAGE, "'lab:80' is no address"),
    ("view --serve --bind nosuch:5", USAGE, "'nosuch:5' is no address"),
    ("serve policy --worker scripted --host 10.0.0.300", USAGE, "is no address"),
    ("profile bridge-config -e tcp/a..b:7447", USAGE, "a..b is no host name"),
    ("up panda_sim --listen tcp/10.0.0.300:7447", USAGE, "10.0.0.300 is no IPv4 address"),
    (f"status --host nosuch {TALKING}", FAILED, "has no host 'nosuch'"),
    (f"stop --host a/b {TALKING}", FAILED, "has no host 'a/b'"),
    (f"worker scripted --name a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"teleop --name a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"node camera --name a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"record --name a/b {TALKING}", USAGE, "cannot be part of a key"),
    ("check scripted --name a/b", USAGE, "cannot be part of a key"),
    (f"do run a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"conform robot a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"conform worker a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"conform camera a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"conform camera front --node a/b {TALKING}", USAGE, "cannot be part of a key"),
    (f"inspect a/b {TALKING}", USAGE, "cannot be part of a key"),
    ("secure add a/b --role operator", USAGE, "cannot be part of a key"),
    (f"echo a//b {TALKING}", USAGE, "is no key"),
    (f"record --keys a//b {TALKING}", USAGE, "is no key"),
    ("do move-to --at 1,2", USAGE, "--at wants 3 numbers"),
    ("do move-to --at 0,0,1 --quat 0,0,1", USAGE, "--quat wants 4 numbers"),
    ("do grip 0.05 --holds 0.1,0.2", USAGE, "--holds wants 3 numbers"),
    ("do grip -0.05", USAGE, "wants numbers from 0 to 1"),
    ("rate -5", FAILED, "rate '-5' Hz is out of range: give 0.05 to 100"),
    ("rate -.5", FAILED, "is out of range: give 0.05 to 100"),
    ("speed -5", FAILED, "speed '-5' percent is out of range: give 0 to 100 percent"),
    ("rate --nosuch", USAGE, "No such option: --nosuch"),
    ("web --certificate junk --key junk", FAILED, "are no certificate and its key"),
]


@pytest.mark.parametrize(("line", "code", "said"), LINES, ids=[line for line, *_ in LINES])
def test_a_bad_value_is_named_with_what_is_allowed(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: Any,
    tmp_path: Path,
    line: str,
    code: int,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    (tmp_path / "junk").write_text("junk")
    done = typed(capsys, *line.split())
    assert said in done.said
    assert done.code == code
    assert done.stdout == ""


@pytest.mark.parametrize(
    "words",
    [
        ("prompt", ""),
        ("prompt", "  "),
        ("demo", "--prompt", ""),
        ("check", "scripted", "--prompt", ""),
        ("bench", "task", "--model", "scripted", "--prompt", ""),
        ("secure", "init", "--folder", ""),
        ("eval", ""),
        ("replay", ""),
        ("view", "", "--host", "here"),
        ("record", "--output", ""),
        ("secure", "show", "--folder", " "),
        ("do", "run", "scripted", "--prompt", ""),
        ("save", ""),
        ("serve", "policy", "--worker", "scripted", "--api-key", ""),
    ],
)
def test_an_empty_text_is_rejected_with_what_to_give(
    capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    done = typed(capsys, *words)
    assert done.code in (FAILED, USAGE)
    assert "empty" in done.said
    assert "give" in done.said
