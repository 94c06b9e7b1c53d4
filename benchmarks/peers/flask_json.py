"""Flask's own server and requests: a PNG as base64 in JSON there, a list of floats back."""

from __future__ import annotations

import base64
import logging
import threading
import time
from typing import Any

import cv2
import flask
import numpy as np
import requests
from numpy.typing import NDArray
from werkzeug.serving import make_server

from benchmarks.peers import ACTION, ADDRESS, PROMPT, Pictures

TIMEOUT_S = 10.0


def serve(port: int, takes_s: float) -> None:
    """Answer until the process ends."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    app, gpu = flask.Flask(__name__), threading.Lock()

    @app.post("/act")
    def act() -> Any:
        asked = flask.request.get_json()
        for image in asked["images"]:
            file = np.frombuffer(base64.b64decode(image), np.uint8)
            bgr = cv2.imdecode(file, cv2.IMREAD_COLOR)
            if bgr is None:
                return {"error": "not a picture"}, 400
            cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        with gpu:
            time.sleep(takes_s)
        return {"action": list(ACTION)}

    make_server(ADDRESS, port, app, threaded=True).serve_forever()  # what app.run() does


def _in_text(rgb: NDArray[np.uint8]) -> str:
    """A PNG as base64."""
    _, file = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    return base64.b64encode(file.tobytes()).decode()


class Client:
    """Client side."""

    def __init__(self, port: int) -> None:
        self._url = f"http://{ADDRESS}:{port}/act"

    def request(self, pictures: Pictures) -> NDArray[Any]:
        """Send images; returns seven floats."""
        body = {"images": list(map(_in_text, pictures)), "instruction": PROMPT}
        # A proxy that the environment names is not meant for this computer.
        proxies: Any = {"http": None}
        answer = requests.post(self._url, json=body, timeout=TIMEOUT_S, proxies=proxies)
        answer.raise_for_status()
        return np.array(answer.json()["action"])

    def close(self) -> None:
        """Nothing is kept open between requests."""
