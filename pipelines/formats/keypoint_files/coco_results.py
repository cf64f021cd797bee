"""Reader of COCO keypoints: a list of results, or an annotation file.

Results are `[{"image_id": 12, "category_id": 1, "keypoints": [x, y, score, ...], "score": s}, ...]`.
Annotation files are `{"images": [{"id": 3, "file_name": "0012.jpg", "width": 640, "height": 480}],
"annotations": [...]}`. There the frame is the last digits of `file_name` (of the id without one). The
third value is a visibility: 0 is missing, 1 (hidden, but placed) and 2 (seen) become confidence 0.5 and 1.
`track_id` numbers people if every annotation has it. A list with AlphaPose's fields is recognised as
AlphaPose's; `format: coco` reads it too.
"""

from pathlib import Path

import numpy as np

from pipelines.formats.keypoint_files.keypoint_people import (
    Gathering,
    KeypointFile,
    first_entry,
    is_alphapose_entry,
    load_json,
    objects,
    samples,
    triples,
    whole_number,
)
from pipelines.geometry.arrays import Float
from pipelines.session.errors import DataError


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
    people.joint_names = _joint_names(content)
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


def _joint_names(content: dict[str, object]) -> tuple[str, ...] | None:
    """Return the first category's keypoint names in this program's spelling of joints; None without names."""
    names = first_entry(content.get("categories")).get("keypoints")
    if not isinstance(names, list):
        return None
    return tuple(str(name).strip().lower().replace(" ", "_") for name in names)


FORMAT = Coco()
