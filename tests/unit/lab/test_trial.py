"""A trial as records and a state machine: order, how an episode goes, resuming, and the score."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vla_zenoh_benchmarks.statistics import Paired
from vla_zenoh_trial.episode_fsm import DONE_S, EpisodeFsm, Phase
from vla_zenoh_trial.folder import PLAN, TRIALS, TrialFolder
from vla_zenoh_trial.plan import HIDDEN, DueEpisode, TrialPlan
from vla_zenoh_trial.score import score
from vla_zenoh_trial.verdict import EpisodeVerdict, read_verdict

from vla_zenoh.errors import RecordError, RecordingError
from vla_zenoh.lab.episode import EpisodeView
from vla_zenoh.lab.recording.verdict import Verdict, verdict_in

SECONDS = 20.0
FIRST_SHARE = 0.1
"""Of 400 setups: a fair coin is further than this from one half once in 16,000 trials."""

PLAN_AB = TrialPlan("panda", ("a", "b"), "put the brick away", ("", "", ""), SECONDS, 7, True)
DUE = DueEpisode(1, 1, "a")


def judged(setup: int, worker: str, verdict: Verdict = "success", **more: Any) -> EpisodeVerdict:
    made = EpisodeVerdict(
        number=1,
        setup=setup,
        turn=1,
        worker=worker,
        verdict=verdict,
        note="",
        end="person",
        why="",
        time_s=10.0,
        chunks=50,
        brakes=0,
        began_ns=1,
        start_m=(0.4, 0.0, 0.3),
        recording="episode-0001.mcap",
        dropped=0,
    )
    return replace(made, **more)


# -- order ----------------------------------------------------------------------------------------
@given(
    st.lists(st.text("abcxyz", min_size=1), min_size=1, max_size=4, unique=True),
    st.integers(1, 8),
    st.integers(0, 2**32),
    st.lists(st.sampled_from(["success", "failure", "void"]), max_size=12),
)
def test_every_worker_does_every_setup_once_however_often_it_was_void(
    workers: list[str], setups: int, seed: int, verdicts: list[Verdict]
) -> None:
    plan = TrialPlan("r", tuple(workers), "p", ("",) * setups, 1.0, seed, True)
    done: list[EpisodeVerdict] = []
    at = iter(verdicts)
    while (due := plan.next_due(done)) is not None:
        assert due.worker == plan.order(due.setup)[due.turn - 1]
        assert not done or done[-1].setup <= due.setup, "a setup is laid once"
        done.append(judged(due.setup, due.worker, next(at, "success"), turn=due.turn))
    counted = Counter((each.setup, each.worker) for each in done if each.verdict != "void")
    assert counted == {(s, w): 1 for s in range(1, setups + 1) for w in workers}
    assert len(counted) == plan.episodes


def test_the_order_is_drawn_from_the_seed_for_each_setup() -> None:
    plan = TrialPlan("r", ("a", "b"), "p", ("",) * 400, 1.0, 3, True)
    orders = [plan.order(setup) for setup in range(1, 401)]
    assert orders == [plan.order(setup) for setup in range(1, 401)]
    assert abs(Counter(orders)[("a", "b")] / 400 - 0.5) < FIRST_SHARE
    other = replace(plan, seed=4)
    assert orders != [other.order(setup) for setup in range(1, 401)]


def test_names_of_workers_are_hidden_unless_the_trial_is_open() -> None:
    plan = replace(PLAN_AB, workers=("openvla", "openvla-oft"))
    said = "worker 'openvla-oft' is not alive; alive are: openvla; node worker-openvla is gone"
    hidden = plan.hide(said)
    assert "openvla" not in hidden
    assert hidden.count(HIDDEN) == 3
    assert plan.hide("activation goes on") == "activation goes on"
    assert replace(plan, blind=False).hide(said) == said


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"workers": ()}, "name one or more"),
        ({"workers": ("a", "")}, "name one or more"),
        ({"workers": ("a", "a")}, "names one of them twice"),
        ({"prompt": " "}, "prompt: empty"),
        ({"setups": ()}, "allowed: 1 to"),
        ({"seconds": 0.0}, "allowed: more than 0"),
        ({"seconds": float("nan")}, "allowed: more than 0"),
    ],
)
def test_a_plan_that_cannot_be_done_is_refused(change: dict[str, Any], why: str) -> None:
    with pytest.raises(RecordError, match=why):
        replace(PLAN_AB, **change)


# -- one episode ----------------------------------------------------------------------------------
def running() -> EpisodeFsm:
    episode = EpisodeFsm(DUE, SECONDS)
    assert episode.enter("")
    episode.started(100.0, 5, (0.4, 0.0, 0.3))
    return episode


def test_an_episode_from_setup_to_verdict() -> None:
    episode = EpisodeFsm(DUE, SECONDS)
    assert not episode.enter("y"), "nothing to be judged yet"
    assert episode.enter("")
    assert episode.phase is Phase.START
    episode.started(100.0, 5, (0.4, 0.0, 0.3))
    episode.update(EpisodeView(chunks=3), 100.5)
    episode.update(EpisodeView(chunks=90, holds=1, state="holding"), 109.0)
    assert episode.phase is Phase.RUN
    assert episode.enter("")
    assert episode.phase is Phase.BRAKE, "first the arm stands"
    episode.stopped(EpisodeView(False, chunks=91, holds=1))
    assert episode.phase is Phase.JUDGE
    assert not episode.enter("")
    assert not episode.enter("perhaps")
    assert episode.enter("Y pushed it in")
    assert episode.phase is Phase.OVER
    assert episode.verdict(4, "episode-0004.mcap", 2) == EpisodeVerdict(
        *(4, 1, 1, "a", "success", "pushed it in", "person", "", 9.0, 91, 1, 5),
        *((0.4, 0.0, 0.3), "episode-0004.mcap", 2),
    )


def test_a_refused_arm_is_repaired_or_the_episode_is_void() -> None:
    episode = EpisodeFsm(DUE, SECONDS)
    episode.enter("")
    episode.rejected("camera 'front' is silent")
    assert (episode.phase, episode.reasons) == (Phase.BLOCKED, "camera 'front' is silent")
    assert not episode.enter("y"), "it was not even tried"
    assert episode.enter("")
    assert episode.phase is Phase.START
    episode.rejected("camera 'front' is silent")
    assert episode.enter("x cable")
    found = episode.verdict(1, "", 0)
    assert (found.verdict, found.end, found.note) == ("void", "refused", "cable")
    assert (found.why, found.time_s, found.began_ns) == ("camera 'front' is silent", 0.0, 0)


def test_whatever_is_typed_while_the_arm_moves_makes_it_stand() -> None:
    for line, phase in (("", Phase.JUDGE), ("halt!", Phase.JUDGE), ("n fell", Phase.OVER)):
        episode = running()
        assert episode.enter(line)
        assert episode.phase is Phase.BRAKE
        episode.stopped(EpisodeView(False))
        assert episode.phase is phase


@pytest.mark.parametrize(
    ("look", "later", "end", "brakes"),
    [
        (
            EpisodeView(False, why="node gone"),
            EpisodeView(False, state="inactive", why="node gone"),
            "lost",
            1,
        ),
        (EpisodeView(False), EpisodeView(False, state="fault", why="the robot reports"), "lost", 1),
        (
            EpisodeView(False),
            EpisodeView(False, state="stopped", why="emergency stop"),
            "stopped",
            0,
        ),
        (EpisodeView(False), EpisodeView(False, deactivated=True, why="deactivated"), "taken", 0),
        (EpisodeView(ours=False), EpisodeView(False, why="worker is 'c'"), "taken", 0),
        (
            EpisodeView(recording="disk is full"),
            EpisodeView(False, recording="disk is full"),
            "recording",
            0,
        ),
    ],
)
def test_what_ended_it_is_told(
    look: EpisodeView, later: EpisodeView, end: str, brakes: int
) -> None:
    episode = running()
    episode.update(look, 101.0)
    assert episode.phase is Phase.BRAKE
    episode.stopped(later)
    episode.enter("n")
    found = episode.verdict(1, "", 0)
    assert (found.end, found.why, found.brakes) == (end, later.why or later.recording, brakes)


def test_it_ends_when_the_policy_says_so_for_a_while_and_when_the_time_is_over() -> None:
    episode = running()
    episode.update(EpisodeView(done=True), 101.0)
    episode.update(EpisodeView(done=False), 101.0 + DONE_S / 2)
    episode.update(EpisodeView(done=True), 101.0 + DONE_S)
    episode.update(EpisodeView(done=True), 101.0 + 1.9 * DONE_S)
    assert episode.phase is Phase.RUN, "it went on meanwhile"
    episode.update(EpisodeView(done=True), 101.0 + 2 * DONE_S)
    assert (episode.phase, episode.end) == (Phase.BRAKE, "policy")
    episode = running()
    episode.update(EpisodeView(), 100.0 + SECONDS - 0.01)
    assert episode.phase is Phase.RUN
    episode.update(EpisodeView(), 100.0 + SECONDS)
    assert (episode.phase, episode.end) == (Phase.BRAKE, "time")


LOOKS = st.builds(
    EpisodeView,
    active=st.booleans(),
    ours=st.booleans(),
    state=st.sampled_from(["active", "holding", "inactive", "stopped", "fault"]),
    done=st.booleans(),
    deactivated=st.booleans(),
    recording=st.sampled_from(["", "disk is full"]),
)


@given(st.lists(st.one_of(st.sampled_from(["", "y", "n", "x note", "what"]), LOOKS)), st.data())
def test_the_arm_is_braked_before_an_episode_that_moved_it_is_over(
    inputs: list[str | EpisodeView], data: st.DataObject
) -> None:
    episode, now_s, moved, braked = EpisodeFsm(DUE, SECONDS), 0.0, False, False
    for given_input in inputs:
        now_s += 1.0
        if episode.phase is Phase.START:
            if data.draw(st.booleans()):
                episode.rejected("no")
            else:
                episode.started(now_s, 1, None)
                moved = True
        elif episode.phase is Phase.BRAKE:
            episode.stopped(EpisodeView(False))
            braked = True
        elif isinstance(given_input, str):
            episode.enter(given_input)
        elif episode.phase is Phase.RUN:
            episode.update(given_input, now_s)
        if episode.phase is Phase.OVER:
            break
    assert episode.phase not in (Phase.JUDGE, Phase.OVER) or braked or not moved
    if episode.phase is not Phase.OVER:
        episode.abort()
        assert episode.verdict(1, "", 0).verdict == "void"
    assert (episode.verdict(1, "", 0).end == "refused") <= (not moved)


@pytest.mark.parametrize(
    ("line", "read"),
    [
        ("y", ("success", "")),
        (" YES  ", ("success", "")),
        ("n slid off the plate", ("failure", "slid off the plate")),
        ("x  bumped", ("void", "bumped")),
        ("", None),
        ("yy", None),
        ("maybe y", None),
    ],
)
def test_verdicts_are_read_as_people_type_them(line: str, read: tuple[str, str] | None) -> None:
    assert read_verdict(line) == read


# -- on the disk ----------------------------------------------------------------------------------
def begun(folder: Path) -> TrialFolder:
    trial = TrialFolder(folder)
    with trial.lock():
        trial.begin(PLAN_AB)
    return trial


def test_a_trial_is_gone_on_with_where_it_was_broken_off(tmp_path: Path) -> None:
    assert TrialFolder(tmp_path / "new").plan() is None
    done = [
        judged(1, "b", "failure", note="tab\tand newline\nand \u2028", start_m=None),
        judged(1, "a", "void", number=2),
    ]
    trial = begun(tmp_path / "new")
    for each in done:
        trial.append(each)
    again = TrialFolder(tmp_path / "new")
    assert again.plan() == PLAN_AB
    assert again.episodes() == done
    assert not again.truncated
    due = PLAN_AB.next_due(again.episodes())
    assert due is not None
    assert (due.setup, due.worker) == (1, "a")
    assert again.next_number(again.episodes()) == 3
    again.recording(7).touch()  # of one that was killed before its verdict
    assert again.next_number(again.episodes()) == 8


@settings(max_examples=20)  # each of them waits for the disk
@given(st.integers(1, 400))
def test_a_line_that_was_cut_off_is_as_if_it_had_never_been_written(cut: int) -> None:
    with TemporaryDirectory() as name:
        trial = begun(Path(name))
        first, second = judged(1, "a"), judged(1, "b", note="x" * 200)
        trial.append(first)
        whole = (Path(name) / TRIALS).read_bytes()
        trial.append(second)
        path = Path(name) / TRIALS
        line = path.read_bytes()[len(whole) :]
        path.write_bytes(whole + line[: min(cut, len(line) - 1)])
        assert trial.episodes() == [first]
        assert trial.truncated
        trial.append(second)
        assert trial.episodes() == [first, second]
        assert not trial.truncated


def test_only_one_at_a_time_goes_on_with_a_trial(tmp_path: Path) -> None:
    begun(tmp_path)
    with (
        TrialFolder(tmp_path).lock(),
        pytest.raises(RecordingError, match="another `vla-zenoh trial` is at work"),
        TrialFolder(tmp_path).lock(),
    ):
        pass
    with TrialFolder(tmp_path).lock():
        pass


def test_files_that_are_not_as_they_were_written_are_refused_by_line(tmp_path: Path) -> None:
    trial = begun(tmp_path)
    trial.append(judged(1, "a"))
    path = tmp_path / TRIALS
    good = path.read_text()
    for bad, why in (
        (good.replace('"success"', '"splendid"'), "line 2: verdict: wants 'success'"),
        (good.replace('"setup": 1', '"setup": "1"'), "line 2: setup: wants a whole number"),
        ("{}\n", "line 2: number: is missing"),
        ("nonsense\n", "line 2: Invalid JSON"),
    ):
        path.write_text(good + bad)
        with pytest.raises(RecordingError, match=why):
            trial.episodes()
    (tmp_path / PLAN).unlink()
    with pytest.raises(RecordingError, match=r"exists without its plan.json"):
        trial.plan()
    (tmp_path / PLAN).write_text(json.dumps({**asdict(PLAN_AB), "seconds": -1}))
    with pytest.raises(RecordingError, match="allowed: more than 0"):
        trial.plan()


def test_other_arguments_than_those_it_was_begun_with_are_named() -> None:
    assert PLAN_AB.differences({"workers": ("a", "b"), "seed": None, "blind": None}) == []
    assert PLAN_AB.differences(
        {"workers": ("b", "a"), "prompt": "wave", "seconds": 3.0, "setups": ("", ""), "seed": 8}
    ) == [
        "workers a, b, not b, a",
        "prompt 'put the brick away', not 'wave'",
        "setups (3 of them), not (2 of them)",
        "seconds 20.0, not 3.0",
        "seed 7, not 8",
    ]


# -- score ----------------------------------------------------------------------------------------
def test_the_score_of_known_verdicts_is_known() -> None:
    plan = replace(PLAN_AB, setups=("",) * 5)
    episodes = [
        judged(1, "a", time_s=4.0),
        judged(1, "b", "failure", end="lost", brakes=2),
        judged(2, "b", time_s=8.0),
        judged(2, "a", "void", brakes=9, end="stopped"),
        judged(2, "a", time_s=6.0),
        judged(3, "a", "failure", end="stopped"),
        judged(3, "b", "failure", end="taken"),
        judged(4, "a", time_s=20.0),
    ]
    found = score(plan, episodes)
    a, b = found.workers
    assert (a.worker, a.successes, a.episodes, a.rate) == ("a", 3, 4, 0.75)
    assert (a.time_to_success_s, a.brakes, a.interventions, a.void) == (6.0, 0, 1, 1)
    assert a.wilson_95 == pytest.approx((0.3006, 0.9544), abs=5e-4)
    assert (b.worker, b.successes, b.episodes, b.brakes, b.interventions) == ("b", 1, 3, 2, 1)
    assert found.paired == Paired(both=1, first=1, second=0, neither=1), "setup 4 is no pair yet"
    assert (found.done, found.of) == (7, 10)


def test_without_a_verdict_nothing_is_known() -> None:
    found = score(PLAN_AB, [])
    assert found.paired == Paired(0, 0, 0, 0)
    for each in found.workers:
        assert (each.rate, each.wilson_95, each.time_to_success_s) == (None, (0.0, 1.0), None)
    assert score(replace(PLAN_AB, workers=("a", "b", "c")), []).paired is None


def test_a_verdict_in_a_recording_is_that_of_its_worker_alone() -> None:
    fact = {"dropped": {}, "trial": asdict(judged(1, "a", "failure"))}
    assert verdict_in(fact, "a") == "failure"
    assert verdict_in(fact, "b") is None
    for ended in (None, {}, {"trial": "a"}, {"trial": {"worker": "a"}}):
        assert verdict_in(ended, "a") is None
    assert verdict_in({"trial": {"worker": "a", "verdict": ["success"]}}, "a") is None
