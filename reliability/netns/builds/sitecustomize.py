"""Another build of the wire: Python imports this at its start, where its folder is on PYTHONPATH.

WIRE_BUILD says which: "now", "more" (records have one more optional field), or "raised" (the next
version).
"""

from __future__ import annotations

import dataclasses
import os
from functools import cache
from typing import Any

LATER = 7


def _more() -> None:
    from vla_zenoh.codec import records
    from vla_zenoh.types.form import Count

    encode, decode = records.encode, records.decode

    @cache
    def kind_of(kind: type[Any]) -> type[Any]:
        if not dataclasses.is_dataclass(kind):
            return kind
        later = ("later", Count, dataclasses.field(default=LATER))
        return dataclasses.make_dataclass(kind.__name__, [later], bases=(kind,), frozen=True)

    def encode_more(record: Any) -> bytes:
        if dataclasses.is_dataclass(record):
            fields = dataclasses.fields(record)
            own = {field.name: getattr(record, field.name) for field in fields}
            record = kind_of(type(record))(**own)
        return encode(record)

    def decode_more(kind: type[Any], *given: Any, **named: Any) -> Any:
        return decode(kind_of(kind), *given, **named)

    records.encode, records.decode = encode_more, decode_more


def _raised() -> None:
    from vla_zenoh import keys

    keys.SCHEMA += 1  # pyright: ignore


{"more": _more, "raised": _raised}.get(os.environ.get("WIRE_BUILD", ""), lambda: None)()
