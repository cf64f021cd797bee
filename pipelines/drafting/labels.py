"""Labels of files and topics, to find those of the same camera.

A name is split into words with their numbers (drone_1_poses: drone 1, poses). Words for the kind of a thing
(poses, camera, json) are ignored; the rest is its label. `drone1.mp4`, `drone1_poses.tum`,
`/drone1/odometry` and `drone-01/calib.yaml` all have the label drone 1.
"""

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

NamePlace = tuple[str, ...]
"""Names of a thing: folders below the common one, then the file's name without its suffix."""

EQUAL, PART, NUMBER, UNNAMED, OTHER = 4, 3, 2, 1, 0
"""Ratings of two labels: they are the same; one is within the other; only the numbers agree (d1, drone1); one
of them is empty; they differ."""

TRUTH_WORDS = frozenset({"truth", "true", "gt", "groundtruth"})
_GENERIC_TEXT = """
    cam camera cameras video videos vid movie clip image images img picture pictures frame frames photo
    rgb bgr color colour mono gray raw compressed rect rectified info odometry odom pose poses trajectory
    traj path paths tf transform transforms tum csv json toml yaml yml txt log logs bag bags rosbag mcap
    data dataset recording record keypoints keypoint kpts kp joints skeleton openpose alphapose mmpose coco
    detections detection detector results result predictions calib calibration calibrations intrinsic
    intrinsics extrinsic extrinsics camchain kalibr opencv ost ground gimbal attitude angles angle local
    position orientation mavros state estimator estimate filtered fused global world map time times
    timestamp timestamps stamps stamp static base link body optical imu vio slam the of and
"""
_GENERIC = TRUTH_WORDS | frozenset(_GENERIC_TEXT.split())
"""Words for the kind of a thing, which do not name its owner. With a number (cam01) they do name a camera."""
_GENERIC_NUMBERED = re.compile(
    r"(?i)(?<![^\W_])(?:rosbag2|ros[12]|px4|halpe26|coco17|coco133|body25b?|blazepose33|[hx]26[45]|[23]d|\d{3,4}p|\d+fps)"
    r"(?![^\W_])"
)
_WORD = re.compile(r"[^\W\d_]+[0-9]*|[0-9]+")

# Longer numbers are hashes or times, of which the last digits tell files apart.
MAX_DIGITS = 18


class Word(NamedTuple):
    """A word of a name, with the number that follows it."""

    text: str  # as it is spelled
    word: str  # lower case
    number: int | None

    @property
    def key(self) -> tuple[str, int | None]:
        """The key by which words are equal: drone_1, Drone01."""
        return self.word, self.number


Label = tuple[Word, ...]


def words(text: str) -> list[Word]:
    """Split a name into its words in their order; a number belongs to the word before it."""
    found: list[Word] = []
    start = end = 0  # of the word found last
    for match in _WORD.finditer(_GENERIC_NUMBERED.sub(lambda generic: " " * len(generic[0]), text)):
        letters = match[0].rstrip("0123456789")
        number = int(match[0][len(letters) :][-MAX_DIGITS:] or -1)
        if not letters and found and found[-1].number is None and match.start() == end + 1:
            found[-1] = Word(text[start : match.end()], found[-1].word, number)
        else:
            start = match.start()
            found.append(Word(match[0], letters.lower(), None if number < 0 else number))
        end = match.end()
    return found


def label_of(text: str) -> Label:
    """Return the label of a name: its words without those for kinds of things."""
    kept = {word.key: word for word in words(text) if word.number is not None or word.word not in _GENERIC}
    return tuple(kept.values())


def label_of_place(place: NamePlace) -> Label:
    """Return the label of a file: that of its name, with numbered folders above it (drone1/DJI_0001.mp4).

    If the name has no label (drone1/video.mp4), it is the label of the nearest folder that has one.
    """
    *folders, name = place
    own = label_of(name)
    above = [label_of(folder) for folder in folders]
    if not own:
        return next((label for label in reversed(above) if label), ())
    numbered = [word for label in above for word in label if word.word and word.number is not None]
    return tuple({word.key: word for word in (*numbered, *own)}.values())


def is_called(text: str, wanted: frozenset[str]) -> bool:
    """Test if a name contains one of some words."""
    return any(word.word in wanted for word in words(text))


def affinity(one: Label, other: Label) -> int:
    """Rate how well two labels match, from `OTHER` to `EQUAL`."""
    if not one or not other:
        return UNNAMED
    ours, theirs = {word.key for word in one}, {word.key for word in other}
    if ours == theirs:
        return EQUAL
    if ours < theirs or theirs < ours:
        return PART
    numbers = [{word.number for word in label if word.number is not None} for label in (one, other)]
    return NUMBER if numbers[0] and numbers[0] == numbers[1] else OTHER


def order(label: Label) -> list[tuple[str, int]]:
    """Make a sort key that sorts drone2 before drone10."""
    return [(word.word, -1 if word.number is None else word.number) for word in label]


def camera_names(labels: Sequence[Label]) -> list[str]:
    """Make a name for each camera, [A-Za-z0-9_-]{1,64}, such that no two differ only in case.

    Numbered words that all labels share (a date, a take) are left out. Of the rest, a name has as many words
    as are needed to distinguish the cameras.
    """
    if len(labels) > 1:
        shared = Counter(word.key for label in labels for word in label if word.number is not None)
        common = {key for key, count in shared.items() if count == len(labels)}
        distinct = [tuple(word for word in label if word.key not in common) for label in labels]
        labels = distinct if all(distinct) else labels
        longest = max(len(label) for label in labels)
        enough = (k for k in range(1, longest) if len({_keys(label[:k]) for label in labels}) == len(labels))
        length = next(enough, longest)
        labels = [label[:length] for label in labels]
    names: list[str] = []
    for label in labels:
        names.append(unique(fitting("_".join(word.text for word in label), f"camera{len(names) + 1}"), names))
    return names


def _keys(label: Label) -> tuple[tuple[str, int | None], ...]:
    return tuple(word.key for word in label)


def fitting(text: str, otherwise: str) -> str:
    """Convert a text to [A-Za-z0-9_-]{1,64}; return `otherwise` if no letter is left of it."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", plain).strip("_-")[:64]
    return name if re.search("[A-Za-z]", name) else otherwise


def unique(name: str, taken: Sequence[str]) -> str:
    """Return the name, with a number if it is taken."""
    folded = {other.lower() for other in taken}
    candidate, number = name, 2
    while candidate.lower() in folded:
        candidate = f"{name[:58]}_{number}"
        number += 1
    return candidate


COMMANDED = frozenset(
    {"setpoint", "setpoints", "cmd", "command", "commanded", "desired", "goal", "reference", "target"}
    | {"plan", "planned", "planner", "waypoint", "waypoints"}
)
ACTOR = frozenset(
    {"actor", "person", "people", "human", "subject", "pedestrian", "runner", "athlete", "watch"}
)
NO_PICTURES = frozenset({"depth", "disparity", "infra", "mask", "segmentation", "confidence"})
OPTICAL = frozenset({"camera", "cam", "optical", "lens"})
BODIES = frozenset({"base", "body", "imu", "fcu"})
GIMBAL = frozenset({"gimbal", "mount", "pan", "tilt", "ptz", "camera", "cam"})
NED = frozenset({"ned", "px4", "fmu"})
