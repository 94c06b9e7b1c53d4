"""Warns of certificates of this computer that expire or are faulty, while nodes run.

A lab may be up for months. When a certificate expires Zenoh closes the link, and the arm stands.
"""

from __future__ import annotations

import datetime as dt
import time
from collections.abc import Callable
from typing import NamedTuple

from vla_zenoh.errors import MissingExtraError, SecurityError
from vla_zenoh.profile.schema import SecurityProfile

LOOK_PERIOD_S = 3600.0
TELL_PERIOD_S = 24 * 3600.0


class ExpiryOutlook(NamedTuple):
    """Result of checking the certificates."""

    days: int | None = None  # until the first expires, negative if it has; None: unknown
    wrong: tuple[str, ...] = ()  # files that are invalid, or soon will be, and why
    unknown: str = ""  # why they could not be checked; empty: they were


def outlook(security: SecurityProfile, now: dt.datetime) -> ExpiryOutlook:
    """Check the certificates of this computer, at `now` in UTC."""
    try:
        from vla_zenoh.security.certificates import CheckedStore

        store = CheckedStore(security.folder)
        entries = store.entries(now, store.this_host(security.host))
    except MissingExtraError as error:  # using certificates needs no library to read them
        return ExpiryOutlook(unknown=f"the expiry of certificates cannot be checked here: {error}")
    except SecurityError as error:
        return ExpiryOutlook(unknown=str(error))
    wrong = tuple(
        f"{entry.path.name} {what}"
        for entry in entries
        for what in filter(None, (*entry.faults, entry.warning))
    )
    days = [entry.certificate.days_left(now) for entry in entries if entry.certificate]
    return ExpiryOutlook(min(days, default=None), wrong)


class CertificateExpiry:
    """Checks certificates once an hour; faults are reported when they are new, and once a day.

    Without `security` there are none. `now` is UTC.
    """

    def __init__(
        self,
        security: SecurityProfile | None,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], dt.datetime] = lambda: dt.datetime.now(dt.UTC),
    ) -> None:
        self._security, self._clock, self._now = security, clock, now
        self._looked_s = self._told_s = -1e9
        self._outlook = self._told = ExpiryOutlook()

    @property
    def outlook(self) -> ExpiryOutlook:
        """The last result, at most an hour old."""
        if self._security is not None and self._clock() - self._looked_s >= LOOK_PERIOD_S:
            self._looked_s = self._clock()
            self._outlook = outlook(self._security, self._now())
        return self._outlook

    def due(self) -> tuple[str, ...]:
        """Sentences to report now."""
        found = self.outlook
        new = found[1:] != self._told[1:]  # the days are no news
        if not new and (not found.wrong or self._clock() - self._told_s < TELL_PERIOD_S):
            return ()
        self._told, self._told_s = found, self._clock()
        unknown = (found.unknown,) if found.unknown and new else ()
        return (*(f"certificate {what}" for what in found.wrong), *unknown)
