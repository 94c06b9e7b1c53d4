"""The profile as a whole: its sections fit each other."""

from __future__ import annotations

from pydantic import model_validator

from vla_zenoh.profile import fit
from vla_zenoh.profile.schema import ProfileFields
from vla_zenoh.profile.section import refuse


class Profile(ProfileFields):
    __doc__ = ProfileFields.__doc__

    @model_validator(mode="after")
    def _parts_fit(self) -> Profile:
        refuse(fit.faults(self))
        return self
