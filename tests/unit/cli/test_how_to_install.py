"""What a person is told to install, from a checkout and from a wheel."""

from __future__ import annotations

import importlib.metadata
import json

import pytest
from typer.testing import CliRunner

from vla_zenoh.errors import MissingExtraError, how_to_install
from vla_zenoh.lab.cli import demo as demo_command
from vla_zenoh.program.main import app

WHEEL = "file:///home/anna/vla_zenoh-0.1.0-py3-none-any.whl"


class FakeDistribution:
    """An installed package that came from `url`."""

    def __init__(self, url: str) -> None:
        self._url = url

    def read_text(self, name: str) -> str | None:
        assert name == "direct_url.json"
        return json.dumps({"url": self._url}) if self._url else None


def installed_from(patch: pytest.MonkeyPatch, url: str) -> None:
    patch.setattr(importlib.metadata, "distribution", lambda _: FakeDistribution(url))


@pytest.mark.parametrize("url", ["file:///home/anna/vla-zenoh", ""])
def test_in_a_checkout_an_extra_is_installed_from_there(
    monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    installed_from(monkeypatch, url)
    said = "pip install -c constraints.txt '.[sim]' in a checkout of vla-zenoh"
    assert how_to_install("sim") == said


def test_whoever_has_a_wheel_is_told_the_same_wheel_with_the_extra(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed_from(monkeypatch, WHEEL)
    said = str(MissingExtraError("mujoco", "sim"))
    assert f"pip install 'vla-zenoh[sim] @ {WHEEL}'" in said
    assert f"uvx --from 'vla-zenoh[sim] @ {WHEEL}' vla-zenoh" in said


def test_a_package_of_plugins_comes_from_a_checkout_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed_from(monkeypatch, WHEEL)
    assert "./plugins/vla-zenoh-web" in how_to_install(package="vla-zenoh-web")


def test_a_demo_without_its_packages_names_all_its_extras_before_it_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(demo_command, "find_spec", lambda name: None if name == "mujoco" else name)
    done = CliRunner().invoke(app, ["demo"])
    assert isinstance(done.exception, MissingExtraError)
    assert "[brick,sim]" in str(done.exception)
