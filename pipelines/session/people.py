"""Skeletons, and positions of people that are known without a reconstruction: logged actors and true joints.

All skeletons share joint names. Detectors place some of these joints at slightly different points: `neck` is
the midpoint of the shoulders in body25, and lies 3 % of the body's height above it in body25b; `hip` is the
midpoint of the hips; BlazePose's `foot_index`, the tip of the foot, is called `big_toe`.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import interpolate_points
from pipelines.session.description import Description
from pipelines.session.errors import DataError
from pipelines.session.records import JointMotion
from pipelines.session.storage import own_table
from pipelines.session.tables import ACTOR, read_table

Bone = tuple[str, str]


@dataclass(frozen=True)
class Skeleton:
    """The joints of one detector in the order of its files, and the bones between them."""

    name: str
    joints: tuple[str, ...]
    bones: tuple[Bone, ...]


DERIVED: tuple[tuple[str, tuple[str, str]], ...] = (
    ("neck", ("left_shoulder", "right_shoulder")),
    ("hip", ("left_hip", "right_hip")),
)
"""Joints that are computed if a skeleton lacks them: each is the midpoint of its two parents."""


def side_of(*joints: str) -> str:
    """Return `left` or `right` if all joints lie on that side of the body, else an empty word."""
    sides = {joint.partition("_")[0] for joint in joints}
    return side if len(sides) == 1 and (side := sides.pop()) in {"left", "right"} else ""


def mirrored(joint: str) -> str:
    """Return the joint on the other side of the body; a joint of the middle is its own mirror."""
    if joint.startswith("left_"):
        return "right_" + joint.removeprefix("left_")
    if joint.startswith("right_"):
        return "left_" + joint.removeprefix("right_")
    return joint


_TABLES: dict[str, dict[str, Any]] = own_table(__file__, "skeletons")
_LEFT_BONES, _MIDDLE_BONES = (tuple(map(tuple, _TABLES["bones"][part])) for part in ("left", "middle"))
_ALL_BONES = (*_MIDDLE_BONES, *_LEFT_BONES, *((mirrored(a), mirrored(b)) for a, b in _LEFT_BONES))


def bones_of(joints: tuple[str, ...]) -> tuple[Bone, ...]:
    """Return the bones whose two ends are among `joints`, for drawing and for bone lengths."""
    there = set(joints)
    return tuple(bone for bone in _ALL_BONES if there.issuperset(bone))


SKELETONS: dict[str, Skeleton] = {
    name: Skeleton(name, tuple(joints), bones_of(tuple(joints))) for name, joints in _TABLES["joints"].items()
}
"""Every skeleton by the name that `flight.yaml` uses; of two with equal counts the likelier comes first."""


_ALSO_CALLED = {
    **dict.fromkeys(("midhip", "chip", "hipcenter", "pelvis"), "hip"),
    **{f"{way}footindex": f"{side}_big_toe" for side in ("left", "right") for way in (side, side[0])},
}


def _ways_to_write(joint: str) -> list[str]:
    side, _, part = joint.partition("_")
    part = part.replace("_", "")
    if side not in {"left", "right"}:
        return [joint.replace("_", "")]
    return [f"{side}{part}", f"{side[0]}{part}", f"{part}{side}", f"{part}{side[0]}"]


_CALLED = _ALSO_CALLED | {
    way: joint for each in SKELETONS.values() for joint in each.joints for way in _ways_to_write(joint)
}


def joint_called(name: str) -> str | None:
    """Return the joint that a program calls so: RBigToe, right_big_toe and BigToe_R are right_big_toe."""
    return _CALLED.get(re.sub(r"[^a-z0-9]", "", name.lower()))


def get_skeleton(name: str) -> Skeleton:
    """Return the skeleton of a name; DataError with those there are if it is none of them."""
    if name not in SKELETONS:
        raise DataError(name, "no such skeleton", f"there are {', '.join(SKELETONS)}", code="no-such-name")
    return SKELETONS[name]


def skeleton_with(count: int) -> tuple[Skeleton, ...]:
    """Return the skeletons of `count` keypoints, the likelier first: for 25, body25 before body25b."""
    return tuple(skeleton for skeleton in SKELETONS.values() if len(skeleton.joints) == count)


def take_joints(values: Float, joints: tuple[str, ...], wanted: tuple[str, ...]) -> Float:
    """Select the `wanted` joints of [..., J, D], in their order; NaN for absent ones."""
    column = {joint: index for index, joint in enumerate(joints)}
    source = np.array([column.get(joint, -1) for joint in wanted], dtype=np.int64)
    return np.where((source < 0)[:, None], np.nan, values[..., source, :])


def with_derived(joints: tuple[str, ...], position: Float) -> tuple[tuple[str, ...], Float]:
    """Append the joints of `DERIVED` whose parents are there to positions [..., J, D]; NaN as a parent."""
    for joint, parents in DERIVED:
        if joint in joints or not set(parents).issubset(joints):
            continue
        middle = take_joints(position, joints, parents).mean(axis=-2, keepdims=True)
        joints = (*joints, joint)
        position = np.concatenate([position, middle], axis=-2)
    return joints, position


# A person who walks is up to 3 m away after a longer gap, and a line says nothing of the way.
MAX_GAP_OF_ACTOR_NS = 2_000_000_000


@dataclass(frozen=True)
class LoggedActor:
    """The actor's hips over time; from a logged head or feet, those of a standing person of 1.75 m."""

    t_ns: Int64  # [A] ascending
    hips: Float  # [A, 3] m, world

    def hips_at(self, t_ns: Int64) -> Float:
        """Interpolate the hips [T, 3] at given times; NaN where no logged position is near enough."""
        return interpolate_points(self.t_ns, self.hips, t_ns, max_gap_ns=MAX_GAP_OF_ACTOR_NS)


def logged_actor(folder: Path, description: Description) -> LoggedActor | None:
    """Load the first logged person of a session; None where nobody was logged."""
    return next(iter(logged_people(folder, description)), None)


def logged_people(folder: Path, description: Description) -> list[LoggedActor]:
    """Load all people of a session who were logged: person 0, 1, ... in this order."""
    entries = description.logged_people
    if not entries:
        return []
    table = read_table(folder / "actor.parquet", ACTOR)
    person, t_ns = table["person"].to_numpy(np.int64), table["t_ns"].to_numpy(np.int64)
    place = table[["x", "y", "z"]].to_numpy(np.float64)
    return [
        LoggedActor(t_ns[person == k], place[person == k] + [0.0, 0.0, entry.hip_above_m])
        for k, entry in enumerate(entries)
    ]


# Up to four cameras that take turns give one long step in four, which the percentile must reach.
PERCENTILE_OF_USUAL_STEPS = 80.0
# A missing sample of regular ones makes a step twice as long.
GAP_IN_USUAL_STEPS = 1.5


def true_joints_at(truth: JointMotion, t_ns: Int64) -> Float:
    """Interpolate the truth [T, P, J, 3] linearly; NaN outside, beside missing joints and in long gaps."""
    return interpolate_points(truth.t_ns, truth.position, t_ns, max_gap_ns=longest_step_ns(truth.t_ns))


def longest_step_ns(t_ns: Int64) -> int:
    """Return the longest step between samples that is not a gap; 0 for fewer than two samples."""
    steps = np.diff(t_ns)
    return int(GAP_IN_USUAL_STEPS * np.percentile(steps, PERCENTILE_OF_USUAL_STEPS)) if len(steps) else 0


# Caliscope's files are named by the tracker, which numbers the points of the body so.
_TRACKERS_OF_CALISCOPE = {
    "halpe26": "halpe26",
    "wholebody": "coco23",
    "holistic": "blazepose33",
    "xyz_pose": "blazepose33",
    "xy_pose": "blazepose33",
}


def points_of_caliscope(path: Path) -> dict[str, str]:
    """Return the names of points by their numbers, which depend on the tracker in the file's name."""
    tracker = path.stem.lower()
    skeleton = next((name for word, name in _TRACKERS_OF_CALISCOPE.items() if word in tracker), None)
    if skeleton is None:
        problem = "numbers its points, and its name tells no tracker whose numbers are known"
        raise DataError(path, problem, f"name {path.stem}_labelled.csv beside it", code="no-such-name")
    names = {str(number): joint for number, joint in enumerate(SKELETONS[skeleton].joints)}
    return names | ({"100": "right_wrist", "200": "left_wrist"} if "simple" in tracker else {})
