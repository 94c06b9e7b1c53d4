"""What is kept under names of others, whatever they are."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.bus.bounded import Bounded

SIZE = 4


@given(st.lists(st.integers(0, 20)))
def test_the_entries_set_last_of_the_highest_rank_stay(keys: list[int]) -> None:
    kept: Bounded[int, int] = Bounded(SIZE, rank=lambda key: key % 3)
    for turn, key in enumerate(keys):
        before, dropped = dict(kept), kept.dropped
        kept[key] = turn
        gone = (before | {key: turn}).keys() - kept.keys()
        assert kept.dropped == dropped + len(gone)
        assert len(kept) == min(len(before | {key: turn}), SIZE)
        for lost in gone:
            assert all(lost % 3 <= other % 3 for other in kept)
            older = [other for other in kept if other % 3 == lost % 3]
            assert all(before[lost] < kept[other] for other in older)


def test_what_made_room_is_counted() -> None:
    kept: Bounded[str, int] = Bounded(2)
    for name in ("a", "b", "a", "c", "d"):
        kept[name] = 0
    assert list(kept) == ["c", "d"]
    assert kept.dropped == 2
