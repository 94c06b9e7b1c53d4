"""Draws one small test picture with the OpenGL way named on the command line.

Run by `vla_zenoh.simulation.backend` as a process of its own, since a broken driver can end it.
"""

from __future__ import annotations

import sys

SIZE = 16
SCENE = """
<mujoco>
  <visual><headlight ambient="1 1 1"/></visual>
  <worldbody>
    <camera name="eye" pos="0 0 1"/>
    <geom type="box" size="2 2 0.1" rgba="1 0 0 1"/>
  </worldbody>
</mujoco>
"""


def main() -> None:
    """Exit with 0 when a red box comes out red, else say why on stderr."""
    import mujoco

    from vla_zenoh.simulation.opengl import OpenGlCanvas

    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    canvas = OpenGlCanvas(model, sys.argv[1])
    red, green, _ = canvas.draw(data, "eye", SIZE, SIZE)[SIZE // 2, SIZE // 2].tolist()
    canvas.close()
    if not red > 2 * green:
        sys.exit(f"the test picture has the wrong colour: {red}, {green}")


if __name__ == "__main__":
    main()
