"""Profiles of older versions are rejected by name, with the line and what to write now."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from vla_zenoh.errors import ProfileError
from vla_zenoh.profile import load_profile, read_profile, to_yaml
from vla_zenoh.profile.former import FORMER

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "renamed.md"
ENTRY = {"cameras": "front", "hosts": "here"}
ROS2 = "panda_ros2"


def old_profile(place: str) -> str:
    """A profile with an old key at `place`; the key is on its last line."""
    names = place.split(".")
    above = [ENTRY[names[at - 1]] if name == "*" else name for at, name in enumerate(names)]
    lines = [f"extends: {ROS2 if names[0] == 'ros2' else 'panda_sim'}"]
    lines += [f"{'  ' * depth}{name}:" for depth, name in enumerate(above)]
    if names[0] == "hosts":
        lines.insert(-1, "    nodes: [router]")
    lines[-1] += " /vla"
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("place", FORMER)
def test_an_old_key_is_named_with_its_line_and_what_to_write_now(
    place: str, tmp_path: Path
) -> None:
    file = tmp_path / "old.yaml"
    text = old_profile(place)
    file.write_text(text)
    with pytest.raises(ProfileError) as caught:
        load_profile(str(file))
    named = [line for line in str(caught.value).splitlines() if FORMER[place] in line]
    assert len(named) == 1
    assert named[0].startswith(f"{file}:{text.count(chr(10))}: {place.split('.')[0]}.")


def test_an_old_profile_inside_a_recording_is_named_too() -> None:
    data = yaml.safe_load(to_yaml(load_profile("panda_sim")))
    data["sim"]["gains"] = "stiff"
    with pytest.raises(ProfileError, match=r"profile in run\.mcap:\d+: sim\.gains: is gone"):
        read_profile(yaml.safe_dump(data), "profile in run.mcap")


def test_the_page_has_every_old_key() -> None:
    table = PAGE.read_text("utf-8").partition("## Profile")[2].partition("\n## ")[0]
    for place in FORMER:
        assert f"| `{place}" in table, place
