"""Files of a simulated flight, in the formats that a real one has.

Numbers are written with enough digits that reading them back costs less than 0.01 mm at 10 m.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float

Int64 = NDArray[np.int64]

_BOX_MARGIN = 0.15  # of the keypoints' extent, as a person detector's box is larger than the joints


class Sighting(NamedTuple):
    """One person over all frames of one camera."""

    track: int  # the tracker's id of the person
    xy: Float  # [T, J, 2] px, NaN where missed
    confidence: Float  # [T, J]


def write_tum(path: Path, t_ns: Int64, position: Float, quaternion_xyzw: Float) -> None:
    """Write poses [N] as `t x y z qx qy qz qw`, t in seconds to the nanosecond."""
    lines = ["# t x y z qx qy qz qw"]
    for stamp, xyz, xyzw in zip(t_ns.tolist(), position.tolist(), quaternion_xyzw.tolist(), strict=True):
        numbers = [*(f"{v:.6f}" for v in xyz), *(f"{v:.9f}" for v in xyzw)]
        seconds, rest = divmod(abs(stamp), 10**9)
        lines.append(" ".join([f"{'-' if stamp < 0 else ''}{seconds}.{rest:09d}", *numbers]))
    write_lines(path, lines)


def write_joints(path: Path, t_ns: Int64, names: tuple[str, ...], joints: Float) -> None:
    """Write joints [T, J, 3] of one person as a long CSV: t_ns, joint, x, y, z in metres, z up."""
    lines = ["t_ns,joint,x,y,z"]
    for stamp, points in zip(t_ns.tolist(), joints.tolist(), strict=True):
        lines += [f"{stamp},{n},{x:.6f},{y:.6f},{z:.6f}" for n, (x, y, z) in zip(names, points, strict=True)]
    write_lines(path, lines)


def write_people(path: Path, t_ns: Int64, names: tuple[str, ...], people: Sequence[Float]) -> None:
    """Joints [T, J, 3] of several people as a long CSV like that of one, with `person` 0, 1, ...."""
    lines = ["t_ns,person,joint,x,y,z"]
    for row, stamp in enumerate(t_ns.tolist()):
        for person, joints in enumerate(people):
            lines += [
                f"{stamp},{person},{n},{x:.6f},{y:.6f},{z:.6f}"
                for n, (x, y, z) in zip(names, joints[row].tolist(), strict=True)
            ]
    write_lines(path, lines)


def write_alphapose(path: Path, people: Iterable[Sighting]) -> None:
    """Write keypoints as AlphaPose does with its tracker: a list of people, picture by picture.

    Frame k is picture `00000k.jpg`. Joints that were missed are 0, 0, 0; frames in which all of a person's
    joints were missed have no entry. Within a picture people keep the given order.
    """
    entries = [
        (frame, _alphapose_entry(frame, person)) for person in people for frame in _frames_with(person)
    ]
    entries.sort(key=lambda pair: pair[0])
    write_lines(path, ["[", ",\n".join(json.dumps(e, separators=(",", ":")) for _, e in entries), "]"])


def _frames_with(person: Sighting) -> list[int]:
    frames: list[int] = np.flatnonzero(np.isfinite(person.xy).all(axis=-1).any(axis=-1)).tolist()
    return frames


def _alphapose_entry(frame: int, person: Sighting) -> dict[str, object]:
    xy, confidence = person.xy[frame], person.confidence[frame]
    keypoints = np.nan_to_num(np.concatenate([xy, confidence[:, None]], axis=1), nan=0.0)
    low, high = np.nanmin(xy, axis=0), np.nanmax(xy, axis=0)
    low, size = low - _BOX_MARGIN * (high - low), (1 + 2 * _BOX_MARGIN) * (high - low)
    return {
        "image_id": f"{frame:06d}.jpg",
        "category_id": 1,
        "keypoints": [round(v, 3) for v in keypoints.ravel().tolist()],
        # AlphaPose adds the mean and the best keypoint score to the box's own (here 1).
        "score": round(1.0 + float(confidence.mean() + 1.25 * confidence.max()), 3),
        "box": [round(v, 1) for v in (*low.tolist(), *size.tolist())],
        "idx": person.track,
    }


def write_lines(path: Path, lines: list[str]) -> None:
    """Write lines of text that end as on Linux, on every system."""
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
