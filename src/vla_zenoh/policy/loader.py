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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from vla_zenoh import resources
from vla_zenoh.errors import ResourceError, WorkerError, in_words, nearest
from vla_zenoh.policy import ModelSpec, Policy
from vla_zenoh.robot import Robot

# The pattern of PEP 723: the block ends at the last line that can end it.
_HEADER = re.compile(r"(?m)^# /// script$\s(?P<body>(?:^#(?:| .*)$\s)+)^# ///$")
_CLAUSE = re.compile(r"(>=|<=|==|!=|~=|>|<)\s*(\d+(?:\.\d+)*)(\.\*)?")
_COMPARE: Mapping[str, Callable[[Any, Any], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
    "==": operator.eq,
    "!=": operator.ne,
    "~=": lambda here, version: here >= version and here[:-1] == version[:-1],
}
ENTRY_FILE = "model.py"
ENVIRONMENT_FILE = "environment.py"


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

    def for_options(self, options: Mapping[str, str]) -> ModelFile:
        """With the packages that a file ``environment.py`` beside its ``model.py`` adds.

        Its function ``dependencies(options)`` returns requirements; it runs before the environment
        of the model is made, so it needs nothing but this package.

        Raises:
            WorkerError: the file cannot be imported, or fails.
        """
        beside = self.path.with_name(ENVIRONMENT_FILE)
        if self.path.name != ENTRY_FILE or not beside.is_file():
            return self
        module = import_model(ModelFile(f"{self.name}_environment", beside))
        try:
            more = tuple(module.dependencies(dict(options)))
        except Exception as error:
            raise WorkerError(f"{beside}: dependencies failed: {in_words(error)}") from error
        return replace(self, dependencies=(*self.dependencies, *more))

    def check_options(self, given: Mapping[str, str]) -> None:
        """Compare options with those of its class as far as the file shows them, not running it.

        Raises:
            WorkerError: one is unknown, or a required one is missing.
        """
        declared = _declared_options(self.path)
        if declared is not None:
            declared.check(given, str(self.path))


def _this_python_is(wanted: str) -> bool:
    """Whether this interpreter has a version that ``requires-python`` allows."""
    for clause in wanted.split(","):
        found = _CLAUSE.fullmatch(clause.strip())
        if found is None:
            continue  # uv reads it where it makes an environment
        version = tuple(map(int, found[2].split(".")))
        if not _COMPARE[found[1]](sys.version_info[: len(version)], version):
            return False
    return True


def find_model(name: str, kind: str = "models") -> ModelFile:
    """The model `name`, which may be a path to a file or a folder with a model.py.

    A benchmark is found by the same rules; for `kind` see `vla_zenoh.resources`.

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
    if not resources.is_path(name):
        stem = name
    header = _read_header(path)
    dependencies = header.get("dependencies", [])
    requires = header.get("requires-python")
    if requires is not None and not isinstance(requires, str):
        raise WorkerError(f"{path}: requires-python in the script header must be a text")
    if not isinstance(dependencies, list) or not all(isinstance(d, str) for d in dependencies):
        raise WorkerError(f"{path}: dependencies in the script header must be a list of texts")
    return ModelFile(stem, path, tuple(dependencies), requires)


def find_worker(word: str, models: Mapping[str, str]) -> tuple[str, ModelFile]:
    """Name of a worker, and its model: one of the profile's `models`, or any by name or path.

    Raises:
        ResourceError: no such model.
        WorkerError: invalid header.
    """
    found = find_model(models.get(word, word))
    return (word if word in models else found.name), found


def _read_header(path: Path) -> Mapping[str, Any]:
    try:
        blocks = _HEADER.findall(path.read_text("utf-8-sig"))
    except (OSError, UnicodeDecodeError) as error:
        raise WorkerError(f"{path} cannot be read: {in_words(error)}") from error
    if not blocks:
        return {}
    if len(blocks) > 1:
        raise WorkerError(f"{path} has {len(blocks)} script headers; PEP 723 allows one")
    try:
        return tomllib.loads(re.sub("(?m)^# ?", "", blocks[0]))
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
        hint = _of_missing(error, model.path) if isinstance(error, ModuleNotFoundError) else ""
        raise WorkerError(f"{model.path} cannot be imported: {in_words(error)}{hint}") from error
    return module


def _of_missing(error: ModuleNotFoundError, path: Path) -> str:
    """What to do about a module that the file at `path` does not find."""
    module = (error.name or "").partition(".")[0]
    beside = path.parent / module
    if module and (beside.is_dir() or beside.with_suffix(".py").is_file()):
        return (
            f"; it lies beside the file, where Python does not look: set PYTHONPATH={path.parent}, "
            "or put both into a package and install that"
        )
    return "; name what brings it in the header of the file (PEP 723), or install it here"


# -- making what a file holds ---------------------------------------------------------------------
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
    maker = find_maker(model, "MODEL", "infer")
    chosen = dict(options or {})
    if profile is not None and "profile" in maker.options.names:
        chosen.setdefault("profile", profile)
    policy = maker.make(chosen)
    try:
        fits = isinstance(policy, Policy) and isinstance(policy.spec, ModelSpec)
    except Exception as error:  # a property that fails
        raise WorkerError(
            f"{model.path}: the spec of {maker.name} cannot be read: {in_words(error)}"
        ) from error
    if not fits:
        raise WorkerError(
            f"{maker.where} needs a property `spec` (a vla_zenoh.policy.ModelSpec) "
            "and a method `infer(observation)`"
        )
    return policy


def make_robot(path: Path, options: Mapping[str, str] | None = None) -> Robot:
    """Construct the robot of a file, without connecting to it; see `find_robot_maker`.

    `options` are keyword arguments of its constructor, as text.

    Raises:
        WorkerError: as `make_policy`.
    """
    maker = find_robot_maker(path)
    robot = maker.make(options or {})
    if not isinstance(robot, Robot) or not is_robot(robot):
        raise WorkerError(f"{maker.where} {IS_ROBOT}")
    return robot


def find_robot_maker(path: Path) -> Maker:
    """The only class in a file with ``move``; of several, the name ``ROBOT`` chooses.

    Raises:
        WorkerError: there is no such file, or as `find_maker`.
    """
    if not path.is_file():
        raise WorkerError(f"{path} is not a file: give a Python file with a class of a robot")
    return find_maker(ModelFile(path.stem, path), "ROBOT", "move")


IS_ROBOT = "needs methods `read()` and `move(command)`"


def is_robot(owner: Any) -> bool:
    """Whether a robot, or a class of robots, has methods that can be called like that."""
    for name, given in (("read", 0), ("move", 1)):
        method = getattr(owner, name, None)
        if not callable(method):
            return False
        if inspect.isclass(owner) and inspect.isfunction(inspect.getattr_static(owner, name)):
            given += 1  # self
        try:
            inspect.signature(method).bind(*[None] * given)
        except TypeError:
            return False
        except ValueError:  # written in C, without a signature
            continue
    return True


class Maker(NamedTuple):
    """A class or function of a file, with the options it takes."""

    path: Path
    name: str
    function: Callable[..., Any]
    options: _Options

    @property
    def where(self) -> str:
        return f"{self.path}: {self.name}"

    def make(self, options: Mapping[str, str]) -> Any:
        """Call it with `options`, or a `WorkerError`: it rejects them, or fails."""
        self.options.check(options, self.where)
        try:
            return self.function(**options)
        except (Exception, SystemExit) as error:
            raise WorkerError(
                f"{self.where} cannot be made: {in_words(error)} (its options: "
                f"{self.options.listed})"
            ) from error


def find_maker(file: ModelFile, named: str, method: str) -> Maker:
    """The only class with `method` of a file, or what `named` names there.

    Raises:
        WorkerError: the file fails to import, or has no such class.
    """
    module = import_model(file)
    function = getattr(module, named, None)
    if not function:
        classes = [each for each in vars(module).values() if inspect.isclass(each)]
        classes = [each for each in classes if each.__module__ == module.__name__]
        own = [each for each in classes if callable(getattr(each, method, None))]
        if len(own) != 1:
            found = ", ".join(each.__name__ for each in own) or "none"
            hint = f"name the right one with {named} = ClassName"
            if method == "infer" and any(callable(getattr(each, "move", None)) for each in classes):
                hint = "a class with move is a robot's: `vla-zenoh profile check` its profile"
            raise WorkerError(
                f"{file.path}: wanted one class with a method {method}, found: {found}; {hint}"
            )
        function = own[0]
    if not callable(function):
        raise WorkerError(
            f"{file.path}: {named} must be a class, it is a {type(function).__name__}"
        )
    return Maker(file.path, getattr(function, "__name__", named), function, _options_of(function))


# -- options --------------------------------------------------------------------------------------
class _Options(NamedTuple):
    """Keyword arguments of a constructor: all of them, those without a default, and whether it
    takes any other name too."""

    names: tuple[str, ...]
    required: tuple[str, ...]
    anything: bool

    @property
    def listed(self) -> str:
        return ", ".join(self.names) or "none"

    def check(self, given: Mapping[str, str], what: str) -> None:
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
                f"in the profile's options (of an arm: arm.options). Its options: {self.listed}"
            )


def _options_of(maker: Callable[..., Any]) -> _Options:
    try:
        parameters = inspect.signature(maker).parameters.values()
    except (TypeError, ValueError):  # written in C, without a signature
        return _Options((), (), anything=True)
    named = [
        each for each in parameters if each.kind not in (each.VAR_KEYWORD, each.VAR_POSITIONAL)
    ]
    return _Options(
        tuple(each.name for each in named),
        tuple(each.name for each in named if each.default is each.empty),
        any(each.kind is each.VAR_KEYWORD for each in parameters),
    )


def _declared_options(path: Path) -> _Options | None:
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
    return _Options(
        (*plain, *(each.arg for each, _ in keywords)),
        (*plain[:first_default], *(each.arg for each, default in keywords if default is None)),
        given.kwarg is not None,
    )
