"""The table of roles, and the rules for Zenoh that are made of it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from access_check import Passage, allows, missing, passages
from hypothesis import given
from hypothesis import strategies as st

from vla_zenoh.bus.session import covers
from vla_zenoh.errors import ProfileError
from vla_zenoh.keys import KEY_PATHS, NODE_KINDS, Keys
from vla_zenoh.profile import Profile, load_profile, override
from vla_zenoh.security.roles import (
    TABLE,
    Act,
    Identity,
    Right,
    Role,
    access_control,
    expressions,
    identities,
    identities_of,
    rights,
    wide,
)

KEYS = Keys("panda")
LAB = {
    "session": {
        "listen": ["tls/10.0.0.2:7447"],
        "connect": ["tls/10.0.0.2:7447"],
        "security": {"people": {"desk": "operator", "wall": "viewer"}},
    },
    "workers": ["scripted", "replay"],
    "hosts": {
        "robot": {"nodes": ["router", "sim", "command"]},
        "eyes": {"nodes": ["camera"], "cameras": ["front"]},
        "gpu": {"nodes": ["worker", "camera"], "cameras": ["wrist"]},
    },
}


@pytest.fixture(scope="module")
def lab() -> Profile:
    return override(load_profile("panda_sim"), LAB)


def who(lab: Profile, common_name: str) -> Identity:
    return next(one for one in identities(lab) if one.common_name == common_name)


def test_every_key_has_a_row_in_the_table_of_roles() -> None:
    assert sorted(TABLE) == sorted(KEY_PATHS)


def test_every_kind_of_node_has_a_role() -> None:
    assert {traits.role for traits in NODE_KINDS.values()} <= {role.value for role in Role}


@pytest.mark.parametrize("member", TABLE)
def test_every_key_is_written_by_somebody_and_read_by_somebody(member: str) -> None:
    allowed = TABLE[member]
    said = [role for act in (Act.PUT, Act.ANSWER, Act.ANNOUNCE) for role in allowed.get(act, ())]
    heard = [role for act in (Act.SUBSCRIBE, Act.ASK, Act.WATCH) for role in allowed.get(act, ())]
    assert said
    assert heard


def test_a_lab_has_one_identity_for_each_node_and_for_its_people(lab: Profile) -> None:
    assert {one.common_name: one.role for one in identities(lab)} == {
        "router@robot": Role.ROUTER,
        "sim@robot": Role.ROBOT,
        "command@robot": Role.COMMAND,
        "operator@robot": Role.OPERATOR,
        "worker-teleop@robot": Role.WORKER,
        "camera-eyes@eyes": Role.CAMERA,
        "viewer@eyes": Role.VIEWER,
        "worker-scripted@gpu": Role.WORKER,
        "worker-replay@gpu": Role.WORKER,
        "camera-gpu@gpu": Role.CAMERA,
        "viewer@gpu": Role.VIEWER,
        "operator@desk": Role.OPERATOR,
        "worker-teleop@desk": Role.WORKER,
        "viewer@wall": Role.VIEWER,
    }


def test_an_unknown_host_is_refused_with_those_that_are_known(lab: Profile) -> None:
    with pytest.raises(ProfileError, match=r"knows: desk, eyes, gpu, robot, wall.*--role viewer"):
        identities_of(lab, "attic")


def may(lab: Profile, common_name: str, act: Act) -> set[str]:
    return {
        KEYS.short(right.key) for right in rights(KEYS, who(lab, common_name)) if right.act is act
    }


def test_a_worker_writes_its_own_keys_only(lab: Profile) -> None:
    assert may(lab, "worker-scripted@gpu", Act.PUT) == {
        "delta/scripted",
        "spec/scripted",
        "seen/scripted",
        "seen/scripted/*",
        "seen/scripted/*/depth",
        "status/worker-scripted",
        "event/worker-scripted",
    }


def test_the_node_of_the_primitives_is_a_worker_that_speaks_for_operators(lab: Profile) -> None:
    robot = {"nodes": ["router", "sim", "command", "primitives"]}
    named = override(load_profile("panda_sim"), {**LAB, "hosts": {**LAB["hosts"], "robot": robot}})
    written = may(named, "worker-primitives@robot", Act.PUT)
    assert {"delta/primitives", "spec/primitives", "active", "worker", "prompt"} <= written
    assert not {"delta/scripted", "command/pose", "state/pose"} & written
    assert may(named, "worker-primitives@robot", Act.ANSWER) >= {"primitive/*"}
    assert "primitive/*" in may(named, "operator@desk", Act.ASK)
    assert "primitive/*" not in may(named, "viewer@wall", Act.ASK)
    for other in ("worker-scripted@gpu", "worker-teleop@desk"):
        assert "primitive/*" not in may(named, other, Act.ANSWER)


def test_an_operator_who_drives_by_hand_is_a_worker_like_any_other(lab: Profile) -> None:
    assert may(lab, "worker-teleop@desk", Act.PUT) == {
        "delta/teleop",
        "spec/teleop",
        "seen/teleop",
        "seen/teleop/*",
        "seen/teleop/*/depth",
        "status/worker-teleop",
        "event/worker-teleop",
    }
    assert may(lab, "worker-teleop@desk", Act.ANNOUNCE) == {"alive/worker-teleop"}


def test_a_replay_says_what_a_recording_holds_and_is_no_node_but_itself(lab: Profile) -> None:
    stage = override(lab, {"session": {"security": {"people": {"stage": "replay"}}}})
    said = may(stage, "replay@stage", Act.PUT)
    assert {"state/pose", "camera/*/jpeg", "delta/*", "prompt", "status/*", "task"} <= said
    assert may(stage, "replay@stage", Act.ANNOUNCE) == {"alive/replay"}
    assert may(stage, "replay@stage", Act.ANSWER) == {"clock/replay"}
    assert may(stage, "replay@stage", Act.SUBSCRIBE) == set()
    assert may(stage, "replay@stage", Act.WATCH) == {"alive/*"}


def test_a_camera_host_writes_its_own_cameras_only(lab: Profile) -> None:
    assert may(lab, "camera-eyes@eyes", Act.PUT) == {
        "camera/front/raw",
        "camera/front/jpeg",
        "camera/front/depth",
        "camera/front/fitted/*",
        "status/camera-eyes",
        "event/camera-eyes",
    }


def test_only_the_command_node_writes_commands_and_only_the_robot_writes_states(
    lab: Profile,
) -> None:
    for identity in identities(lab):
        written = may(lab, identity.common_name, Act.PUT)
        assert bool({"command/pose", "command/joint"} & written) == (identity.role is Role.COMMAND)
        assert bool({"state/pose", "state/joint"} & written) == (identity.role is Role.ROBOT)


def test_only_an_operator_says_what_is_to_be_done(lab: Profile) -> None:
    orders = {"prompt", "active", "worker", "rate", "speed", "slower", "stop", "reset"}
    orders.add("sim/reset")
    for identity in identities(lab):
        written = may(lab, identity.common_name, Act.PUT)
        assert written & orders == (orders if identity.role is Role.OPERATOR else set())


def test_a_viewer_writes_nothing_and_sees_no_picture(lab: Profile) -> None:
    assert may(lab, "viewer@wall", Act.PUT) == set()
    seen = may(lab, "viewer@wall", Act.SUBSCRIBE)
    assert "status/*" in seen
    assert not any(key.startswith(("camera/", "seen/")) for key in seen)


def test_a_viewer_may_ask_for_all_of_a_group_that_has_nothing_hidden(lab: Profile) -> None:
    asked = {KEYS.short(key) for key in wide(KEYS, who(lab, "viewer@wall"))}
    assert {"state/*", "command/*", "status/*", "event/*", "delta/*"} <= asked
    assert not any(key.startswith(("camera", "seen", "sim")) for key in asked)
    assert wide(KEYS, who(lab, "command@robot")) == []


def test_a_wild_key_covers_those_it_means() -> None:
    assert covers("vla/panda/**", "vla/panda/delta/*")
    assert covers("**", "vla")
    assert covers("a/**/d", "a/b/c/d")
    assert not covers("vla/panda/delta/scripted", "vla/panda/delta/*")
    assert not covers("vla/panda/*", "vla/panda/delta/x")
    assert not covers("vla/panda/*", "vla/panda/**")
    assert not covers("vla/panda/delta", "vla/panda/deltas")


@given(st.lists(st.sampled_from(["a", "b", "*", "**"]), min_size=1, max_size=5))
def test_every_key_covers_itself_and_is_covered_by_everything(parts: list[str]) -> None:
    key = "/".join(parts)
    assert covers(key, key) or "**" in parts[1:]
    assert covers("**", key)


def every_possible_act(lab: Profile) -> Iterator[Right]:
    """Everything anybody could try, in anybody's name."""
    people = [one for one in identities(lab) if one.role is not Role.ROUTER]
    tried = {
        (act, key)
        for other in people
        for member in TABLE
        for act in Act
        for key in expressions(KEYS, member, other, act)
    }
    for one in people:
        for act, key in sorted(tried, key=str):
            yield Right(one, act, key)


def test_the_rules_allow_exactly_what_the_table_says(lab: Profile) -> None:
    config = access_control([lab])
    granted = {(r.identity, r.act, r.key) for one in identities(lab) for r in rights(KEYS, one)}
    tried = 0
    for right in every_possible_act(lab):
        lacking = missing(config, right.identity, right.act, right.key)
        allowed = (right.identity, right.act, right.key) in granted
        reads_all = right.identity.role is Role.OPERATOR and right.act is Act.SUBSCRIBE
        assert (not lacking) == (allowed or reads_all), (right, lacking)
        tried += 1
    assert tried > 1000


def test_a_rule_that_was_taken_out_is_named(lab: Profile) -> None:
    config = access_control([lab])
    worker = who(lab, "worker-scripted@gpu")
    key = KEYS.delta("scripted")
    assert missing(config, worker, Act.PUT, key) == []
    config["rules"] = [
        rule for rule in config["rules"] if "worker-scripted@gpu:egress:decl" not in rule["id"]
    ]
    lacking = missing(config, worker, Act.PUT, key)
    assert [str(passage) for passage in lacking] == [f"egress declare_subscriber {key}"]


def test_a_rule_that_denies_wins_and_a_disabled_section_allows_all(lab: Profile) -> None:
    config = access_control([lab])
    passage = Passage("ingress", "put", KEYS.prompt)
    assert allows(config, "operator@desk", passage)
    config["rules"].append({**config["rules"][0], "id": "no", "permission": "deny"})
    config["rules"][-1].update(flows=["ingress"], messages=["put"], key_exprs=["vla/**"])
    config["policies"].append({"rules": ["no"], "subjects": ["operator@desk"]})
    assert not allows(config, "operator@desk", passage)
    assert allows({**config, "enabled": False}, "stranger", passage)
    assert not allows(config, "stranger", passage)


def test_a_router_of_two_robots_lets_each_lab_at_its_own_robot_only(lab: Profile) -> None:
    other = override(
        lab, {"robot": {"name": "ur"}, "session": {"security": {"people": {"desk": "viewer"}}}}
    )
    other = override(
        other, {"hosts": {"robot2": {"nodes": ["sim", "command", "camera", "worker"]}}}
    )
    config = access_control([lab, other])
    robots = {"sim@robot": "panda", "sim@robot2": "ur"}
    for common_name, own in robots.items():
        for name in ("panda", "ur"):
            put = Passage("ingress", "put", Keys(name).state_pose)
            assert allows(config, common_name, put) == (name == own)
    # One computer may drive one robot and only look at another.
    assert allows(config, "operator@desk", Passage("ingress", "put", KEYS.prompt))
    assert not allows(config, "operator@desk", Passage("ingress", "put", Keys("ur").prompt))


def test_people_may_ask_which_robots_there_are_and_are_told_of_theirs(lab: Profile) -> None:
    others = {
        **LAB,
        "robot": {"name": "ur"},
        "session": {**LAB["session"], "security": {"people": {"desk": "operator"}}},
        "hosts": {"robot2": {"nodes": ["sim", "command", "camera", "worker"]}},
    }
    config = access_control([lab, override(load_profile("panda_sim"), others)])

    def passes(common_name: str, flow: str, message: str, key: str) -> bool:
        return allows(config, common_name, Passage(flow, message, key))

    for message in ("liveliness_query", "declare_liveliness_subscriber"):
        for person in ("operator@desk", "viewer@wall"):
            assert passes(person, "ingress", message, KEYS.all_robots)
            assert not passes(person, "ingress", message, "vla/*/alive/*")
        assert not passes("worker-scripted@gpu", "ingress", message, KEYS.all_robots)
    robots = {
        person: [
            name
            for name in ("panda", "ur")
            if passes(person, "egress", "liveliness_token", Keys(name).alive("command"))
        ]
        for person in ("operator@desk", "viewer@wall")
    }
    assert robots == {"operator@desk": ["panda", "ur"], "viewer@wall": ["panda"]}


@pytest.mark.parametrize("act", [act for act in Act if act is not Act.DELETE])
def test_every_act_needs_the_router_on_the_way_in_and_on_the_way_out(act: Act) -> None:
    assert {passage.flow for passage in passages(act, "k")} == {"ingress", "egress"}


def test_nobody_deletes_and_no_rule_but_the_routers_lets_a_deletion_pass(lab: Profile) -> None:
    rules = access_control([lab])["rules"]
    assert {rule["id"] for rule in rules if "delete" in rule["messages"]} == {"router"}
    assert not any(
        right.act is Act.DELETE for one in identities(lab) for right in rights(KEYS, one)
    )


def test_a_ros_node_speaks_for_ros_people_only_where_they_have_topics() -> None:
    security = {"listen": ["tls/10.0.0.2:7447"], "connect": ["tls/10.0.0.2:7447"], "security": {}}
    bridge = {"connect": ["tcp/127.0.0.1:7448"]}
    plain = load_profile("panda_ros2")
    with pytest.raises(
        ProfileError, match=r"ros2\.connect: is missing: in a secured lab the bridge"
    ):
        override(plain, {"session": security})
    for prefix, drives in (("/vla", True), (None, False)):
        ros2 = {**bridge, "prefix": prefix}
        lab = override(plain, {"session": security, "ros2": ros2})
        written = may(lab, "ros2@here", Act.PUT)
        assert {"state/pose", "camera/front/jpeg", "status/ros2"} <= written
        assert ("prompt" in written) == drives


def test_an_operator_may_run_a_recorder_and_no_other_node(lab: Profile) -> None:
    said = {key for key in may(lab, "operator@desk", Act.PUT) if key.startswith("status/")}
    assert said == {"status/recorder", "status/rolling"}
    announced = {"alive/recorder", "alive/rolling", "holding/*"}
    assert may(lab, "operator@desk", Act.ANNOUNCE) == announced
