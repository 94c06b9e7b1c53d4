"""The model contract: what a model declares, its input and its output."""

from vla_zenoh.policy.inference import ActionSteps as ActionSteps
from vla_zenoh.policy.inference import Observation as Observation
from vla_zenoh.policy.inference import Policy as Policy
from vla_zenoh.policy.inference import check_steps as check_steps
from vla_zenoh.policy.inference import reset_of as reset_of
from vla_zenoh.policy.inference import takes_robot as takes_robot
from vla_zenoh.policy.spec import MAX_CAMERAS as MAX_CAMERAS
from vla_zenoh.policy.spec import ROTATION_SIZE as ROTATION_SIZE
from vla_zenoh.policy.spec import ActionSpec as ActionSpec
from vla_zenoh.policy.spec import Anchor as Anchor
from vla_zenoh.policy.spec import CameraSpec as CameraSpec
from vla_zenoh.policy.spec import ControllerSpec as ControllerSpec
from vla_zenoh.policy.spec import DepthSpec as DepthSpec
from vla_zenoh.policy.spec import Frame as Frame
from vla_zenoh.policy.spec import GripperSemantics as GripperSemantics
from vla_zenoh.policy.spec import ModelSpec as ModelSpec
from vla_zenoh.policy.spec import MotionKind as MotionKind
from vla_zenoh.policy.spec import ObservationSpec as ObservationSpec
from vla_zenoh.policy.spec import PartAction as PartAction
from vla_zenoh.policy.spec import RelativeTo as RelativeTo
from vla_zenoh.policy.spec import Resize as Resize
from vla_zenoh.policy.spec import Rotation as Rotation
from vla_zenoh.policy.spec import StatePart as StatePart
