"""Files of keypoints: careful reading of JSON, and collection of the people in it into Detections."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from pipelines.formats.common.files import read_bytes, read_head
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.session.errors import DataError
from pipelines.session.people import SKELETONS, Skeleton, get_skeleton, joint_called, skeleton_with
from pipelines.session.records import Detections
from pipelines.session.storage import damaged, empty

# Tables of mice share a name or two with people, as nose and left_ear.
LEAST_NAMED_JOINTS = 6
# So many files show the format of a folder, and reading them takes no time.
_SAMPLED_FILES = 8
# Frame numbers below it, and their differences, fit int64.
_FRAME_LIMIT = 2**62
# ".jpg" and ".jp2" are suffixes; ".0004" of "cam01.0004" and "0007" of "GOPR0012.MP4_0007" are frame numbers.
_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]*$")
_CAMERA = re.compile(r"(?:cam|camera|view|drone)[_-]?[0-9]+", re.IGNORECASE)
# No picture is so large, so a joint beyond it is damage.
_FARTHEST_PX = 1_000_000

# Whole-body skeletons by their number of keypoints: those of this body come first, then face and hands.
_BODIES = {136: "halpe26", 133: "coco23"}  # Halpe-136, COCO-WholeBody
# One JSON among logs makes no folder of keypoints.
_LEAST_SHARE = 0.25


def load_json(path: Path) -> object:
    """Read a JSON file; NaN and Infinity are accepted, as Python writes them."""
    content = read_bytes(path)
    if not content.strip():
        raise empty(path, "is empty")
    try:
        parsed: object = json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = "is nested too deeply" if isinstance(error, RecursionError) else f"is not JSON ({error})"
        raise damaged(path, reason) from error
    return parsed


def json_files(folder: Path) -> list[Path]:
    """Return the JSON files of a folder, by name, without hidden ones (macOS leaves such on shared disks)."""
    return sorted(p for p in folder.glob("*.json") if p.is_file() and not p.name.startswith("."))


def samples(path: Path) -> list[object]:
    """Read the beginning of a JSON file, or of a few files across a folder, to recognise the format."""
    if path.is_dir():
        files = json_files(path)
        if len(files) < _LEAST_SHARE * sum(not each.name.startswith(".") for each in path.iterdir()):
            return []
        files = files[:: max(1, len(files) // _SAMPLED_FILES)][:_SAMPLED_FILES]
    else:
        files = [path] if path.suffix.lower() == ".json" and path.is_file() else []
    found: list[object] = []
    for file in files:
        try:
            status = file.stat()
            found.append(_outline(file, status.st_size, status.st_mtime_ns))
        except (OSError, DataError):
            continue
    return found


@lru_cache(maxsize=64)
def _outline(path: Path, size: int, modified_ns: int) -> object:  # noqa: ARG001 - the key of the cache
    """Return the beginnings of a file's lists; cached, because every format asks for the same file."""
    content = load_json(path)
    if isinstance(content, dict):
        return {key: value[:1] if isinstance(value, list) else value for key, value in content.items()}
    # Nobody may be seen in the first pictures.
    return [next(filter(None, content), None)] if isinstance(content, list) and content else content


def first_entry(sample: object) -> dict[str, object]:
    """Return the first entry of a list of objects; empty for anything else."""
    entry = sample[0] if isinstance(sample, list) and sample else None
    return entry if isinstance(entry, dict) else {}


def is_alphapose_entry(entry: dict[str, object]) -> bool:
    """Return True if a result entry is AlphaPose's rather than COCO's, which numbers pictures."""
    image = entry.get("image_id")
    names_picture = isinstance(image, str) and _SUFFIX.search(image) is not None
    return (
        "keypoints" in entry and "image_id" in entry and ("box" in entry or "idx" in entry or names_picture)
    )


def objects(content: object, where: object, what: str) -> Iterator[tuple[str, dict[str, object]]]:
    """Yield each entry of a list of JSON objects, with its name for messages."""
    if not isinstance(content, list):
        raise damaged(str(where), f"the {what} are not a list")
    for index, entry in enumerate(content):
        name = f"{where}, {what} [{index}]"
        if not isinstance(entry, dict):
            raise damaged(name, "is not a JSON object")
        yield name, entry


def numbers(values: object, where: str) -> Float:
    """Convert a JSON array of numbers; null is NaN."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise damaged(where, "keypoints are not plain numbers") from error


def triples(values: object, where: str) -> Float:
    """Reshape a flat array x, y, confidence, x, y, ... to rows [K, 3]."""
    flat = numbers(values, where)
    if flat.ndim != 1 or flat.size % 3 or not flat.size:
        raise DataError(where, f"{flat.size} values are not x, y, confidence for each keypoint")
    return flat.reshape(-1, 3)


def whole_number(value: object) -> int | None:
    """Return a JSON number as int, if it is an integer of plausible size; else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return int(value) if abs(value) < _FRAME_LIMIT and value == int(value) else None


def frame_number(name: object, group: int = -1) -> int | None:
    """Return the frame of an image id or a name: the number itself, or a group of its digits (the last)."""
    if not isinstance(name, str):
        return whole_number(name)
    digits = _digits(name)
    if not digits or len(digits) < -group:
        return None
    return whole_number(int(digits[group])) if len(digits[group]) < 20 else None


def changing_digits(names: Collection[str]) -> int:
    """Return the group of digits that numbers pictures: the last that is another in each name; -1 if none is.

    The 2 in 000012_cam2 numbers a camera, the 192 in 000012_rtmpose-m_256x192 nothing.
    """
    groups = [_digits(name) for name in names]
    if len({len(each) for each in groups}) != 1:
        return -1
    columns = list(zip(*groups, strict=True))
    changing = [k for k, column in enumerate(columns) if len(set(column)) == len(groups) > 1]
    of_cameras = _CAMERA.search(_SUFFIX.sub("", min(names)))
    number = len(_digits(min(names)[: of_cameras.end()])) - 1 if of_cameras else -1
    return next((k - len(columns) for k in reversed(changing) if k != number), -1)


def _digits(name: str) -> list[str]:
    return re.findall(r"[0-9]+", _SUFFIX.sub("", name))


@dataclass(frozen=True)
class KeypointFile:
    """Reader of keypoints: `is_known` recognises JSON, or a table's head; `gather` adds everybody in it."""

    name: str
    title: str
    is_known: Callable[[object], bool]
    gather: Callable[[Gathering], None]
    suffixes: tuple[str, ...] = (".json",)
    of_folders: bool = True

    def recognises(self, path: Path) -> bool:
        """Return True if the content is known."""
        if self.suffixes != (".json",):
            return path.is_file() and self.is_known(read_head(path, self.suffixes))
        return (self.of_folders or path.is_file()) and any(map(self.is_known, samples(path)))

    def describe(self, path: Path) -> dict[str, object]:
        """Describe frames, people, the skeleton (stated, or guessed from the keypoints), and confidences."""
        return _described(self.read_keypoints(path, skeleton=None, first_frame=0))

    def read_keypoints(self, path: Path, *, skeleton: str | None, first_frame: int) -> Detections:
        """Read every person; pixels and scores as the file has them, cleaned by `Gathering.detections`."""
        people = Gathering(path)
        try:
            self.gather(people)
        except csv.Error as error:  # most often a cell of more than 131072 characters
            raise damaged(path, error) from error
        people.leave_out_face_and_hands()
        return people.detections(_choose_skeleton(people, skeleton), first_frame)


class Gathering:
    """People and frames of one camera, in any order; joint names and picture size if the file states them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.joint_names: tuple[str, ...] | None = None
        self.image_size: tuple[int, int] | None = None
        self.dropped: Counter[str] = Counter()
        self.digits = -1  # the group in the names of pictures that numbers them
        self._listed: dict[int, str] = {}
        self._people: Counter[int] = Counter()
        self._frame: list[int] = []
        self._rank: list[int] = []
        self._own_id: list[int | None] = []
        self._rows: list[Float] = []

    def __len__(self) -> int:
        return len(self._rows)

    def contents(self) -> Iterator[tuple[Path, object]]:
        """Yield the content of the file, or of every readable JSON file of the folder; count the others."""
        if not self.path.is_dir():
            yield self.path, load_json(self.path)
            return
        files = json_files(self.path)
        for file in files:
            try:
                content = load_json(file)
            except DataError:
                self.dropped["unreadable file"] += 1
                continue
            yield file, content
        if self.dropped["unreadable file"] == len(files):
            problem = f"none of its {len(files)} JSON files can be read" if files else "holds no JSON files"
            raise DataError(self.path, problem, "check the folder, or export the keypoints again")

    def frame_of(self, name: object, where: str, file: Path | None = None) -> int:
        """Return and list the frame number of a picture's name; `file` if each file counts alone."""
        frame = frame_number(name, self.digits)
        if frame is None:
            problem = f"picture {name!r} has no frame number"
            raise DataError(where, problem, "name pictures with the number at the end")
        picture = name if isinstance(name, str) else str(frame)
        label = f"{file.name}, {picture}" if file else picture
        other = self._listed.setdefault(frame, label)
        if other != label:
            problem = f"'{other}' and '{label}' are both frame {frame}"
            raise DataError(self.path, problem, "give each camera a file or folder of its own")
        return frame

    def frame_of_file(self, file: Path, stem: str | None = None) -> int | None:
        """Return the frame of a file of one picture: 0 for a file alone without a number, else None."""
        stem = file.stem if stem is None else stem
        if frame_number(stem, self.digits) is not None:
            return self.frame_of(stem, str(file))
        if file == self.path:
            return self.frame_of(0, str(file))
        self.dropped["file without a frame number"] += 1
        return None

    def add(
        self, frame: int, rows: Float, where: str, *, rank: int | None = None, own_id: int | None = None
    ) -> None:
        """Add a person: rows [K, 3] of x, y, confidence; place in the frame; a tracker's number."""
        if self._rows and len(rows) != len(self._rows[0]):
            problem = f"holds {len(rows)} keypoints where the people before hold {len(self._rows[0])}"
            raise DataError(where, problem, "one file or folder holds one skeleton")
        self._rank.append(self._people[frame] if rank is None else rank)
        self._people[frame] += 1
        self._frame.append(frame)
        self._own_id.append(own_id)
        self._rows.append(rows)

    def add_named(
        self, frame: int, names: Sequence[str], points: Float, where: str, **ids: int | None
    ) -> None:
        """Add a person with names for keypoints [K, 3], in the smallest skeleton with the most."""
        if self.joint_names is None:
            joints = {joint_called(name) for name in names}
            fit = max(SKELETONS.values(), key=lambda s: (len(joints & {*s.joints}), -len(s.joints)))
            if len(joints & {*fit.joints}) < LEAST_NAMED_JOINTS:
                problem = f"names its keypoints {', '.join(names[:6])}: they are no joints of people"
                remedy = "name them as left_shoulder, right_knee"
                raise DataError(self.path, problem, remedy, code="unsupported")
            self.joint_names = fit.joints
        place = {joint: k for k, joint in enumerate(self.joint_names)}
        rows = np.zeros((len(place), 3))
        for name, point in zip(names, points, strict=True):
            if (joint := joint_called(name)) in place:
                rows[place[joint]] = point if np.isfinite(point[:2]).all() else 0.0
            else:
                self.dropped["keypoint of no known joint"] += 1
        self.add(frame, rows, where, **ids)

    def keypoints(self) -> Float:
        """Return all people so far [M, K, 3]; DataError without people."""
        self.count()
        return np.stack(self._rows)

    def count(self) -> int:
        """Return the number of keypoints of each person."""
        if not self._rows:
            causes = [f"{number} x {cause}" for cause, number in sorted(self.dropped.items()) if number]
            causes += [f"{len(self._listed)} x frame without people"] if self._listed else []
            detail = f" ({', '.join(causes)})" if causes else ""
            problem = f"holds no keypoints{detail}"
            raise DataError(self.path, problem, "check that the detector saw the person")
        return len(self._rows[0])

    def leave_out_face_and_hands(self) -> None:
        """Keep only the body of people with the keypoints of a whole-body skeleton; count the rest."""
        body = _BODIES.get(self.count())
        if body is None:
            return
        joints = len(SKELETONS[body].joints)
        self.dropped["face and hand keypoint"] += sum(len(rows) - joints for rows in self._rows)
        self._rows = [rows[:joints] for rows in self._rows]
        self.joint_names = self.joint_names[:joints] if self.joint_names else None

    def detections(self, skeleton: Skeleton, first_frame: int) -> Detections:
        """Return everything collected, cleaned and sorted.

        Frames before `first_frame` and repeated detections are dropped. A joint is missing (NaN, confidence
        0) if its position is not finite or beyond `_FARTHEST_PX`, or if its confidence is 0, which detectors
        write for "not found". A confidence that is not finite or below 0 becomes 0, one above 1 becomes 1.
        All but "not found" is counted in `dropped` and `adjusted`.
        """
        frame = np.array(self._frame, dtype=np.int64) - first_frame
        listed = np.array(sorted(self._listed), dtype=np.int64) - first_frame
        keypoints = self.keypoints()
        kept = frame >= 0
        repeats = kept & self._repeats(keypoints)
        kept &= ~repeats
        xy, confidence, dropped, adjusted = _checked(keypoints[kept])
        person = self._person_numbers(kept)
        frame = frame[kept]

        dropped += self.dropped
        dropped["detection listed twice"] = int(repeats.sum())
        somebody = np.isfinite(xy).any(axis=(1, 2))
        if not somebody.any():
            last = int(listed[-1]) + first_frame
            causes = "".join(f", {number} x {cause}" for cause, number in sorted(dropped.items()) if number)
            problem = f"holds no keypoints from frame {first_frame} on (its last frame is {last}{causes})"
            raise DataError(self.path, problem, "check first_frame, and that the detector saw the person")
        rows = np.flatnonzero(somebody)
        shared = self._told_apart(frame, person, rows)
        rows = rows[np.lexsort((person[rows], frame[rows]))]
        dropped["frame before first_frame"] = int((listed < 0).sum())
        dropped["person without a joint"] = int((~somebody).sum())
        adjusted["person under another's id, numbered anew"] = shared
        return Detections(
            joints=skeleton.joints,
            frame=frame[rows],
            person=person[rows],
            xy=xy[rows],
            confidence=confidence[rows],
            frames_listed=listed[listed >= 0],
            image_size=self.image_size,
            dropped={cause: number for cause, number in sorted(dropped.items()) if number},
            adjusted={cause: number for cause, number in sorted(adjusted.items()) if number},
        )

    def _repeats(self, keypoints: Float) -> Bool:
        """Mark the people [M] with the keypoints [M, K, 3] and id of an earlier person of the same frame."""
        repeats = np.zeros(len(keypoints), dtype=np.bool_)
        # People who were not found have zeros only, so they are all equal.
        found = (keypoints[..., :2] != 0).any(axis=(1, 2))
        seen: set[tuple[int, int | None, bytes]] = set()
        for row in np.flatnonzero(found).tolist():
            frame = self._frame[row]
            if self._people[frame] > 1:
                detection = (frame, self._own_id[row], keypoints[row].tobytes())
                repeats[row] = detection in seen
                seen.add(detection)
        return repeats

    @staticmethod
    def _told_apart(frame: Int64, person: Int64, rows: Int64) -> int:
        """Give new numbers to all but the first of people with one number in a frame; return how many."""
        seen: Counter[tuple[int, int]] = Counter()
        unused, shared = int(person.max(initial=0)) + 1, 0
        for row in rows.tolist():
            key = int(frame[row]), int(person[row])
            if seen[key]:
                person[row] = unused + seen[key] - 1
                shared += 1
            seen[key] += 1
        return shared

    def _person_numbers(self, kept: Bool) -> Int64:
        """Number the kept people by the detector's own ids, or by their positions within the frame."""
        rows = np.flatnonzero(kept)
        own = [own_id for row in rows if (own_id := self._own_id[row]) is not None]
        crowded = len({self._frame[row] for row in rows}) < len(rows)
        tracked = len(own) == len(rows) and not (crowded and len(set(own)) == 1)
        return np.array(own if tracked else [self._rank[row] for row in rows], dtype=np.int64)


def _choose_skeleton(people: Gathering, stated: str | None) -> Skeleton:
    """Choose the skeleton: the user's, the one with the file's joint names, or the likeliest of this size."""
    path, count, names = people.path, people.count(), people.joint_names
    known = ", ".join(f"{s.name} ({len(s.joints)})" for s in SKELETONS.values())
    if stated is not None:
        skeleton = get_skeleton(stated)
        if len(skeleton.joints) != count:
            problem = f"has {count} keypoints per person where {stated} has {len(skeleton.joints)}"
            raise DataError(path, problem, f"state the skeleton it was detected with: {known}")
        return skeleton
    candidates = skeleton_with(count)
    if not candidates:
        raise DataError(path, f"has {count} keypoints per person, as no known skeleton", f"there are {known}")
    found = candidates[:1] if names is None else [s for s in candidates if s.joints == names]
    if not found:
        problem = f"names its {count} keypoints {', '.join((names or ())[:4])}, ..., as no known skeleton"
        raise DataError(path, problem, f"state the skeleton if it is one of {known}")
    return found[0]


def _checked(keypoints: Float) -> tuple[Float, Float, Counter[str], Counter[str]]:
    """Return checked positions [M, K, 2], confidences [M, K], and counts of dropped and adjusted values."""
    xy, confidence = keypoints[..., :2].copy(), keypoints[..., 2].copy()
    not_found = confidence == 0
    not_finite = ~np.isfinite(xy).all(axis=-1)
    far = ~not_finite & (np.abs(xy) > _FARTHEST_PX).any(axis=-1)
    bad = not_finite | far
    confidence_not_finite = ~bad & ~np.isfinite(confidence)
    below, above = ~bad & (confidence < 0), ~bad & (confidence > 1) & ~confidence_not_finite
    xy[bad | not_found] = np.nan
    confidence[bad | ~np.isfinite(confidence)] = 0.0
    dropped = {
        "joint not finite": not_finite,
        f"joint more than {_FARTHEST_PX} px away": far,
        "confidence not finite": confidence_not_finite,
        "confidence below 0": below & ~confidence_not_finite,
    }
    adjusted = {"confidence above 1, set to 1": above}
    counted = [Counter({cause: int(rows.sum()) for cause, rows in of.items()}) for of in (dropped, adjusted)]
    return xy, np.clip(confidence, 0.0, 1.0), counted[0], counted[1]


def _described(detections: Detections) -> dict[str, object]:
    """Describe a keypoint file for `mocap info`."""
    found = np.isfinite(detections.xy).all(axis=-1)
    confidence = detections.confidence[found]
    fits = next(s for s in SKELETONS.values() if s.joints == detections.joints)
    listed = detections.frames_listed
    facts: dict[str, object] = {
        "frames": len(listed),
        "first frame": int(listed[0]),
        "last frame": int(listed[-1]),
        "people": len(detections.frame),
        "people per frame, at most": int(np.unique(detections.frame, return_counts=True)[1].max()),
        "skeleton": f"{fits.name} ({len(fits.joints)} keypoints)",
        "joints found, share": round(float(found.mean()), 3),
        "confidence, mean": round(float(confidence.mean()), 3),
        "confidence, range": [round(float(confidence.min()), 3), round(float(confidence.max()), 3)],
    }
    if detections.image_size:
        facts["picture size"] = list(detections.image_size)
    if detections.dropped:
        facts["left out"] = detections.dropped
    if detections.adjusted:
        facts["adjusted"] = detections.adjusted
    return facts
