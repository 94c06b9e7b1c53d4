# /// script
# requires-python = ">=3.11"
# dependencies = ["numpy"]
# ///
"""A model: lifts the arm while the prompt contains "lift".

vla-zenoh check examples/ten_line_model.py
vla-zenoh worker examples/ten_line_model.py      # beside `vla-zenoh up panda_sim`
vla-zenoh use lift && vla-zenoh prompt "lift" && vla-zenoh activate
"""

from vla_zenoh.policy import ActionSpec, ActionSteps, CameraSpec, ModelSpec, ObservationSpec


class Lift:
    """Goes up by 1 cm a step; looks at the camera only to show how."""

    spec = ModelSpec(
        name="lift",
        observation=ObservationSpec(
            cameras=(CameraSpec(camera="front", width=224, height=224, resize="pad"),)
        ),
        action=ActionSpec(horizon=1, dt_s=0.2, frame="base", rotation="rpy", gripper="none"),
    )

    def infer(self, observation):
        bright = observation.images["front"].mean() > 1.0  # (224, 224, 3) uint8
        up_m = 0.01 if bright and "lift" in observation.prompt else 0.0
        return ActionSteps([[0, 0, up_m, 0, 0, 0]])  # x, y, z in m; roll, pitch, yaw in rad
