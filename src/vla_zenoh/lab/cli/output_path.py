"""Output files and folders of commands: tried before the work begins, never overwritten unasked.

They are written under a temporary name beside their own, such as ``run.part.mcap``, and renamed at
the end. After an error or Ctrl-C the partial result keeps its temporary name, which is printed.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import typer

from vla_zenoh.cli.output import errors
from vla_zenoh.errors import OutputError, VlaZenohError

ForceOption = Annotated[
    bool,
    typer.Option(
        "--force", help="Overwrite the file that --output names, or move that folder aside."
    ),
]
RUNS = Path("runs")
"""Where results go by default; the only folder that is made for them."""
TRIED_BYTES = 64 * 1024
"""Written and removed again, to find a full disk before the work begins."""
_DISK = frozenset(
    getattr(errno, name)
    for name in ("EACCES", "EDQUOT", "EFBIG", "EIO", "ENOSPC", "EPERM", "EROFS")
)


@contextmanager
def output_file(path: Path, *, force: bool = False, inputs: Iterable[Path] = ()) -> Iterator[Path]:
    """A temporary file to write; becomes `path` when the block ends without an exception.

    Args:
        inputs: files that the command reads, which are never overwritten.

    Raises:
        OutputError: it exists, is an input, or cannot be written.
    """
    with _sentence(path):
        if any(path.resolve() == each.resolve() for each in inputs):
            raise OutputError(f"{path} is an input of this command; give another --output")
        if path.exists():
            if not path.is_file():
                raise OutputError(f"{path} is not a regular file; give another --output")
            _require_force(path, force)
        _require_parent(path)
        place = path.resolve()  # a symbolic link stays one
        part = _new(_make_file, place.with_name(f"{place.stem}.part"), place.suffix)
    with _sentence(path, part), _kept(part):
        _try_room(part)
        yield part
        if path.exists():
            if not force:
                raise OutputError(f"{path} was made by another program meanwhile")
            shutil.copymode(path, part)
        with part.open("rb") as written:
            os.fsync(written.fileno())  # before it takes the place of an older one
        part.replace(place)


@contextmanager
def output_folder(
    path: Path, *, force: bool = False, inputs: Iterable[Path] = ()
) -> Iterator[Path]:
    """A temporary folder to fill; becomes `path` when the block ends without an exception.

    Args:
        path: of the folder; may exist if it is empty.
        force: an existing folder is renamed, to a name that is printed.
        inputs: files that the command reads, which must not lie in it.

    Raises:
        OutputError: it exists, has an input in it, or cannot be written.
    """
    with _sentence(path):
        require_free_folder(path, force=force, inputs=inputs)
        place = path.resolve()
        part = _new(Path.mkdir, place.with_name(f"{place.name}.part"))
    with _sentence(path, part), _kept(part):
        _try_folder(part)
        yield part
        if path.exists() and any(path.iterdir()):
            if not force:
                raise OutputError(f"{path} was filled by another program meanwhile")
            older = place.rename(_new(Path.mkdir, place.with_name(f"{place.name}.old")))
            errors().print(f"the folder that was {path} is now {older}", soft_wrap=True)
        part.rename(place)


def if_wanted(
    output: Callable[..., AbstractContextManager[Path]], path: Path | None, **settings: Any
) -> AbstractContextManager[Path | None]:
    """`output_file` or `output_folder` at `path`; None where no output is wanted."""
    return nullcontext() if path is None else output(path, **settings)


def require_free_folder(path: Path, *, force: bool = False, inputs: Iterable[Path] = ()) -> None:
    """Check that `output_folder` may make `path`. Raises OutputError: it may not."""
    with _sentence(path):
        place = path.resolve()
        if Path.cwd().is_relative_to(place):
            raise OutputError(f"{path} is the current folder; give --output a new one")
        if any(each.resolve().is_relative_to(place) for each in inputs):
            raise OutputError(f"{path} holds an input of this command; give another --output")
        if path.exists():
            if not path.is_dir():
                raise OutputError(f"{path} is not a folder; give another --output")
            if any(path.iterdir()):
                _require_force(path, force)
        _require_parent(path)


def check_folder(path: Path, *, begun: bool) -> None:
    """Make a folder that a command fills over several calls, and try to write there.

    Args:
        begun: it has the command's own files; otherwise it must be new or empty.

    Raises:
        OutputError: it has other files, or cannot be written.
    """
    with _sentence(path):
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path} is not a folder; give another --output")
        if path.exists() and not begun and any(path.iterdir()):
            raise OutputError(f"{path} exists and holds something else; give another --output")
        _require_parent(path)
        path.mkdir(exist_ok=True)
        _try_folder(path)


def _require_force(path: Path, force: bool) -> None:
    if not force:
        raise OutputError(f"{path} exists; give another --output, or --force to replace it")


def _require_parent(path: Path) -> None:
    if path.parent == RUNS:
        RUNS.mkdir(exist_ok=True)
    if not path.parent.exists():
        raise OutputError(f"{path} cannot be written: there is no folder {path.parent}")


def _new(make: Callable[[Path], None], path: Path, end: str = "") -> Path:
    """Make a file or folder under the first name that is free: `path`, a number, `end`."""
    for number in count(1):
        new = path.with_name(f"{path.name}{number if number > 1 else ''}{end}")
        try:
            make(new)
        except FileExistsError:
            continue
        return new
    raise AssertionError


def _make_file(path: Path) -> None:
    path.touch(exist_ok=False)


def _try_room(file: Path) -> None:
    try:
        file.write_bytes(bytes(TRIED_BYTES))
    finally:
        os.truncate(file, 0)


def _try_folder(folder: Path) -> None:
    room = _new(_make_file, folder / ".room")
    try:
        _try_room(room)
    finally:
        room.unlink()


@contextmanager
def _kept(part: Path) -> Iterator[None]:
    """After an exception, print where the partial result is; removes it if it is empty."""
    try:
        yield
    except BaseException:
        if part.is_file() and not part.stat().st_size:
            part.unlink()
        elif part.is_dir() and not any(each.is_file() for each in part.rglob("*")):
            shutil.rmtree(part)
        elif part.exists():
            errors().print(f"unfinished; what was written until then: {part}", soft_wrap=True)
        raise


@contextmanager
def _sentence(path: Path, part: Path | None = None) -> Iterator[None]:
    """Turn an `OSError` of the disk into a sentence."""
    try:
        yield
    except OSError as error:
        own = tuple(map(str, (part, path.resolve())))
        mine = part is None or str(error.filename).startswith(own)
        if isinstance(error, VlaZenohError) or not (mine or error.errno in _DISK):
            raise
        raise OutputError(f"{path} cannot be written: {error.strerror or error}") from error
