"""Recording with known numbers, for the tests of exports."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pipelines.geometry.arrays import Intrinsics
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.session.records import JointMotion, Occupancy, Recording, Trajectory
from tests.synthetic.walk import COCO17, walk

START_NS = 1_700_000_000_000_000_000
FPS = 30
LENS = Intrinsics(1280, 720, 762.0, 763.0, 641.0, 358.0, "radtan", (-0.031, 0.012, 0.0004, -0.0003))
SIGMA_M = (0.01, 0.02, 0.03)  # of every joint, along the world's axes
LOOKING_NORTH = quaternion_from_matrix(np.array([[[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]]))[0]
VOXEL_M = 0.5


class Listener:
    """Progress that keeps its notes."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def start(self, _: str, __: int) -> None:
        """Ignore the call."""

    def advance(self, _: int = 1) -> None:
        """Ignore the call."""

    def note(self, message: str) -> None:
        self.notes.append(message)


def stamps(count: int) -> NDArray[np.int64]:
    return START_NS + np.rint(np.arange(count) * 1e9 / FPS).astype(np.int64)


def walking(count: int = 60) -> JointMotion:
    """Make one person who walks; bones are rigid, nothing is missing."""
    position = walk(np.arange(count) / FPS, radius_m=4.0)[:, None]
    covariance = np.zeros((*position.shape[:3], 6))
    covariance[..., [0, 3, 5]] = np.square(SIGMA_M)
    return JointMotion(
        stamps(count),
        COCO17,
        position,
        status=np.full(position.shape[:3], "ok"),
        reprojection_px=np.ones(position.shape[:3]),
        views=np.full(position.shape[:3], 2),
        covariance=covariance,
    )


def without(motion: JointMotion, joint: str, rows: slice | list[int]) -> JointMotion:
    """Remove a joint from the motion at some times, in place; return the motion."""
    motion.position[rows, :, motion.joints.index(joint)] = np.nan
    return motion


def flown(count: int = 60) -> Trajectory:
    """Make a camera that looks north and moves east at 1 m/s, 4 m above the origin."""
    t_ns = stamps(count)
    position = np.stack([(t_ns - START_NS) / 1e9, np.full(count, -8.0), np.full(count, 4.0)], axis=1)
    return Trajectory(t_ns, position, np.tile(LOOKING_NORTH, (count, 1)))


def block() -> Occupancy:
    """Make a solid block of 3 x 3 x 3 voxels: all but the innermost are its surface."""
    probability = np.full((5, 5, 5), 0.1, np.float32)
    probability[1:4, 1:4, 1:4] = 0.9
    return Occupancy(probability, np.array([10.0, 20.0, 0.0]), VOXEL_M)


def picture(level: int) -> NDArray[np.uint8]:
    return np.full((LENS.height, LENS.width, 3), level, np.uint8)


def recording(count: int = 60, progress: Listener | None = None) -> Recording:
    """Make one camera (with a hyphen), pictures every half second, a map, and no left wrist in frame 7."""
    t_ns = stamps(count)
    stills = [(int(t_ns[row]), picture(40 + row)) for row in range(0, count, FPS // 2)]
    return Recording(
        "Mound <walk>",
        without(walking(count), "left_wrist", [7]),
        {"cam-1": flown(count)},
        lenses={"cam-1": LENS},
        maps=lambda: [block()],
        pictures=lambda _: stills,
        overlays=lambda _: stills,
        progress=progress or Listener(),
    )


def angles_of_two() -> pd.DataFrame:
    """Make a table of angles: two people at the first time, one at the second; one angle is missing."""
    return pd.DataFrame(
        {
            "t_ns": stamps(2)[[0, 0, 0, 1]],
            "person": [0, 0, 1, 0],
            "angle": ["left_knee_flexion", "left_hip_flexion", "left_knee_flexion", "left_knee_flexion"],
            "value_deg": [180.0, np.nan, 90.0, 60.0],
            "sigma_deg": [18.0, np.nan, 9.0, np.nan],
            "status": ["ok", "missing", "ok", "ok"],
        }
    )
