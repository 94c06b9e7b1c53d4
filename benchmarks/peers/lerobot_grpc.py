"""LeRobot's asynchronous inference: its own policy server and gRPC stubs, in its own environment.

The server is theirs, from the queue of one observation to the pickled chunk; only the policy is
another, which sleeps. Servers that are forked from one process share a lock, as processes that take
turns on one GPU. Needs Python 3.12 and ``lerobot[async]``; tried with 0.6.1.
"""

from __future__ import annotations

import multiprocessing
import pickle
import time
from concurrent import futures
from types import SimpleNamespace
from typing import Any

import grpc
import numpy as np
import torch
from lerobot.async_inference import policy_server
from lerobot.async_inference.configs import PolicyServerConfig
from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.transport import services_pb2, services_pb2_grpc
from lerobot.transport.utils import grpc_channel_options, send_bytes_in_chunks
from numpy.typing import NDArray

from benchmarks.peers import ACTION, ADDRESS, PROMPT, Pictures

HORIZON, KIND, THREADS = 10, "act", 4
"""Steps of a chunk, a kind of policy that the server knows, and the threads that it starts with."""
JOINTS = [f"joint_{number}.pos" for number in range(6)]
GPU = multiprocessing.get_context("fork").Lock()


class DeclaredCost:
    """A policy that takes its time, and answers with the same action."""

    takes_s = 0.0

    def __init__(self, shapes: dict[str, tuple[int, ...]]) -> None:
        visual = FeatureType.VISUAL
        self.config = SimpleNamespace(
            image_features={name: PolicyFeature(visual, shape) for name, shape in shapes.items()}
        )

    @classmethod
    def from_pretrained(cls, where: str) -> DeclaredCost:
        """A policy for the images that `where` tells: ``SIDE:CAMERAS``."""
        side, cameras = map(int, where.split(":"))
        names = [f"observation.images.camera_{number}" for number in range(cameras)]
        return cls(dict.fromkeys(names, (3, side, side)))

    def to(self, _: str) -> None:
        """It is where it is."""

    def predict_action_chunk(self, _: dict[str, Any]) -> torch.Tensor:
        """The chunk, when the GPU was free and the time has passed."""
        with GPU:
            time.sleep(self.takes_s)
        return torch.tensor(ACTION).repeat(1, HORIZON, 1)


def serve(port: int, takes_s: float) -> None:
    """Answer until the process ends."""
    DeclaredCost.takes_s = takes_s
    policy_server.get_policy_class = lambda _: DeclaredCost
    policy_server.make_pre_post_processors = lambda *_, **__: (lambda seen: seen, lambda done: done)
    # Without this an inference of theirs takes at least 33 ms.
    config = PolicyServerConfig(host=ADDRESS, port=port, inference_latency=0.0)
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=THREADS))
    services_pb2_grpc.add_AsyncInferenceServicer_to_server(
        policy_server.PolicyServer(config), server
    )
    server.add_insecure_port(f"{ADDRESS}:{port}")
    server.start()
    server.wait_for_termination()


class Client:
    """Client side, with the calls of LeRobot's own client."""

    def __init__(self, port: int) -> None:
        self._channel = grpc.insecure_channel(f"{ADDRESS}:{port}", grpc_channel_options())
        self._stub = services_pb2_grpc.AsyncInferenceStub(self._channel)
        self._step = 0
        self._known = False

    def _introduce(self, pictures: Pictures) -> None:
        shape, self._known = pictures[0].shape, True
        state = {"dtype": "float32", "shape": (len(JOINTS),), "names": JOINTS}
        image = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
        images = {f"observation.images.camera_{number}": image for number, _ in enumerate(pictures)}
        features: dict[str, Any] = {"observation.state": state, **images}
        told = RemotePolicyConfig(KIND, f"{shape[0]}:{len(pictures)}", features, HORIZON)
        self._stub.Ready(services_pb2.Empty())
        self._stub.SendPolicyInstructions(services_pb2.PolicySetup(data=pickle.dumps(told)))

    def request(self, pictures: Pictures) -> NDArray[Any] | None:
        """Send images; returns seven floats, or None: a chunk of another robot's image, or none."""
        if not self._known:
            self._introduce(pictures)
        seen: dict[str, Any] = dict.fromkeys(JOINTS, 0.0) | {"task": PROMPT}
        seen |= {f"camera_{number}": rgb for number, rgb in enumerate(pictures)}
        stamp_s, self._step = time.time(), self._step + 1
        asked = TimedObservation(
            timestamp=stamp_s, timestep=self._step, observation=seen, must_go=True
        )
        message = services_pb2.Observation
        self._stub.SendObservations(send_bytes_in_chunks(pickle.dumps(asked), message))
        answer = self._stub.GetActions(services_pb2.Empty())
        chunk = pickle.loads(answer.data) if answer.data else []
        if not chunk or chunk[0].get_timestamp() != stamp_s:
            return None
        return np.asarray(chunk[0].get_action())

    def close(self) -> None:
        """Close the channel."""
        self._channel.close()
