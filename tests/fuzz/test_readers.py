"""Whatever bytes come: a reader reads them or raises an error of ours, soon, and in little memory.

The same readers are fuzzed for longer, and guided by what they execute, by ``make fuzz``.
"""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from targets import CORPUS, TARGETS, Target

PATIENCE_S = 10.0
"""For one input. A reader that follows a bomb would be at it for minutes."""
MEMORY_LIMIT_BYTES = 3 * 1024**3
"""Of address space, most of it libraries."""
SLOW = frozenset({"recording", "replay", "profile"})
"""They read a file each time."""
EXAMPLES, SLOW_EXAMPLES = 15, 4
SUPPRESSED = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
INTERESTING = (
    b"\xff" * 4,
    b"\x00" * 4,
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\xdd",
    b"[",
    b"{",
)

LARGE = 40 * 1024 * 1024


def bombs() -> dict[str, bytes]:
    return {
        "lists in lists": b"\x91" * LARGE,
        "empty lists": b"\xdc\x27\x10"
        + (b"\xdc\x27\x10" + b"\x90" * 10_000) * (LARGE // 10_003 - 1),
        "empty maps": b"\xdc\x27\x10"
        + (b"\xdc\x27\x10" + b"\x80" * 10_000) * (LARGE // 10_003 - 1),
        "lists that claim to be long": b"\xdd\x00\x00\x27\x10" * (LARGE // 5),
        "zeros": bytes(LARGE),
        "brackets": b"[" * (LARGE),
        "pairs of brackets": b"[" + b"[]," * (LARGE // 4) + b"[]]",
        "a long number": b"9" * (LARGE),
        "a huge JPEG": b"\xff\xd8\xff\xc0\x00\x11\x08\xff\xff\xff\xff\x03"
        + bytes(40)
        + b"\xff\xd9",
        "aliases of aliases": b"a: &a [x,x,x,x,x,x,x,x]\n"
        + b"".join(
            b"%c: &%c [%s]\n" % (n, n, b",".join([b"*%c" % (n - 1)] * 8)) for n in range(98, 122)
        ),
        "anchors": b"&a " * 30_000,
    }


def mutated(target: Target) -> st.SearchStrategy[bytes]:
    """A good input with a few bytes changed, put in, taken out, or cut off; or no good at all."""
    corpus = target.corpus()

    @st.composite
    def change(draw: st.DrawFn) -> bytes:
        data = bytearray(draw(st.sampled_from(corpus)))
        for _ in range(draw(st.integers(1, 6))):
            at = draw(st.integers(0, len(data)))
            size = draw(st.integers(0, 8))
            new = draw(st.binary(max_size=4) | st.sampled_from(INTERESTING))
            data[at : at + size] = new
        return bytes(data[: draw(st.integers(0, len(data)))] if draw(st.booleans()) else data)

    return change() | st.binary(max_size=200)


@pytest.mark.parametrize("name", TARGETS)
def test_every_reader_reads_its_seeds(name: str) -> None:
    target = TARGETS[name]
    seeds = target.seeds()
    assert seeds, "a fuzzer without a good input to begin with tries little"
    for seed in seeds:
        assert target.try_(seed)


@pytest.mark.parametrize("name", TARGETS)
def test_what_once_broke_a_reader_does_so_no_more(name: str) -> None:
    target = TARGETS[name]
    for data in target.corpus():
        began_s = time.monotonic()
        target.try_(data)
        assert time.monotonic() - began_s < PATIENCE_S


@pytest.mark.parametrize("name", TARGETS)
def test_whatever_bytes_come_a_reader_reads_or_refuses_them(name: str) -> None:
    target = TARGETS[name]
    default = settings.get_profile(settings._current_profile or "default")
    share = default.max_examples / 100
    count = max(1, round(share * (SLOW_EXAMPLES if name in SLOW else EXAMPLES)))

    @settings(default, max_examples=count, suppress_health_check=SUPPRESSED, database=None)
    @given(mutated(target))
    def check(data: bytes) -> None:
        began_s = time.monotonic()
        target.try_(data)
        assert time.monotonic() - began_s < PATIENCE_S

    check()


def test_every_folder_of_the_corpus_has_its_reader() -> None:
    assert {folder.name for folder in CORPUS.iterdir()} <= set(TARGETS)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_bombs_cost_neither_time_nor_memory() -> None:
    script = f"""
        import resource, sys, time
        resource.setrlimit(resource.RLIMIT_AS, ({MEMORY_LIMIT_BYTES}, {MEMORY_LIMIT_BYTES}))
        sys.path[:0] = {[str(folder) for folder in Path(__file__).parents[:2]]!r}
        from targets import TARGETS
        from test_readers import PATIENCE_S, bombs
        for bomb, data in bombs().items():
            for target in TARGETS.values():
                began_s = time.monotonic()
                try:
                    target.try_(data)
                except MemoryError:
                    print(f"{{target.name}} runs out of memory at: {{bomb}}")
                took_s = time.monotonic() - began_s
                if took_s > PATIENCE_S:
                    print(f"{{target.name}} takes {{took_s:.0f}} s for: {{bomb}}")
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)],
        capture_output=True,
        text=True,
        timeout=550,
        check=False,
    )
    assert done.stdout == ""
    assert done.returncode == 0, done.stderr
