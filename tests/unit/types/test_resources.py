"""Models, scenes, profiles and robot descriptions are found, or the error says what there is."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from vla_zenoh import resources
from vla_zenoh.errors import MissingExtraError, ResourceError, VlaZenohError

PANDA = "example-robot-data:panda_description/urdf/panda.urdf"


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for kind in resources.KINDS:
        (tmp_path / kind).mkdir()
    monkeypatch.setenv(resources.SEARCH_PATH_VARIABLE, str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("kind", sorted(resources.KINDS))
def test_everything_that_is_listed_can_be_found(kind: str) -> None:
    names = resources.names(kind)
    assert names
    for name in names:
        assert resources.find(kind, name).exists()


@pytest.mark.parametrize("kind", sorted(set(resources.KINDS) - {resources.BENCHMARKS}))
def test_what_is_shipped_comes_from_the_checkout_or_the_wheel(kind: str) -> None:
    assert resources.shipped(kind).is_dir()
    assert resources.shipped(kind).parts[-len(Path(kind).parts) :] == Path(kind).parts


def test_an_own_profile_hides_the_shipped_one_of_that_name(own_folder: Path) -> None:
    own = own_folder / "profiles" / "panda_sim.yaml"
    own.write_text("robot: {}\n")
    assert resources.find("profiles", "panda_sim") == own


def test_the_first_folder_of_the_search_path_wins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = []
    for name in ("first", "second"):
        folder = tmp_path / name / "profiles"
        folder.mkdir(parents=True)
        files.append(folder / "lab.yaml")
        files[-1].write_text("about: x\n")
    path = os.pathsep.join([str(tmp_path / "first"), "", str(tmp_path / "second")])
    monkeypatch.setenv(resources.SEARCH_PATH_VARIABLE, path)
    assert resources.find("profiles", "lab") == files[0]


def test_an_own_profile_is_listed_with_the_shipped_ones(own_folder: Path) -> None:
    (own_folder / "profiles" / "lab.yml").write_text("about: x\n")
    assert {"lab", "panda_sim"} <= set(resources.names("profiles"))


def test_a_model_may_be_a_file_or_a_folder(own_folder: Path) -> None:
    (own_folder / "models" / "small.py").write_text("")
    (own_folder / "models" / "large").mkdir()
    assert resources.find("models", "small").name == "small.py"
    assert resources.find("models", "large").is_dir()


def test_hidden_files_and_other_suffixes_are_not_listed(own_folder: Path) -> None:
    for name in (".hidden.yaml", "_private.yaml", "README.md", "notes"):
        (own_folder / "profiles" / name).write_text("")
    assert {".hidden", "_private", "README", "notes"}.isdisjoint(resources.names("profiles"))


def test_a_folder_is_not_a_profile(own_folder: Path) -> None:
    (own_folder / "profiles" / "lab").mkdir()
    with pytest.raises(ResourceError, match="no profile called 'lab'"):
        resources.find("profiles", "lab")


def test_a_path_is_taken_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("about: x\n")
    assert resources.find("profiles", str(file)) == file.resolve()


def test_a_path_that_leads_nowhere_is_named(tmp_path: Path) -> None:
    with pytest.raises(ResourceError, match=r"no file or folder .*absent\.yaml"):
        resources.find("profiles", str(tmp_path / "absent.yaml"))


def test_an_unknown_name_gets_the_nearest_one_and_the_list() -> None:
    with pytest.raises(ResourceError, match=r"did you mean 'panda_sim'.*Known: .*panda_sim"):
        resources.find("profiles", "panda_simm")


def test_the_error_is_one_of_ours_and_reads_as_text() -> None:
    with pytest.raises(VlaZenohError) as caught:
        resources.find("profiles", "zzz")
    assert str(caught.value).startswith("no profile called 'zzz'. Known: ")
    assert "as profiles/zzz.yaml below a folder that VLA_ZENOH_PATH names" in str(caught.value)


def test_the_robot_description_of_the_panda_has_its_meshes() -> None:
    urdf = resources.robot_urdf(PANDA)
    assert urdf.name == "panda.urdf"
    assert list(resources.meshes_of(urdf).glob("*.stl"))


def test_a_robot_that_is_not_in_the_collection_gets_the_list() -> None:
    with pytest.raises(ResourceError, match=r"robots there: .*panda_description"):
        resources.robot_urdf("example-robot-data:no_robot/urdf/no_robot.urdf")


def test_robots_are_found_in_whichever_layer_of_an_environment_their_package_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = tmp_path / "example_robot_data-9.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: example-robot-data\nVersion: 9\n")
    urdf = tmp_path / "cmeel.prefix/share/example-robot-data/robots/arm/arm.urdf"
    urdf.parent.mkdir(parents=True)
    urdf.write_text("<robot name='arm'/>")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert resources.robot_urdf("example-robot-data:arm/arm.urdf") == urdf


def test_a_description_that_comes_with_the_package_needs_no_other() -> None:
    urdf = resources.robot_urdf("shipped:panda.urdf")
    assert urdf == resources.shipped("profiles") / "panda.urdf"
    with pytest.raises(ResourceError, match="is not a file"):
        resources.robot_urdf("shipped:absent.urdf")


def test_without_the_collection_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [])
    with pytest.raises(MissingExtraError, match=r"pip install .* '\.\[meshes\]'"):
        resources.robot_urdf(PANDA)


def test_a_robot_description_may_be_a_file(tmp_path: Path) -> None:
    urdf = tmp_path / "arm" / "urdf" / "arm.urdf"
    urdf.parent.mkdir(parents=True)
    urdf.write_text("<robot name='arm'/>")
    assert resources.robot_urdf(str(urdf)) == urdf
    with pytest.raises(ResourceError, match=r"no collision meshes for arm\.urdf"):
        resources.meshes_of(urdf)
    with pytest.raises(ResourceError, match="is not a file"):
        resources.robot_urdf(str(tmp_path / "absent.urdf"))
