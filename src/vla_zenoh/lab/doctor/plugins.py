"""Checks of plug-ins: each can be imported, and what that of the robot says of this computer."""

from __future__ import annotations

from collections.abc import Iterator

from vla_zenoh import plugins
from vla_zenoh.errors import PluginError, in_words
from vla_zenoh.lab.doctor.needs import HostFinding, nodes_on
from vla_zenoh.profile import Profile


def installed_plugins() -> Iterator[HostFinding]:
    """The plug-ins of every group, and those that cannot be imported."""
    for group in plugins.GROUPS:
        name = f"plug-ins: {group.noun}s"
        known, faults = plugins.installed(group), plugins.broken(group)
        works = ", ".join(entry for entry in known if entry not in faults)
        yield HostFinding(name, "ok", works or "none")
        for why in faults.values():
            yield HostFinding(name, "warn", why, "mend or uninstall that package")


def robot_drivers(profile: Profile, host: str | None) -> Iterator[HostFinding]:
    """What the robot drivers of a profile need of this computer, where they run there."""
    here = nodes_on(profile, host)
    for name, node in profile.robot_nodes.items():
        if node in here:
            yield from _robot_driver(profile, name)


def _robot_driver(profile: Profile, name: str) -> Iterator[HostFinding]:
    try:
        robot = plugins.load(plugins.ROBOTS, name)
    except PluginError as error:
        yield HostFinding("robot driver", "fail", str(error))
        return
    try:
        yield from robot.check_host(profile, profile.driver_options)
    except Exception as error:
        why = f"the check of {name} itself failed: {in_words(error)}"
        yield HostFinding("robot driver", "warn", why)
