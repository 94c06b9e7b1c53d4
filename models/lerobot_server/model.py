# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "grpcio>=1.70",
#     "numpy",
#     "pin>=4",
#     "vla-zenoh-policy-servers",
# ]
# ///
"""Queries lerobot's policy server (``lerobot.async_inference.policy_server``) over gRPC.

The server loads the policy that the client names, from a folder or a hub, and may take minutes for
it. Its answers are pickles, which are read as data (see pickles.py); lerobot is not needed here.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from vla_zenoh_model_lerobot_server import wire
from vla_zenoh_policy_servers.adapter import Adapter, address

from vla_zenoh.errors import PeerError, SpecError
from vla_zenoh.policy.options import number, one_of
from vla_zenoh.profile import load_profile

if TYPE_CHECKING:
    import grpc

NEVER_MS = 2**31 - 1


class LeRobotServer(Adapter):
    """Client of lerobot's policy server.

    Args:
        url: of the server, as grpc://HOST:PORT.
        policy: kind of policy, as lerobot names it: act, smolvla, pi05, ...
        checkpoint: folder or name on a hub, as the server finds it.
        device: of the server, as torch names it.
        preset: libero, see wire.py; none: no defaults.
        load_s: how long the server may load.
        timeout_s: for connecting, and for each answer.
        profile: of the robot: its gripper and, if answers are joints, its arm.
        layout: see vla_zenoh_policy_servers.field_mapping. An image is observation.images.NAME,
            the state observation.state, the prompt task; size none: as the camera gives it.
    """

    name, presets, joints = "lerobot_server", wire.PRESETS, True

    def __init__(
        self,
        url: str = f"grpc://127.0.0.1:{wire.PORT}",
        policy: str = "",
        checkpoint: str = "",
        device: str = "cpu",
        preset: str = "",
        load_s: str = "600",
        timeout_s: str = "2",
        profile: str = "panda_sim",
        **mapping: str,
    ) -> None:
        server = address(url, "grpc")
        super().__init__(
            server.geturl(),
            preset,
            mapping,
            timeout_s=timeout_s,
            profile=profile,
        )
        one_of("policy", policy, wire.POLICIES)
        if not checkpoint:
            raise SpecError("checkpoint is empty: give the folder or name that the server loads")
        described = wire.features(self.mapping, len(load_profile(profile).robot.arm_joints))
        steps = self.spec.action.horizon
        self._setup = wire.policy_config(policy, checkpoint, device, described, steps)
        self._target = f"{server.hostname}:{server.port or wire.PORT}"
        self._load_s = number("load_s", load_s, least=1.0)
        self._channel: grpc.Channel | None = None
        self._loading: grpc.Future | None = None
        self._since_s, self._number = 0.0, 0
        self._was_ready = False

    def _connect(self) -> list[str]:
        if self._channel is None:
            self._open()
        if self._loading is None:
            self._call("Ready")
            self._since_s = time.monotonic()
            setup = wire.policy_setup(self._setup)
            self._loading = self._method("SendPolicyInstructions").future(
                setup, timeout=self._load_s
            )
        self._wait_until_loaded(self._loading)
        return []  # the server does not describe itself

    def _open(self) -> None:
        import grpc

        options = {
            "grpc.max_receive_message_length": wire.MAX_BYTES,
            "grpc.enable_http_proxy": 0,
            "grpc.initial_reconnect_backoff_ms": 100,
            "grpc.min_reconnect_backoff_ms": 100,
            "grpc.max_reconnect_backoff_ms": 1000,
            "grpc.client_idle_timeout_ms": NEVER_MS,  # a new connection loads the policy again
        }
        self._channel = grpc.insecure_channel(self._target, options=[*options.items()])

        def changed(state: grpc.ChannelConnectivity) -> None:
            if state is grpc.ChannelConnectivity.READY:
                self._was_ready = True
            elif self._was_ready:  # a server that was started again has no policy
                self._was_ready, self._loading = False, None

        self._channel.subscribe(changed)

    def _wait_until_loaded(self, loading: grpc.Future) -> None:
        import grpc

        try:
            loading.result(self.timeout_s)
            return
        except grpc.FutureTimeoutError:
            pass
        except (grpc.RpcError, grpc.FutureCancelledError) as error:
            self._loading = None
            known = self._as_known(error)
            if not isinstance(known, TimeoutError):
                raise known from error
        took_s = time.monotonic() - self._since_s
        why = f"{self.where} loads the policy, for {took_s:.0f} s now (load_s={self._load_s:g})"
        raise PeerError("peer_timeout", why)

    def _ask(self, fields: dict[str, Any], *, begins: bool) -> Any:
        if begins:
            self._call("Ready")
        self._number += 1
        seen = wire.observation(fields, self._number, time.time())
        self._call("SendObservations", wire.observation_parts(seen))
        return wire.read_actions(self._call("GetActions"), self._number)

    def _call(self, name: str, request: Any = b"") -> bytes:
        import grpc

        try:
            return self._method(name)(request, timeout=self.timeout_s)
        except grpc.RpcError as error:
            raise self._as_known(error) from error

    def _method(self, name: str) -> Any:
        assert self._channel is not None
        in_parts = name == "SendObservations"
        make = self._channel.stream_unary if in_parts else self._channel.unary_unary
        return make(f"{wire.METHODS}{name}")

    def _as_known(self, error: Any) -> Exception:
        import grpc

        code = getattr(error, "code", lambda: None)()
        if code is grpc.StatusCode.DEADLINE_EXCEEDED:
            return TimeoutError()
        said = str(getattr(error, "details", lambda: None)() or error)[:400]
        if code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED, None):
            return PeerError("peer_gone", f"no connection to {self.where}: {said}")
        if code is grpc.StatusCode.RESOURCE_EXHAUSTED:
            return PeerError("peer_reply", f"the answer is too large: {said}")
        return PeerError("peer_error", f"the server says {code.name}: {said}")

    def _lose(self) -> None:
        # gRPC gives each request a stream of its own, and answers carry numbers; a new connection
        # would have the server load the policy again.
        pass

    def close(self) -> None:
        """Close the connection."""
        super().close()
        channel, self._channel, self._loading = self._channel, None, None
        if channel is not None:
            channel.close()
