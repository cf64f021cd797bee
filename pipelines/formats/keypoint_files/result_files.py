"""Keypoints as OpenPose, AlphaPose, MMPose and programs with COCO's results write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.formats.keypoint_files.keypoint_people import (
    Gathering,
    KeypointFile,
    changing_digits,
    first_entry,
    frame_number,
    is_alphapose_entry,
    json_files,
    load_json,
    numbers,
    objects,
    samples,
    triples,
    whole_number,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError
from pipelines.session.people import SKELETONS


class OpenPose(KeypointFile):
    """Reader of a folder of OpenPose JSON files, or of one of them."""

    name = "openpose"
    title = "OpenPose keypoints"

    def recognises(self, path: Path) -> bool:
        """Return True if a file, or some files across a folder, are objects with a list `people`."""
        return any(_is_frame(sample) for sample in samples(path))

    def gather(self, people: Gathering) -> None:
        """Add every person, file by file; skip and count files that are no frames."""
        if people.path.is_dir():
            people.digits = changing_digits([_stem(file) for file in json_files(people.path)])
        for file, content in people.contents():
            _read_frame(file, content, people)
        if people.count() == len(SKELETONS["body25"].joints):
            people.joint_names = SKELETONS[_order_of_25(people.keypoints())].joints


def _is_frame(content: object) -> bool:
    return isinstance(content, dict) and isinstance(content.get("people"), list)


def _read_frame(file: Path, content: object, people: Gathering) -> None:
    """Add the people of one file; count the file instead if it is no frame."""
    name = _stem(file)
    if frame_number(name, people.digits) is None:
        people.dropped["file without a frame number"] += 1
        return
    if not isinstance(content, dict) or not _is_frame(content):
        people.dropped["file without a list of people"] += 1
        return
    frame = people.frame_of(name, str(file))
    for rank, (where, person) in enumerate(objects(content["people"], file, "people")):
        if stated := person.get("pose_keypoints_2d") or person.get("pose_keypoints"):  # the latter until 2018
            rows = triples(stated, where)
            people.add(frame, rows, where, rank=rank, own_id=_openpose_track(person.get("person_id")))


def _stem(file: Path) -> str:
    return file.stem.removesuffix("_keypoints")


def _openpose_track(person_id: object) -> int | None:
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


OPENPOSE = OpenPose()


class AlphaPose(KeypointFile):
    """Reader of AlphaPose's `alphapose-results.json`, old and new, also in its formats `cmu` and `open`."""

    name = "alphapose"
    title = "AlphaPose keypoints"

    def recognises(self, path: Path) -> bool:
        """Return True for a list of results that name pictures, or have AlphaPose's `box` or `idx`."""
        return path.is_file() and any(
            is_alphapose_entry(first_entry(s)) or _is_by_picture(s) for s in samples(path)
        )

    def gather(self, people: Gathering) -> None:
        """Add every person, with the tracker's id."""
        content = load_json(people.path)
        if isinstance(content, dict) and _is_by_picture(content):
            people.digits = changing_digits(content)
            for picture, shown in content.items():
                frame = people.frame_of(picture, str(people.path))
                key = next(key for key in _BY_PICTURE if key in shown)
                for where, person in objects(shown[key], f"{people.path}, {picture}", key):
                    people.add(frame, triples(person.get(_BY_PICTURE[key]), where), where)
            return
        if isinstance(content, list):
            named = {entry.get("image_id") for entry in content if isinstance(entry, dict)}
            people.digits = changing_digits([name for name in named if isinstance(name, str)])
        for where, entry in objects(content, people.path, "results"):
            frame = people.frame_of(entry.get("image_id"), where)
            if "keypoints" not in entry:
                raise DataError(where, "has no keypoints", "check the file's format")
            people.add(
                frame, triples(entry["keypoints"], where), where, own_id=_alphapose_track(entry.get("idx"))
            )


# The list of people of a picture and the keypoints of each, in AlphaPose's formats `open` and `cmu`.
_BY_PICTURE = {"people": "pose_keypoints_2d", "bodies": "joints"}


def _is_by_picture(content: object) -> bool:
    return (
        isinstance(content, dict)
        and bool(content)
        and all(isinstance(shown, dict) and _BY_PICTURE.keys() & shown.keys() for shown in content.values())
    )


def _alphapose_track(idx: object) -> int | None:
    while isinstance(idx, list) and idx:
        idx = idx[0]
    return whole_number(idx)


ALPHAPOSE = AlphaPose()


class Coco(KeypointFile):
    """Reader of COCO keypoint results and annotations."""

    name = "coco"
    title = "COCO keypoints"

    def recognises(self, path: Path) -> bool:
        """Return True for a COCO file, even with boxes only or an empty list; reading reports the fault."""
        return path.is_file() and any(_is_annotations(s) or _is_results(s) for s in samples(path))

    def gather(self, people: Gathering) -> None:
        """Add every person; an annotation file also states the joint names and the picture size."""
        content = load_json(people.path)
        boxes = (
            _add_annotations(content, people) if isinstance(content, dict) else _add_results(content, people)
        )
        if boxes and not len(people):
            raise DataError(
                people.path,
                f"holds boxes only, no keypoints, in all of its {boxes} entries",
                "run a keypoint detector",
            )
        people.dropped["entry without keypoints"] += boxes


def _is_annotations(sample: object) -> bool:
    return isinstance(sample, dict) and {"images", "annotations"} <= sample.keys()


def _is_results(sample: object) -> bool:
    entry = first_entry(sample)
    return sample == [] or (
        {"image_id", "category_id"} <= entry.keys()
        and ("keypoints" in entry or "bbox" in entry)
        and not is_alphapose_entry(entry)
    )


def _add_results(content: object, people: Gathering) -> int:
    """Add the people of a list of results; return the number of entries without keypoints."""
    boxes = 0
    for where, entry in objects(content, people.path, "results"):
        frame = people.frame_of(entry.get("image_id"), where)
        if entry.get("keypoints"):
            people.add(frame, triples(entry["keypoints"], where), where)
        else:
            boxes += 1
    return boxes


def _add_annotations(content: dict[str, object], people: Gathering) -> int:
    """Add the people of an annotation file; return the number of annotations without keypoints."""
    frames: dict[str, int] = {}
    sizes = set()
    for where, image in objects(content.get("images"), people.path, "images"):
        frames[str(image.get("id"))] = people.frame_of(image.get("file_name", image.get("id")), where)
        sizes.add((whole_number(image.get("width")), whole_number(image.get("height"))))
    boxes = 0
    for where, annotation in objects(content.get("annotations"), people.path, "annotations"):
        if not annotation.get("keypoints"):
            boxes += 1
            continue
        image_id = str(annotation.get("image_id"))
        if image_id not in frames:
            raise DataError(
                where, f"its image_id {image_id} is not among the images", "check the images list"
            )
        rows = _with_confidence(triples(annotation["keypoints"], where), where)
        people.add(frames[image_id], rows, where, own_id=whole_number(annotation.get("track_id")))
    people.joint_names = _coco_joint_names(content)
    width, height = sizes.pop() if len(sizes) == 1 else (None, None)
    people.image_size = (width, height) if width and height else None
    return boxes


def _with_confidence(rows: Float, where: str) -> Float:
    """Convert rows of x, y, visibility to x, y, confidence."""
    visibility = rows[:, 2:]
    if not np.isin(visibility, (0, 1, 2)).all():
        raise DataError(
            where, "its third values are not the visibilities 0, 1 and 2", "store it as COCO results"
        )
    return np.hstack([rows[:, :2], visibility / 2])


def _coco_joint_names(content: dict[str, object]) -> tuple[str, ...] | None:
    """Return the first category's keypoint names in this program's spelling of joints; None without names."""
    names = first_entry(content.get("categories")).get("keypoints")
    if not isinstance(names, list):
        return None
    return tuple(str(name).strip().lower().replace(" ", "_") for name in names)


COCO = Coco()


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
        names = _mmpose_joint_names(content.get("meta_info"))
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


def _mmpose_joint_names(meta: object) -> tuple[str, ...] | None:
    """Return the joints in order, from the data set's `keypoint_id2name`; None without it."""
    by_id = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
    if not isinstance(by_id, dict):
        return None
    return tuple(str(by_id.get(str(index))) for index in range(len(by_id)))


MMPOSE = MMPose()
