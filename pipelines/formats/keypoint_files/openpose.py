"""Reader of OpenPose keypoints: a folder with one JSON file for every frame.

A file is `{"version": 1.3, "people": [{"person_id": [-1], "pose_keypoints_2d": [x, y, confidence, ...]}]}`.
Its frame is the last digits of its name (`input_000000000012_keypoints.json`, `cam01.0012.json`). Joints
that were not found are 0, 0, 0. Pose2Sim writes the same files for every detector it runs (25, 17 or 26
keypoints). It writes `{}` for a person who was not seen, so that `people[0]` stays the same person. So the
position in the list is the person's number, unless OpenPose tracked people and gives `person_id`s.
"""

from pathlib import Path

import numpy as np

from pipelines.formats.keypoint_files.keypoint_people import (
    Gathering,
    KeypointFile,
    frame_number,
    objects,
    samples,
    triples,
    whole_number,
)
from pipelines.geometry.arrays import Float
from pipelines.session.skeletons import SKELETONS


class OpenPose(KeypointFile):
    """Reader of a folder of OpenPose JSON files, or of one of them."""

    name = "openpose"
    title = "OpenPose keypoints"

    def recognises(self, path: Path) -> bool:
        """Return True if a file, or some files across a folder, are objects with a list `people`."""
        return any(_is_frame(sample) for sample in samples(path))

    def gather(self, people: Gathering) -> None:
        """Add every person, file by file; skip and count files that are no frames."""
        for file, content in people.contents():
            _read_frame(file, content, people)
        if people.count() == len(SKELETONS["body25"].joints):
            people.joint_names = SKELETONS[_order_of_25(people.keypoints())].joints


def _is_frame(content: object) -> bool:
    return isinstance(content, dict) and isinstance(content.get("people"), list)


def _read_frame(file: Path, content: object, people: Gathering) -> None:
    """Add the people of one file; count the file instead if it is no frame."""
    name = file.stem.removesuffix("_keypoints")
    if frame_number(name) is None:
        people.dropped["file without a frame number"] += 1
        return
    if not isinstance(content, dict) or not _is_frame(content):
        people.dropped["file without a list of people"] += 1
        return
    frame = people.frame_of(name, str(file))
    for rank, (where, person) in enumerate(objects(content["people"], file, "people")):
        if person.get("pose_keypoints_2d"):
            rows = triples(person["pose_keypoints_2d"], where)
            people.add(frame, rows, where, rank=rank, own_id=_track(person.get("person_id")))


def _track(person_id: object) -> int | None:
    number = whole_number(person_id[0]) if isinstance(person_id, list) and person_id else None
    return number if number is not None and number >= 0 else None


def _order_of_25(keypoints: Float) -> str:
    """Distinguish BODY_25 from BODY_25B, which has the same number of keypoints in another order."""
    xy = np.where(keypoints[..., 2:] > 0, keypoints[..., :2], np.nan)
    joints = SKELETONS["body25"].joints
    hip, left, right = (xy[:, joints.index(joint)] for joint in ("hip", "left_hip", "right_hip"))
    tested = np.isfinite(hip + left + right).all(axis=1)
    if not tested.any():
        return "body25"
    extent = np.nanmax(xy[tested], axis=1) - np.nanmin(xy[tested], axis=1)
    distance = np.linalg.norm(hip - (left + right) / 2, axis=1)[tested]
    midpoint = np.median(distance) <= 0.05 * np.median(extent.max(axis=1))
    return "body25" if midpoint else "body25b"


FORMAT = OpenPose()
