"""Peers of the mesh of strands-robots as processes: strands_peer_process.py, and ours."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from concurrent.futures import Future
from pathlib import Path
from typing import Any, Self

from r2c_rig import Process, ours

VARIABLE = "STRANDS_PYTHON"
SCRIPT = Path(__file__).with_name("strands_peer_process.py")
PROVIDER = "vla_zenoh"


class StrandsPeer:
    """A peer of theirs, at the router `endpoint`."""

    def __init__(self, name: str, endpoint: str, folder: Path) -> None:
        self.name = name
        environ = {
            **os.environ,
            "HOME": str(folder),
            "PYTHONPATH": "",  # of another Python
            "ZENOH_CONNECT": endpoint,
            "STRANDS_MESH_LOCAL_DEV": "true",
            "STRANDS_MESH_POLICY_TYPE_ALLOW": PROVIDER,
            "STRANDS_MESH_HITL_ACTIONS": "none",
        }
        with (folder / f"{name}.log").open("ab") as log:
            self._process = subprocess.Popen(
                [os.environ[VARIABLE], str(SCRIPT), name],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environ,
                text=True,
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._in, self._out = self._process.stdin, self._process.stdout
        self._asked: dict[int, Future[Any]] = {}
        while self._out.readline().strip() != "READY":
            assert self._process.poll() is None, (folder / f"{name}.log").read_text()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._out:
            if line.startswith('{"number"'):
                answer = json.loads(line)
                self._asked[answer["number"]].set_result(answer["found"])

    def begin(self, do: str, **fields: Any) -> Future[Any]:
        """Ask something whose answer may take its time."""
        number = len(self._asked)
        self._asked[number] = Future()
        self._in.write(json.dumps({"number": number, "do": do, **fields}) + "\n")
        self._in.flush()
        return self._asked[number]

    def ask(self, do: str, **fields: Any) -> Any:
        return self.begin(do, **fields).result(40.0)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._reader.join()  # its pipe has ended
        self._in.close()
        self._out.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class OurPeer(Process):
    """`serve strands` for a robot."""

    def __init__(self, log: Path, profile_file: Path, *words: str) -> None:
        super().__init__(log, ours("serve", "strands", "--profile", str(profile_file), *words))
        self.until("on the mesh")
