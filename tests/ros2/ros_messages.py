"""ROS 2 types as a DDS participant has them, for `cyclonedds.idl`: a second opinion on layouts.

The layouts are written down from the message files, not taken from what is tested. Requests and
replies begin with what rmw_cyclonedds puts before them: who asked, and which question it was.
"""

# cyclonedds cannot resolve annotations that are strings: no `from __future__ import annotations`.

import struct
from dataclasses import dataclass, field
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int8, int32, int64, sequence, uint8, uint32, uint64

CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


# -- builtin_interfaces, std_msgs ---------------------------------------------------------------
@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32 = 0
    nanosec: uint32 = 0

    @classmethod
    def of(cls, ns: int) -> "Time":
        return cls(ns // 1_000_000_000, ns % 1_000_000_000)

    @property
    def ns(self) -> int:
        return self.sec * 1_000_000_000 + self.nanosec


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class String(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    data: str = ""


@dataclass
class Empty(IdlStruct, typename="std_msgs.msg.dds_.Empty_"):
    structure_needs_at_least_one_member: uint8 = 0


@dataclass
class Bool(IdlStruct, typename="std_msgs.msg.dds_.Bool_"):
    data: bool = False


# -- sensor_msgs --------------------------------------------------------------------------------
@dataclass
class JointState(IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Image(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    """`data` may be bytes: a list of a million integers takes cyclonedds 26 ms."""

    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]

    def serialize(
        self, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None
    ) -> bytes:
        if not isinstance(self.data, bytes):
            return super().serialize(buffer, endianness, use_version_2)
        stamp = self.header.stamp
        out = bytearray(struct.pack("<iI", stamp.sec, stamp.nanosec))
        _put_string(out, self.header.frame_id)
        _align(out)
        out += struct.pack("<II", self.height, self.width)
        _put_string(out, self.encoding)
        out.append(self.is_bigendian)
        _align(out)
        out += struct.pack("<II", self.step, len(self.data))
        return CDR_LITTLE_ENDIAN + bytes(out) + self.data


def _put_string(out: bytearray, text: str) -> None:
    _align(out)
    raw = text.encode() + b"\x00"
    out += struct.pack("<I", len(raw)) + raw


def _align(out: bytearray) -> None:
    out += bytes(-len(out) % 4)


# -- geometry_msgs, multi_mode_control_msgs -----------------------------------------------------
@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class CartesianImpedanceGoal(
    IdlStruct, typename="multi_mode_control_msgs.msg.dds_.CartesianImpedanceGoal_"
):
    pose: Pose
    q_n: array[float64, 7]


# -- services -----------------------------------------------------------------------------------
@dataclass
class SetBoolRequest(IdlStruct, typename="std_srvs.srv.dds_.SetBool_Request_"):
    client: uint64
    number: int64
    data: bool


@dataclass
class SetBoolResponse(IdlStruct, typename="std_srvs.srv.dds_.SetBool_Response_"):
    client: uint64
    number: int64
    success: bool
    message: str


@dataclass
class TriggerRequest(IdlStruct, typename="std_srvs.srv.dds_.Trigger_Request_"):
    client: uint64
    number: int64
    structure_needs_at_least_one_member: uint8 = 0


@dataclass
class TriggerResponse(IdlStruct, typename="std_srvs.srv.dds_.Trigger_Response_"):
    client: uint64
    number: int64
    success: bool
    message: str


@dataclass
class SetPromptRequest(IdlStruct, typename="vla_msgs.srv.dds_.SetPrompt_Request_"):
    client: uint64
    number: int64
    prompt: str


@dataclass
class SetPromptResponse(IdlStruct, typename="vla_msgs.srv.dds_.SetPrompt_Response_"):
    client: uint64
    number: int64
    success: bool
    message: str


@dataclass
class SetRequestRequest(IdlStruct, typename="vla_msgs.srv.dds_.SetRequest_Request_"):
    client: uint64
    number: int64
    prompt: str
    worker: str
    rate_hz: float64
    active: bool


@dataclass
class SetRequestResponse(IdlStruct, typename="vla_msgs.srv.dds_.SetRequest_Response_"):
    client: uint64
    number: int64
    success: bool
    message: str


# -- actions: franka_msgs/action/Move and what every action has ---------------------------------
@dataclass
class Uuid(IdlStruct, typename="unique_identifier_msgs.msg.dds_.UUID_"):
    uuid: array[uint8, 16]


@dataclass
class MoveGoal(IdlStruct, typename="franka_msgs.action.dds_.Move_Goal_"):
    width: float64
    speed: float64


@dataclass
class MoveResult(IdlStruct, typename="franka_msgs.action.dds_.Move_Result_"):
    success: bool
    error: str


@dataclass
class MoveFeedback(IdlStruct, typename="franka_msgs.action.dds_.Move_Feedback_"):
    current_width: float64


@dataclass
class MoveSendGoalRequest(IdlStruct, typename="franka_msgs.action.dds_.Move_SendGoal_Request_"):
    client: uint64
    number: int64
    goal_id: Uuid
    goal: MoveGoal


@dataclass
class MoveSendGoalResponse(IdlStruct, typename="franka_msgs.action.dds_.Move_SendGoal_Response_"):
    client: uint64
    number: int64
    accepted: bool
    stamp: Time


@dataclass
class MoveGetResultRequest(IdlStruct, typename="franka_msgs.action.dds_.Move_GetResult_Request_"):
    client: uint64
    number: int64
    goal_id: Uuid


@dataclass
class MoveGetResultResponse(IdlStruct, typename="franka_msgs.action.dds_.Move_GetResult_Response_"):
    client: uint64
    number: int64
    status: int8
    result: MoveResult


@dataclass
class MoveFeedbackMessage(IdlStruct, typename="franka_msgs.action.dds_.Move_FeedbackMessage_"):
    goal_id: Uuid
    feedback: MoveFeedback


@dataclass
class GoalInfo(IdlStruct, typename="action_msgs.msg.dds_.GoalInfo_"):
    goal_id: Uuid
    stamp: Time


@dataclass
class GoalStatus(IdlStruct, typename="action_msgs.msg.dds_.GoalStatus_"):
    goal_info: GoalInfo
    status: int8


@dataclass
class GoalStatusArray(IdlStruct, typename="action_msgs.msg.dds_.GoalStatusArray_"):
    status_list: sequence[GoalStatus]


@dataclass
class CancelGoalRequest(IdlStruct, typename="action_msgs.srv.dds_.CancelGoal_Request_"):
    client: uint64
    number: int64
    goal_info: GoalInfo


@dataclass
class CancelGoalResponse(IdlStruct, typename="action_msgs.srv.dds_.CancelGoal_Response_"):
    client: uint64
    number: int64
    return_code: int8
    goals_canceling: sequence[GoalInfo]


# -- rmw_dds_common: which DDS entities make up which node --------------------------------------
@dataclass
class Gid(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    node_namespace: str
    node_name: str
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(
    IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"
):
    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]
