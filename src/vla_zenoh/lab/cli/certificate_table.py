"""Certificates of a lab, as a table and as JSON."""

from __future__ import annotations

import datetime as dt

from rich.text import Text

from vla_zenoh.cli.output import console, new_table, styled
from vla_zenoh.security.certificates import Entry


def print_certificates(entries: list[Entry], now: dt.datetime) -> None:
    """Print a table of certificates, then each fault and warning."""
    table = new_table("host", "node", "valid until", "days", "serves as")
    wrong: list[Text] = []
    for entry in entries:
        found, colour = entry.certificate, "green"
        if entry.faults:
            colour = "bold red"
        elif entry.warning:
            colour = "yellow"
        table.add_row(
            entry.host or "(the lab)",
            entry.node,
            styled(f"{found.not_after:%Y-%m-%d}", colour) if found else "",
            styled(found.days_left(now), colour) if found else "",
            ", ".join(found.addresses) if found else "",
        )
        named = f"{entry.host or 'the lab'}/{entry.node}"
        whys = entry.faults or ([entry.warning] if entry.warning else [])
        wrong += [styled(f"{named}: {why}", colour) for why in whys]
    screen = console()
    screen.print(table)
    for line in wrong:
        screen.print(line, soft_wrap=True)


def certificate_row(entry: Entry, now: dt.datetime) -> dict[str, object]:
    """One certificate, ready for JSON."""
    found = entry.certificate
    return {
        "host": entry.host,
        "node": entry.node,
        "file": str(entry.path),
        "common_name": found.common_name if found else None,
        "not_after": found.not_after.isoformat() if found else None,
        "days_left": found.days_left(now) if found else None,
        "addresses": list(found.addresses) if found else [],
        "faults": list(entry.faults),
        "warning": entry.warning,
    }
