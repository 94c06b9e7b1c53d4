"""Publishes the inputs and outputs of inferences for debugging."""

from __future__ import annotations

import numpy as np
import zenoh
from numpy.typing import NDArray

from vla_zenoh.bus.node import Node
from vla_zenoh.codec.image import depth_schema, encode_depth, encode_jpeg
from vla_zenoh.errors import CodecError, RecordError
from vla_zenoh.keys import Kind
from vla_zenoh.policy import ActionSteps, ModelSpec, Observation
from vla_zenoh.types import Depth, Header, Image, InferenceDebug
from vla_zenoh.types.commands import plain_values

JPEG_QUALITY = 95


class InferenceDebugPublisher:
    """Publishes observation and answer of each inference, while there are subscribers.

    It runs after the chunk was published, so it never delays one.
    """

    def __init__(self, node: Node, worker: str, spec: ModelSpec) -> None:
        self._node, self._worker, self._spec = node, worker, spec
        keys = node.keys
        # One priority for all: the images arrive before the record.
        self._record = node.declare_publisher(keys.seen_record(worker), Kind.FRAME)
        self._images = {
            camera.camera: node.declare_publisher(keys.seen(worker, camera.camera), Kind.FRAME)
            for camera in spec.observation.cameras
        }
        self._depths = {
            one.camera: node.declare_publisher(keys.seen_depth(worker, one.camera), Kind.FRAME)
            for one in spec.observation.depth
        }

    def publish(
        self,
        observation: Observation,
        answer: ActionSteps,
        steps: NDArray[np.float32],
        chunk: Header,
        inference_ms: float,
    ) -> None:
        """Publish one inference: its validated steps (H, D), and the header of its chunk."""
        stamp_ns, seq = observation.stamp_wall_ns, chunk.seq
        try:
            for camera in self._spec.observation.cameras:
                stream = self._images[camera.camera]
                if stream.has_subscribers:
                    rgb = self._rgb(camera.camera, camera.colour, observation, answer)
                    stream.publish(
                        encode_jpeg(Image(rgb), JPEG_QUALITY),
                        stamp_wall_ns=stamp_ns,
                        seq=seq,
                        encoding=zenoh.Encoding.IMAGE_JPEG,
                    )
            for wanted in self._spec.observation.depth:
                stream = self._depths[wanted.camera]
                if stream.has_subscribers:
                    depth = Depth(observation.depth[wanted.camera], wanted.unit_m)
                    stream.publish(
                        encode_depth(depth),
                        stamp_wall_ns=stamp_ns,
                        seq=seq,
                        encoding=zenoh.Encoding.IMAGE_PNG.with_schema(depth_schema(depth)),
                    )
            if self._record.has_subscribers:
                seen = InferenceDebug(
                    self._worker,
                    seq,
                    self._spec.hash,
                    observation.task.episode,
                    stamp_ns,
                    observation.prompt,
                    steps,
                    inference_ms,
                    plain_values(answer.raw),
                    bool(answer.done),
                )
                self._record.publish(seen, stamp_wall_ns=stamp_ns, seq=seq)
        except (RecordError, CodecError) as error:
            self._node.reject("seen", f"the inference cannot be published: {error}")

    @staticmethod
    def _rgb(
        camera: str, colour: str, observation: Observation, answer: ActionSteps
    ) -> NDArray[np.uint8]:
        own = (answer.pictures or {}).get(camera)
        if own is not None:
            return np.asarray(own)
        image = observation.images[camera]
        return np.ascontiguousarray(image[..., ::-1]) if colour == "bgr" else image
