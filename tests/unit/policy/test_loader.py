"""Finding a model file, reading its PEP 723 header, making its class; what is said of bad ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_zenoh.errors import ResourceError, WorkerError
from vla_zenoh.policy.loader import find_model, find_worker, import_model, make_policy

HEADER = """\
# /// script
# requires-python = ">=3.11"
# dependencies = [
#   "numpy>=1.26",
#   "no-such-distribution==1.0",
# ]
# ///
"""
MODEL = """\
from vla_zenoh.policy import ActionSpec, ActionSteps, ModelSpec

class Still:
    def __init__(self, size: str = "1"):
        self.size = float(size)
        self.spec = ModelSpec(name="still", action=ActionSpec(horizon=1, dt_s=0.1))

    def infer(self, observation):
        return ActionSteps([[0.0] * 7])
"""


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str, name: str = "mine.py") -> str:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(text.encode())
        return str(path)

    return write


def test_a_header_says_what_the_model_needs(write) -> None:
    model = find_model(write(HEADER + MODEL))
    assert model.name == "mine"
    assert model.requires_python == ">=3.11"
    assert model.dependencies == ("numpy>=1.26", "no-such-distribution==1.0")
    assert model.missing() == ["no-such-distribution==1.0"]


@pytest.mark.parametrize(
    "text",
    ["\ufeff" + HEADER + MODEL, (HEADER + MODEL).replace("\n", "\r\n")]
    + ['"""Doc first."""\n' + HEADER + MODEL, HEADER.replace("# ///\n", "#\n# ///\n") + MODEL],
    ids=["byte order mark", "Windows line ends", "after a docstring", "an empty comment line"],
)
def test_a_header_is_found_in_files_of_many_editors(write, text: str) -> None:
    assert len(find_model(write(text)).dependencies) == 2


def test_a_file_without_a_header_needs_nothing(write) -> None:
    model = find_model(write("# /// pyproject\n# dependencies = 3\n# ///\n" + MODEL))
    assert model.dependencies == ()
    assert model.requires_python is None
    assert model.missing() == []


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("# /// script\n# dependencies = [\n# ///\n", "script header is not valid TOML"),
        ('# /// script\n# dependencies = "numpy"\n# ///\n', "must be a list of texts"),
        ("# /// script\n# dependencies = [3]\n# ///\n", "must be a list of texts"),
        ("# /// script\n# requires-python = 3.11\n# ///\n", "requires-python .* must be a text"),
        (HEADER + "\n" + HEADER, "has 2 script headers; PEP 723 allows one"),
    ],
)
def test_a_header_that_cannot_be_read_is_refused(write, text: str, match: str) -> None:
    with pytest.raises(WorkerError, match=match):
        find_model(write(text))


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_bytes(b"\xff\xfe\x00bad")
    with pytest.raises(WorkerError, match="cannot be read"):
        find_model(str(path))


def test_a_folder_is_a_model_when_it_holds_a_model_file(write, tmp_path: Path) -> None:
    write(MODEL, "big/model.py")
    model = find_model(str(tmp_path / "big"))
    assert model.name == "big"
    assert make_policy(model).spec.name == "still"
    (tmp_path / "empty").mkdir()
    with pytest.raises(ResourceError, match=r"a folder without a model\.py"):
        find_model(str(tmp_path / "empty"))


def test_a_worker_of_the_profile_has_its_own_name_and_the_model_keeps_its_own(write) -> None:
    path = write(MODEL, "big/model.py")
    name, model = find_worker("lift", {"lift": path})
    # Files beside a model.py are imported by the folder's name, whatever the worker is called.
    assert (name, model.name, str(model.path)) == ("lift", "big", path)
    name, model = find_worker("still", {"still": "scripted"})
    assert (name, model.name) == ("still", "scripted")


def test_what_is_no_worker_of_the_profile_is_the_name_or_path_of_a_model(write) -> None:
    path = write(MODEL)
    assert find_worker(path, {"lift": "scripted"})[0] == "mine"
    assert find_worker("scripted", {})[0] == "scripted"
    with pytest.raises(ResourceError, match=r"by a profile's models: \{lft: PATH\}"):
        find_worker("lft", {"lift": path})


def test_an_unknown_name_lists_what_there_is() -> None:
    with pytest.raises(ResourceError, match="did you mean 'scripted'"):
        find_model("scriptd")


def test_options_reach_the_constructor_as_text(write) -> None:
    policy = make_policy(find_model(write(MODEL)), {"size": "2.5"})
    assert policy.size == 2.5  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"colour": "red"}, r"mine\.py: Still has no option 'colour'\. Its options: size$"),
        ({"size": "big"}, "could not convert"),
    ],
)
def test_bad_options_are_refused_with_those_there_are(
    write, options: dict[str, str], match: str
) -> None:
    with pytest.raises(WorkerError, match=match):
        make_policy(find_model(write(MODEL)), options)


TWO = MODEL + MODEL.replace("Still", "Other").replace('"still"', '"other"')


def test_two_classes_need_a_name(write) -> None:
    with pytest.raises(WorkerError, match=r"found: Still, Other; .* MODEL = ClassName"):
        make_policy(find_model(write(TWO)))
    assert make_policy(find_model(write(TWO + "MODEL = Other\n"))).spec.name == "other"


def test_options_that_are_passed_on_have_no_name_to_tell(write) -> None:
    text = MODEL.replace('size: str = "1"', 'size: str = "1", **layout: str').replace(
        "self.size = float(size)", "raise ValueError(layout)"
    )
    with pytest.raises(WorkerError, match=r"\(its options: size\)"):
        make_policy(find_model(write(text)), {"colour": "red"})


def test_an_imported_class_is_not_taken_for_the_files_own(write) -> None:
    text = "from vla_zenoh.policy import Policy\n" + MODEL
    assert make_policy(find_model(write(text))).spec.name == "still"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("x = 1\n", "wanted one class with a method infer, found: none"),
        ("class Arm:\n    def move(self, command): ...\n", "a robot's: `vla-zenoh profile check`"),
        ("def broken(:\n", "cannot be imported: SyntaxError"),
        (
            "import no_such_module_at_all\n",
            "cannot be imported: ModuleNotFoundError.*; name what brings it in the header",
        ),
        ("import sys\nsys.exit(3)\n", "cannot be imported: SystemExit: 3"),
        ("1 / 0\n", "cannot be imported: ZeroDivisionError"),
        ("class A:\n    def infer(self, o): ...\n", "needs a property `spec`"),
        ("class A:\n    spec = 3\n    def infer(self, o): ...\n", "needs a property `spec`"),
        (
            "class A:\n    def infer(self, o): ...\n    spec = property(lambda self: 1 / 0)\n",
            "the spec of A cannot be read: ZeroDivisionError",
        ),
        (MODEL + "MODEL = 3\n", "MODEL must be a class, it is a int"),
        (MODEL + "MODEL = dict\n", "dict needs a property `spec`"),
        (MODEL.replace("horizon=1", "horizon=0"), "Still cannot be made: .*horizon"),
    ],
)
def test_a_broken_model_file_is_named_with_its_fault(write, text: str, match: str) -> None:
    with pytest.raises(WorkerError, match=f"(?s){match}"):
        make_policy(find_model(write(text)))


def test_a_file_that_is_not_python_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("a: 1\n")
    with pytest.raises(WorkerError, match="is not a Python file"):
        make_policy(find_model(str(tmp_path / "mine.yaml")))


def test_a_model_may_hold_dataclasses(write) -> None:
    # They look their module up by name while they are made.
    text = (
        "from __future__ import annotations\nfrom dataclasses import dataclass\n\n"
        "@dataclass(slots=True)\nclass Note:\n    text: str = ''\n\n" + MODEL
    )
    assert make_policy(find_model(write(text))).spec.name == "still"


def test_a_folder_may_have_files_beside_its_model(tmp_path: Path) -> None:
    folder = tmp_path / "with-parts"
    folder.mkdir()
    (folder / "part.py").write_text("ANSWER = 41\n")
    (folder / "model.py").write_text(
        "class Model:\n"
        "    def infer(self, observation):\n"
        "        from vla_zenoh_model_with_parts.part import ANSWER\n"
        "        return ANSWER + 1\n"
    )
    module = import_model(find_model(str(folder)))
    assert module.Model().infer(None) == 42


def test_a_model_that_takes_a_profile_is_given_the_workers(write) -> None:
    text = MODEL.replace('size: str = "1"', 'profile="none", size: str = "1"')
    text = text.replace("self.size =", "self.profile = profile\n        self.size =")
    model = find_model(write(text))
    assert make_policy(model).profile == "none"  # pyright: ignore
    assert make_policy(model, profile="lab.yaml").profile == "lab.yaml"  # pyright: ignore
    chosen = make_policy(model, {"profile": "mine"}, profile="lab.yaml")
    assert chosen.profile == "mine"  # pyright: ignore


def test_a_model_that_takes_no_profile_is_not_given_one(write) -> None:
    assert make_policy(find_model(write(MODEL)), profile="lab.yaml").spec.name == "still"
