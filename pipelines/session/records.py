"""What readers hand over and writers take: plain frozen records of numpy arrays.

Conventions (DESIGN): world ENU in metres, camera x right, y down, z forward, stamps int64 ns,
quaternions xyzw, transforms named target_from_source, missing is NaN and never 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.cameras import Intrinsics

Float = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class Trajectory:
    """Poses of one moving thing, as a log states them.

    Rows are sorted by time, stamps strictly increase and every number is finite: readers leave bad
    rows out and count them by cause in `dropped` (for example {"not finite": 3, "duplicate stamp": 1}).
    """

    t_ns: Int64  # [N]
    position: Float  # [N, 3] m
    quaternion_xyzw: Float  # [N, 4] unit, world_from_body
    covariance: Float | None = None  # [N, 6, 6] position in world (m^2), then rotation vector in body (rad^2)
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibratedCamera:
    """One camera of a calibration file; either part may be absent from the file."""

    intrinsics: Intrinsics | None
    position: Float | None = None  # [3] m, world_from_camera
    quaternion_xyzw: Float | None = None  # [4] unit, world_from_camera


@dataclass(frozen=True)
class Detections:
    """People that a keypoint detector found in one camera's frames, sorted by frame, then person.

    A joint that was not found has NaN in `xy` and 0 confidence. `person` is the detector's own id, or
    the rank within the frame where it has none. `image_size` is what the file itself states, if it does.
    """

    joints: tuple[str, ...]
    frame: Int64  # [M]
    person: Int64  # [M]
    xy: Float  # [M, J, 2] px, the centre of the top left pixel is (0, 0)
    confidence: Float  # [M, J] 0..1 where the detector says so
    frames_listed: Int64  # [F] sorted: every frame the files speak of, people in it or not
    image_size: tuple[int, int] | None = None  # width, height
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class JointMotion:
    """3D joints of one or more people over time: truth, or a skeleton to export.

    `t_ns` strictly increases. NaN marks a joint that is missing at that time.
    """

    t_ns: Int64  # [T]
    joints: tuple[str, ...]
    position: Float  # [T, P, J, 3] m, world
    status: NDArray[np.str_] | None = None  # [T, P, J] words of tables.STATUS, where they are known
    reprojection_px: Float | None = None  # [T, P, J]


@dataclass(frozen=True)
class Recording:
    """Everything an export may need: the skeleton and the cameras' poses that it was made with."""

    name: str
    motion: JointMotion | None
    cameras: dict[str, Trajectory]
