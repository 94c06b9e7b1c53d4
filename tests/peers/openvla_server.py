"""A policy server as OpenVLA's deploy.py serves, written after it; json_numpy's own code if there.

Variants: ``oft`` (a list of steps), ``text`` (double encoding only).
"""

from __future__ import annotations

import base64
import json
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
import policy

try:
    from json_numpy import dumps, loads
except ImportError:

    def dumps(value: Any) -> str:
        def out(array: Any) -> Any:
            return {
                "__numpy__": base64.b64encode(array.tobytes()).decode(),
                "dtype": array.dtype.str,
                "shape": array.shape,
            }

        return json.dumps(value, default=out)

    def loads(text: Any) -> Any:
        def back(value: dict[str, Any]) -> Any:
            if "__numpy__" not in value:
                return value
            raw = base64.b64decode(value["__numpy__"])
            return np.frombuffer(raw, value["dtype"]).reshape(value["shape"])

        return json.loads(text, object_hook=back)


def predict(body: bytes, variant: str) -> Any:
    payload = json.loads(body) if variant == "text" else loads(body)
    double = "encoded" in payload
    if double:
        assert len(payload) == 1
        payload = loads(payload["encoded"])
    assert double or variant != "text"
    image = payload["full_image" if variant == "oft" else "image"]
    assert (image.dtype, image.ndim) == (np.uint8, 3), image.shape
    rows = policy.actions(payload["instruction"])
    action = list(rows) if variant == "oft" else rows[0].astype(np.float64)
    return dumps(action) if double else action


class Handler(BaseHTTPRequestHandler):
    variant = ""

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        try:
            assert self.path == "/act", self.path
            answer = dumps(predict(body, self.variant))
        except Exception:
            answer = '"error"'  # as published: status 200, whatever the fault
        out = answer.encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(out)))
        self.end_headers()
        with suppress(BrokenPipeError):  # who asked has given up
            self.wfile.write(out)

    def log_message(self, format: str, *args: Any) -> None:
        pass


if __name__ == "__main__":
    told = policy.arguments()
    Handler.variant = told.variant
    ThreadingHTTPServer(("127.0.0.1", told.port), Handler).serve_forever()
