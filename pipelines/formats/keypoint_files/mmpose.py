"""Reader of MMPose predictions, as its inferencer and its demos save them, for a video or for pictures.

People are `{"keypoints": [[x, y], ...], "keypoint_scores": [...], "bbox": ...}`. They come as

* one file for a video, a list of `{"frame_id": n, "instances": [people]}` (the inferencer counts from 0, the
  top-down demo from 1: `first_frame: 1`),
* a list of people for one picture, or a folder of such files; the frame is the last digits of the name,
* either of these under `instance_info`, beside `meta_info` with the joint names (the demos).
"""

from pathlib import Path

import numpy as np

from pipelines.formats.keypoint_files.keypoint_people import (
    Gathering,
    KeypointFile,
    first_entry,
    frame_number,
    numbers,
    objects,
    samples,
)
from pipelines.session.errors import DataError


class MMPose(KeypointFile):
    """Reader of a file of MMPose predictions, or of a folder with one file for every picture."""

    name = "mmpose"
    title = "MMPose keypoints"

    def recognises(self, path: Path) -> bool:
        """Return True if a file, or some files across a folder, hold MMPose's frames or people."""
        return any(_is_prediction(sample) for sample in samples(path))

    def gather(self, people: Gathering) -> None:
        """Add every person, file by file; the last joint names that a file states count."""
        for file, content in people.contents():
            people.joint_names = _read_file(file, content, people) or people.joint_names


def _is_prediction(sample: object) -> bool:
    if isinstance(sample, dict):
        return "instance_info" in sample
    keys = first_entry(sample).keys()
    return {"frame_id", "instances"} <= keys or {"keypoints", "keypoint_scores"} <= keys


def _read_file(file: Path, content: object, people: Gathering) -> tuple[str, ...] | None:
    """Add the people of one file; return the joint names if it states them."""
    names = None
    if isinstance(content, dict):
        names = _joint_names(content.get("meta_info"))
        content = content.get("instance_info")
    if not isinstance(content, list):
        people.dropped["file without predictions"] += 1
    elif "instances" in first_entry(content):
        for where, entry in objects(content, file, "frames"):
            frame = people.frame_of(entry.get("frame_id"), where, file)
            _add_people(frame, entry.get("instances"), where, people)
    elif frame_number(file.stem) is None and file == people.path:  # the predictions of one picture
        _add_people(people.frame_of(0, str(file)), content, str(file), people)
    elif frame_number(file.stem) is None:
        people.dropped["file without a frame number"] += 1
    else:
        _add_people(people.frame_of(file.stem, str(file)), content, str(file), people)
    return names


def _add_people(frame: int, instances: object, where: str, people: Gathering) -> None:
    for rank, (who, person) in enumerate(objects(instances, where, "instances")):
        points = numbers(person.get("keypoints"), who)
        scores = numbers(person.get("keypoint_scores"), who)
        if points.ndim != 2 or points.shape[1] != 2 or scores.shape != points.shape[:1]:
            shapes = f"{list(points.shape)} and {list(scores.shape)}"
            problem = f"keypoints and keypoint_scores are of shape {shapes}, not [K, 2] and [K]"
            raise DataError(who, problem, "save 2D predictions")
        people.add(frame, np.column_stack([points, scores]), who, rank=rank)


def _joint_names(meta: object) -> tuple[str, ...] | None:
    """Return the joints in order, from the data set's `keypoint_id2name`; None without it."""
    by_id = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
    if not isinstance(by_id, dict):
        return None
    return tuple(str(by_id.get(str(index))) for index in range(len(by_id)))


FORMAT = MMPose()
