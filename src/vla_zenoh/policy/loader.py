"""Loads models and robot drivers from Python files with a PEP 723 header."""

from __future__ import annotations

import ast
import importlib.metadata
import importlib.util
import inspect
import operator
import re
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from vla_zenoh import resources
from vla_zenoh.errors import ResourceError, WorkerError, in_words, nearest
from vla_zenoh.policy import ModelSpec, Policy
from vla_zenoh.robot import Robot

# The pattern of PEP 723: the block ends at the last line that can end it.
_HEADER = re.compile(r"(?m)^# /// script$\s(?P<body>(?:^#(?:| .*)$\s)+)^# ///$")
ENTRY_FILE = "model.py"


@dataclass(frozen=True, slots=True)
class ModelFile:
    """A model on disk.

    Args:
        name: part of its keys.
        path: the file to run.
        dependencies: of its PEP 723 header.
        requires_python: of its PEP 723 header, or None.
    """

    name: str
    path: Path
    dependencies: tuple[str, ...] = ()
    requires_python: str | None = None

    def missing(self) -> list[str]:
        """Requirements that this environment lacks (packages by name; uv checks versions)."""
        absent: list[str] = []
        if self.requires_python is not None and not _this_python_is(self.requires_python):
            absent.append(f"Python {self.requires_python}")
        for requirement in self.dependencies:
            name = re.split(r"[\s<>=!~;\[@(]", requirement, maxsplit=1)[0]
            try:
                importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                absent.append(requirement)
        return absent


_CLAUSE = re.compile(r"(>=|<=|==|!=|~=|>|<)\s*(\d+(?:\.\d+)*)(\.\*)?")


def _this_python_is(wanted: str) -> bool:
    """Whether this interpreter has a version that ``requires-python`` allows."""
    compare = {">=": operator.ge, "<=": operator.le, ">": operator.gt, "<": operator.lt}
    for clause in wanted.split(","):
        found = _CLAUSE.fullmatch(clause.strip())
        if found is None:
            continue  # uv reads it where it makes an environment
        sign, version = found[1], tuple(map(int, found[2].split(".")))
        here = tuple(sys.version_info[: len(version)])
        if sign == "~=":
            fits = here >= version and here[:-1] == version[:-1]
        elif sign in ("==", "!="):
            fits = (here == version) is (sign == "==")
        else:
            fits = compare[sign](here, version)
        if not fits:
            return False
    return True


def find_model(name: str, kind: str = "models") -> ModelFile:
    """The model `name`, which may be a path to a file or a folder with a model.py.

    Args:
        name: its name or path.
        kind: of the file, see `vla_zenoh.resources`; a benchmark is found by the same rules.

    Raises:
        ResourceError: not found.
        WorkerError: invalid header.
    """
    path = resources.find(kind, name)
    if path.is_dir():
        path = path / ENTRY_FILE
        if not path.is_file():
            raise ResourceError(f"{path.parent} is a folder without a {ENTRY_FILE}")
    stem = path.parent.name if path.name == ENTRY_FILE else path.stem
    header = _read_header(path)
    dependencies = header.get("dependencies", [])
    requires = header.get("requires-python")
    if requires is not None and not isinstance(requires, str):
        raise WorkerError(f"{path}: requires-python in the script header must be a text")
    if not isinstance(dependencies, list) or not all(isinstance(d, str) for d in dependencies):
        raise WorkerError(f"{path}: dependencies in the script header must be a list of texts")
    return ModelFile(stem, path, tuple(dependencies), requires)


def find_worker(word: str, models: Mapping[str, str]) -> tuple[str, ModelFile]:
    """Name of a worker, and its model.

    Args:
        word: a worker in `models`, or the name or path of a model.
        models: of the profile: worker -> path or name of its model.

    Raises:
        ResourceError: no such model.
        WorkerError: invalid header.
    """
    if word in models:
        return word, find_model(models[word])
    found = find_model(word)
    return found.name, found


def _read_header(path: Path) -> Mapping[str, Any]:
    try:
        blocks = [found["body"] for found in _HEADER.finditer(path.read_text("utf-8-sig"))]
    except (OSError, UnicodeDecodeError) as error:
        raise WorkerError(f"{path} cannot be read: {error}") from error
    if not blocks:
        return {}
    if len(blocks) > 1:
        raise WorkerError(f"{path} has {len(blocks)} script headers; PEP 723 allows one")
    body = "".join(
        line[2:] if line.startswith("# ") else line[1:]
        for line in blocks[0].splitlines(keepends=True)
    )
    try:
        return tomllib.loads(body)
    except tomllib.TOMLDecodeError as error:
        raise WorkerError(f"{path}: its script header is not valid TOML: {error}") from error


def module_name(name: str) -> str:
    """Module name under which the model `name` is imported."""
    return "vla_zenoh_model_" + re.sub(r"\W", "_", name)


def import_model(model: ModelFile) -> ModuleType:
    """Import the file of a model.

    A model that is a folder is imported as a package, so that its `model.py` can have files beside
    it: models/NAME/part.py is ``vla_zenoh_model_NAME.part``.

    Raises:
        WorkerError: it does not import.
    """
    name = module_name(model.name)
    beside = [str(model.path.parent)] if model.path.name == ENTRY_FILE else None
    found = importlib.util.spec_from_file_location(
        name, model.path, submodule_search_locations=beside
    )
    if found is None or found.loader is None:
        raise WorkerError(f"{model.path} is not a Python file")
    module = importlib.util.module_from_spec(found)
    sys.modules[name] = module
    try:
        found.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        hint = (
            "; name what brings it in the header of a model's file (PEP 723), or install it here"
            if isinstance(error, ModuleNotFoundError)
            else ""
        )
        raise WorkerError(f"{model.path} cannot be imported: {in_words(error)}{hint}") from error
    return module


def make_policy(
    model: ModelFile, options: Mapping[str, str] | None = None, *, profile: str | None = None
) -> Policy:
    """Construct the model of a file, without loading weights.

    The model is the only class in the file with ``infer``; of several, the name ``MODEL`` chooses.
    `options` are keyword arguments of its constructor, as text; a parameter `profile` defaults to
    the name or path of the robot's.

    Raises:
        WorkerError: the file fails to import, has no such class, or rejects the options.
    """
    module = import_model(model)
    maker = _maker(module, model.path, "MODEL", "infer")
    name = getattr(maker, "__name__", "MODEL")
    chosen = dict(options or {})
    if profile is not None and "profile" in _options_of(maker).names:
        chosen.setdefault("profile", profile)
    policy = _made(maker, model.path, name, chosen)
    try:
        fits = isinstance(policy, Policy) and isinstance(policy.spec, ModelSpec)
    except Exception as error:  # a property that fails
        raise WorkerError(
            f"{model.path}: the spec of {name} cannot be read: {in_words(error)}"
        ) from error
    if not fits:
        raise WorkerError(
            f"{model.path}: {name} needs a property `spec` (a vla_zenoh.policy.ModelSpec) "
            "and a method `infer(observation)`"
        )
    return policy


def make_by_method(file: ModelFile, named: str, method: str, options: Mapping[str, str]) -> Any:
    """Construct the only class with `method` of a file, or the one that `named` names there.

    Raises:
        WorkerError: the file fails to import, has no such class, or rejects the options.
    """
    maker = _maker(import_model(file), file.path, named, method)
    return _made(maker, file.path, getattr(maker, "__name__", named), options)


def make_robot(path: Path, options: Mapping[str, str] | None = None) -> Robot:
    """Construct the robot of a file, without connecting to it.

    The robot is the only class in the file with ``move``; of several, the name ``ROBOT`` chooses.
    `options` are keyword arguments of its constructor, as text.

    Raises:
        WorkerError: the file fails to import, has no such class, or rejects the options.
    """
    maker, name = _robot_class(path)
    robot = _made(maker, path, name, dict(options or {}))
    if not isinstance(robot, Robot):
        raise WorkerError(f"{path}: {name} needs methods `read()` and `move(command)`")
    return robot


def _options_of(maker: Callable[..., Any]) -> ConstructorOptions:
    try:
        return ConstructorOptions.of(inspect.signature(maker).parameters.values())
    except (TypeError, ValueError):  # written in C, without a signature
        return ConstructorOptions((), (), anything=True)


@dataclass(frozen=True, slots=True)
class ConstructorOptions:
    """Options that a class takes: keyword arguments of its constructor.

    Args:
        names: all of them.
        required: those without a default.
        anything: it takes any other name too.
    """

    names: tuple[str, ...]
    required: tuple[str, ...]
    anything: bool = False

    @staticmethod
    def of(parameters: Iterable[inspect.Parameter]) -> ConstructorOptions:
        """The options among the parameters of a constructor."""
        variable = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
        found = list(parameters)
        named = [each for each in found if each.kind not in variable]
        return ConstructorOptions(
            tuple(each.name for each in named),
            tuple(each.name for each in named if each.default is each.empty),
            any(each.kind is each.VAR_KEYWORD for each in found),
        )

    @staticmethod
    def declared(path: Path) -> ConstructorOptions | None:
        """Options of the model class in a file that is not run; None: not written there."""
        try:
            body = ast.parse(path.read_bytes()).body
        except (OSError, SyntaxError, ValueError):
            return None  # `import_model` reports what is wrong
        classes = [each for each in body if isinstance(each, ast.ClassDef)]
        methods = [{f.name: f for f in c.body if isinstance(f, ast.FunctionDef)} for c in classes]
        found = [each for each in methods if "infer" in each]
        if len(found) != 1 or "__init__" not in found[0]:
            return None
        given = found[0]["__init__"].args
        plain = [each.arg for each in (*given.posonlyargs, *given.args)][1:]
        first_default = len(plain) - len(given.defaults)
        keywords = list(zip(given.kwonlyargs, given.kw_defaults, strict=True))
        return ConstructorOptions(
            (*plain, *(each.arg for each, _ in keywords)),
            (*plain[:first_default], *(each.arg for each, default in keywords if default is None)),
            given.kwarg is not None,
        )

    @property
    def listed(self) -> str:
        """Their names, as text."""
        return ", ".join(self.names) or "none"

    def check(self, given: Mapping[str, str], what: str) -> None:
        """Compare with the options that are given.

        Raises:
            WorkerError: one is unknown, or a required one is missing.
        """
        missing = [name for name in self.required if name not in given]
        for name in given:
            known = name in self.names or (self.anything and not nearest(name, missing, ""))
            if not known:
                raise WorkerError(
                    f"{what} has no option {name!r}{nearest(name, self.names)} "
                    f"Its options: {self.listed}"
                )
        if missing:
            raise WorkerError(
                f"{what} needs the option {missing[0]!r}: give {missing[0]}=VALUE, with --set or "
                f"in the profile's options. Its options: {self.listed}"
            )


def inspect_robot(path: Path, options: Mapping[str, str]) -> None:
    """Import the file of a robot and compare its options, without making the robot.

    Raises:
        WorkerError: as `make_robot`.
    """
    maker, name = _robot_class(path)
    _options_of(maker).check(options, f"{path}: {name}")
    if not all(callable(getattr(maker, method, None)) for method in ("read", "move")):
        raise WorkerError(f"{path}: {name} needs methods `read()` and `move(command)`")


def _robot_class(path: Path) -> tuple[Callable[..., Any], str]:
    if not path.is_file():
        raise WorkerError(f"{path} is not a file; arm.file of the profile names it")
    module = import_model(ModelFile(path.stem, path))
    maker = _maker(module, path, "ROBOT", "move")
    return maker, getattr(maker, "__name__", "ROBOT")


def _maker(module: ModuleType, path: Path, named: str, method: str) -> Callable[..., Any]:
    maker = getattr(module, named, None) or _only_class(module, path, named, method)
    if not callable(maker):
        raise WorkerError(f"{path}: {named} must be a class, it is a {type(maker).__name__}")
    return maker


def _made(maker: Callable[..., Any], path: Path, name: str, options: Mapping[str, str]) -> Any:
    taken = _options_of(maker)
    taken.check(options, f"{path}: {name}")
    try:
        return maker(**options)
    except (Exception, SystemExit) as error:
        raise WorkerError(
            f"{path}: {name} cannot be made: {in_words(error)} (its options: {taken.listed})"
        ) from error


def _only_class(module: ModuleType, path: Path, named: str, method: str) -> type:
    candidates = [
        value
        for value in vars(module).values()
        if inspect.isclass(value)
        and value.__module__ == module.__name__
        and callable(getattr(value, method, None))
    ]
    if len(candidates) != 1:
        found = ", ".join(c.__name__ for c in candidates) or "none"
        raise WorkerError(
            f"{path}: wanted one class with a method {method}, found: {found}; "
            f"name the right one with {named} = ClassName"
        )
    return candidates[0]
