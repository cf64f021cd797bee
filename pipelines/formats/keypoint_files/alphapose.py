"""AlphaPose results: one JSON list with an entry for every person in every picture.

An entry is `{"image_id": "12.jpg", "category_id": 1, "keypoints": [x, y, score, ...], "score": s,
"box": [...], "idx": n}`. The frame is the last digits of `image_id`. `idx` is the tracker's id of the person:
a number, `[n]`, or `[[n], [m]]` if AlphaPose merged poses (the first is used). Without its tracker
AlphaPose writes 0 for everybody; then people are numbered by their position within the frame.
"""

from pathlib import Path

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
from pipelines.session.errors import DataError


class AlphaPose(KeypointFile):
    """Reader of AlphaPose's `alphapose-results.json`, old and new."""

    name = "alphapose"
    title = "AlphaPose keypoints"

    def recognises(self, path: Path) -> bool:
        """Return True for a list of results that name pictures, or have AlphaPose's `box` or `idx`."""
        return path.is_file() and any(is_alphapose_entry(first_entry(s)) for s in samples(path))

    def gather(self, people: Gathering) -> None:
        """Add every person, with the tracker's id."""
        for where, entry in objects(load_json(people.path), people.path, "results"):
            frame = people.frame_of(entry.get("image_id"), where)
            if "keypoints" not in entry:
                raise DataError(where, "has no keypoints", "check the file's format")
            people.add(frame, triples(entry["keypoints"], where), where, own_id=_track(entry.get("idx")))


def _track(idx: object) -> int | None:
    while isinstance(idx, list) and idx:
        idx = idx[0]
    return whole_number(idx)


FORMAT = AlphaPose()
