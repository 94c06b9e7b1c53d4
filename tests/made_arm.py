"""Arms that no maker sells: any chain of joints that turn and slide, each with its description."""

from __future__ import annotations

from pathlib import Path

from vla_zenoh.profile import Profile, load_profile, override

AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
SLIDE_M, TURN_RAD = 0.5, 2.5
SLIDE_M_S, TURN_RAD_S = 0.4, 2.0
LINK = """<link name="link{n}"><collision><geometry><sphere radius="0.01"/></geometry></collision>
</link>"""
JOINT = """
<joint name="joint{n}" type="{kind}"><parent link="link{before}"/><child link="link{n}"/>
<origin xyz="{length} 0 0"/><axis xyz="{axis}"/>
<limit {ends} velocity="{fast}" effort="{effort}"/></joint>"""
KINDS = {"s": "prismatic", "t": "revolute", "e": "continuous"}
SLIDES = f'lower="0" upper="{SLIDE_M}"'
TURNS = f'lower="{-TURN_RAD}" upper="{TURN_RAD}"'
EFFORT = 10.0


def made_arm(folder: Path, chain: str, length_m: float = 0.15, effort: float = EFFORT) -> Profile:
    """An arm at rest in the middle of its ranges.

    Args:
        folder: for its description.
        chain: letters of its joints: t turns, e turns without an end, s slides, each followed by
            its axis: ``szty``.
        length_m: of a link.
        effort: of a joint, Nm or N.
    """
    kinds = [chain[at : at + 2] for at in range(0, len(chain), 2)]
    parts = [LINK.format(n=0)]
    for n, (kind, axis) in enumerate(kinds, start=1):
        slides = kind == "s"
        parts.append(LINK.format(n=n))
        parts.append(
            JOINT.format(
                n=n,
                before=n - 1,
                kind=KINDS[kind],
                length=0.0 if n == 1 else length_m,
                axis=AXES[axis],
                ends={"s": SLIDES, "t": TURNS, "e": ""}[kind],
                effort=effort,
                fast=SLIDE_M_S if slides else TURN_RAD_S,
            )
        )
    tip = len(kinds) + 1
    parts.append(LINK.format(n=tip))
    parts.append(
        f'<joint name="tip" type="fixed"><parent link="link{tip - 1}"/><child link="link{tip}"/>'
        f'<origin xyz="{length_m} 0 0"/></joint>'
    )
    file = folder / f"{chain}.urdf"
    file.write_text(f'<robot name="made">{"".join(parts)}</robot>')
    slides = [kind[0] == "s" for kind in kinds]
    robot = {
        "name": "made",
        "command": "joint",
        "description": str(file),
        "base_frame": "link0",
        "tcp_frame": f"link{tip}",
        "arm_joints": [f"joint{n}" for n in range(1, tip)],
        "finger_joints": [],
        "home_rad": [SLIDE_M / 2 if one else 0.1 for one in slides],
    }
    limits = {
        "workspace": {"x_m": [-3, 3], "y_m": [-3, 3], "z_m": [-3, 3]},
        "reach": {"table_z_m": None},
        "joint": {
            "velocity_rad_s": [0.2 if one else 1.0 for one in slides],
            "acceleration_rad_s2": [1.0 if one else 4.0 for one in slides],
            "jerk_rad_s3": [50.0 if one else 200.0 for one in slides],
        },
    }
    return override(load_profile("panda_sim"), {"robot": robot, "limits": limits})
