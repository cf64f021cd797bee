"""Foxglove's schemas as dynamic protobuf messages, built as in a reader of MCAP."""

from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory, timestamp_pb2

# By name; without a type `double`. A star means a repeated field, a capital a message.
_MESSAGES = {
    "Vector3": "x y z",
    "Quaternion": "x y z w",
    "Pose": "position:Vector3 orientation:Quaternion",
    "PoseInFrame": "timestamp:Timestamp frame_id:string pose:Pose",
    "FrameTransform": "timestamp:Timestamp parent_frame_id:string child_frame_id:string"
    " translation:Vector3 rotation:Quaternion",
    "FrameTransforms": "transforms:FrameTransform*",
    "CameraCalibration": "timestamp:Timestamp width:fixed32 height:fixed32"
    " distortion_model:string D:double* K:double*",
    "LocationFix": "timestamp:Timestamp frame_id:string latitude longitude altitude"
    " position_covariance:double* position_covariance_type:fixed32",
    "CompressedImage": "timestamp:Timestamp data:bytes format:string",
    "RawImage": "timestamp:Timestamp width:fixed32 height:fixed32 encoding:string step:fixed32 data:bytes",
}


def _field(number: int, name: str, kind: str = "double") -> dict[str, Any]:
    bare = kind.rstrip("*")
    field: dict[str, Any] = {
        "name": name,
        "number": number,
        "label": "LABEL_REPEATED" if kind.endswith("*") else "LABEL_OPTIONAL",
    }
    if bare[0].islower():
        return field | {"type": f"TYPE_{bare.upper()}"}
    package = "google.protobuf" if bare == "Timestamp" else "foxglove"
    return field | {"type": "TYPE_MESSAGE", "typeName": f".{package}.{bare}"}


def _pool() -> descriptor_pool.DescriptorPool:
    described = {
        "name": "foxglove.proto",
        "package": "foxglove",
        "syntax": "proto3",
        "dependency": ["google/protobuf/timestamp.proto"],
        "messageType": [
            {
                "name": name,
                "field": [_field(k, *field.split(":")) for k, field in enumerate(fields.split(), start=1)],
            }
            for name, fields in _MESSAGES.items()
        ],
    }
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    file = json_format.ParseDict(described, descriptor_pb2.FileDescriptorProto())
    pool.AddSerializedFile(file.SerializeToString())
    return pool


_POOL = _pool()


def protobuf(name: str, **fields: Any) -> Any:
    """Make a message by serialising and parsing it; nested ones are given as dicts."""
    kind = message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"foxglove.{name}"))
    return kind.FromString(kind(**fields).SerializeToString())
