"""Records of what was found in files: candidates for the parts of a manifest, and the topics of logs.

A name is split into words with their numbers. Words for the kind of a thing (poses, camera, json) are
ignored; the rest is its label: `drone1.mp4`, `drone1_poses.tum` and `drone-01/calib.yaml` have the label
drone 1.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

from pipelines.session.records import Height, Telemetry
from pipelines.session.storage import own_table

# --- labels ----------------------------------------------------------------------------------------------

NamePlace = tuple[str, ...]
"""Names of a thing: folders below the common one, then the file's name without its suffix."""

EQUAL, PART, NUMBER, UNNAMED, OTHER = 4, 3, 2, 1, 0
"""Ratings of two labels: they are the same; one is within the other; only the numbers agree (d1, drone1); one
of them is empty; they differ."""

_WORDS = {kind: frozenset(words.split()) for kind, words in own_table(__file__, "words").items()}
TRUTH_WORDS, COMMANDED, ACTOR, NO_PICTURES, OPTICAL, BODIES, GIMBAL, NED = (
    _WORDS[kind]
    for kind in ("truth", "commanded", "actor", "no_pictures", "optical", "bodies", "gimbal", "ned")
)
_GENERIC = TRUTH_WORDS | _WORDS["generic"]
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
    """Return the label of a file's name with numbered folders above it, else of the nearest folder."""
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
    """Name each camera by the fewest words that distinguish it; no two names differ only in case."""
    if len(labels) > 1:
        shared = Counter(word.key for label in labels for word in label if word.number is not None)
        common = {key for key, count in shared.items() if count == len(labels)}
        distinct = [tuple(word for word in label if word.key not in common) for label in labels]
        labels = distinct if all(distinct) else labels
        longest = max(len(label) for label in labels)
        keys = [tuple(word.key for word in label) for label in labels]
        enough = (k for k in range(1, longest) if len({key[:k] for key in keys}) == len(labels))
        length = next(enough, longest)
        labels = [label[:length] for label in labels]
    names: list[str] = []
    for label in labels:
        names.append(unique(fitting("_".join(word.text for word in label), f"camera{len(names) + 1}"), names))
    return names


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


# --- candidates -------------------------------------------------------------------------------------------

SourceKind = Literal[
    "video",
    "keypoints",
    "frame_times",
    "pose",
    "still",
    "intrinsics",
    "gimbal",
    "angles",
    "joints",
    "map",
    "fixes",
    "transforms",
]

NO_DATE_NS = 10**17
"""Stamps below it count from the start of a machine: it is the year 1973."""

# Header stamps that are nearer to receipt differ from it by transport and start-up.
MIN_CLOCKS_APART_NS = 10_000_000_000

# A flight record and a video of one recording differ in length by less.
MAX_LENGTHS_APART_NS = 2_000_000_000


@dataclass(frozen=True)
class TimeSpan:
    """First and last stamp, ns."""

    first_ns: int
    last_ns: int

    @property
    def length_ns(self) -> int:
        """The time between them."""
        return self.last_ns - self.first_ns

    def overlap_ns(self, other: TimeSpan) -> int:
        """Compute the length of the overlap with another span; negative is the gap between them."""
        return min(self.last_ns, other.last_ns) - max(self.first_ns, other.first_ns)

    def later(self, by_ns: int) -> TimeSpan:
        """Return the span at later times."""
        return TimeSpan(self.first_ns + by_ns, self.last_ns + by_ns)

    def __str__(self) -> str:
        return f"{self.length_ns / 1e9:.6g} s from {self.first_ns / 1e9:.3f}"


class VideoStart(NamedTuple):
    """Start of a video, as a drone's own log has it."""

    start_ns: int
    source: str
    sigma_s: float = 0.0  # 0: as exactly as its poses


@dataclass(frozen=True, eq=False)
class Proposal:
    """Something that a part of a manifest can name; its settings hold paths as Path objects."""

    kind: SourceKind
    path: Path
    place: NamePlace
    about: str  # a few words for the comment
    settings: dict[str, object]
    labels: tuple[Label, ...]
    rank: tuple[object, ...] = (0,)  # the smallest is the likeliest among those with equal names
    span: TimeSpan | None = None
    of_body: bool = False  # poses of the body; else of the camera
    unturned: bool = False  # positions only, without attitudes of drone or gimbal
    by_gps: bool = False  # poses whose position is that of a satellite receiver
    is_true: bool = False  # its name says that it is ground truth
    ned_hint: str = ""  # a name that sounds like north-east-down
    frame: str = ""  # in which logged poses or a map lie
    topic: str = ""
    type: str = ""  # of the topic's messages
    lead_ns: int | None = None  # by which header stamps are ahead of those of receipt; None without


@dataclass(frozen=True, eq=False)
class FoundFilm(Proposal):
    """A video file or a folder of pictures."""

    frames: int = 0
    size: tuple[int, int] = (0, 0)  # width and height of the pictures, px
    length_ns: int = 0
    made_ns: int | None = None  # its start or its end, in UTC, by its metadata
    clock: str = "own"  # of pictures in a folder: their seconds, or none
    focal_35_mm: float | None = None  # of pictures in a folder, as on film 36 mm wide


@dataclass(frozen=True, eq=False)
class FoundFrames(Proposal):
    """2D keypoints of one camera."""

    frames: int = 0  # The number of frames that are listed.
    first_frame: int = 0  # The smallest number of a frame.
    last_frame: int = 0  # The largest number of a frame.
    ambiguous: str = ""  # its format, where others recognise it as well


@dataclass(frozen=True, eq=False)
class FlownPoses(Proposal):
    """Poses in a drone's own log."""

    telemetry: Telemetry | None = None
    step_ns: int = 0  # median step between positions
    states_altitude: bool = False  # a manifest can state which of its heights are taken
    height: Height = "unknown"
    video_start: VideoStart | None = None  # of the video beside it, or of the one that holds it
    films: tuple[TimeSpan, ...] = ()  # when it says that the camera recorded videos
    focal_35_mm: float | None = None  # focal length of its camera, as on film 36 mm wide

    def film_of(self, film: FoundFilm) -> TimeSpan | None:
        """Return the only recording of about a video's length; None if there is none, or several."""
        alike = [f for f in self.films if abs(f.length_ns - film.length_ns) < MAX_LENGTHS_APART_NS]
        return alike[0] if len(alike) == 1 else None


# --- logs ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FoundLink:
    """A logged transform: the frame `child` in `parent`."""

    topic: str
    parent: str
    child: str
    still: bool
    first_ns: int = field(default=0, compare=False)  # time of receipt of the first one
    lead_ns: int | None = field(default=None, compare=False)  # as of a candidate


@dataclass(frozen=True, eq=False)
class FoundLog:
    """A log; it has several parts if it was split."""

    path: Path
    place: NamePlace
    title: str
    topics: dict[str, Proposal]  # by topic, and by preset and namespace
    edges: tuple[FoundLink, ...] = ()
    parts: tuple[Path, ...] = ()
    stamps: Literal["header", "receive"] = "header"
    ahead_ns: int = 0  # of its header stamps, if that is more than the log is long

    @property
    def span(self) -> TimeSpan:
        """The time from its first message to its last."""
        spans = [topic.span for topic in self.topics.values() if topic.span] or [TimeSpan(0, 0)]
        return TimeSpan(min(s.first_ns for s in spans), max(s.last_ns for s in spans))

    @property
    def label(self) -> Label:
        """The label of its name, without the _0 of its first part."""
        *folders, name = self.place
        match = _PART.fullmatch(name)
        return label_of_place((*folders, match[1] if match and label_of(match[1]) else name))

    def candidates(self) -> Iterator[Proposal]:
        """Yield its topics with their labels, and the chains of its transforms."""
        for topic in self.topics.values():
            if topic.span and topic.kind != "transforms":
                yield replace(topic, labels=(label_of(topic.topic) or self.label,))
        moving = [t.span for t in self.topics.values() if t.kind == "transforms" and t.span]
        for parent, child, first_ns in chains(self.edges):
            of_body = not is_called(child, OPTICAL)
            span = TimeSpan(first_ns, max(s.last_ns for s in moving)) if moving else None
            yield Proposal(
                "pose",
                self.path,
                self.place,
                "transforms" + (f", {span}" if span else ""),
                {"file": self.path, "parent": parent, "child": child},
                (label_of(child) or self.label,),
                (1, int(of_body), LAST_POSE_TYPE + 1, 0, child),
                span,
                of_body=of_body,
                ned_hint=next((name for name in (parent, child) if is_called(name, NED)), ""),
                frame=parent,
            )


POSE_TYPES = ("Odometry", "PoseWithCovarianceStamped", "PoseStamped", "PoseInFrame", "TransformStamped")
"""Types of pose messages, the preferred first: odometry states its uncertainty. All others come last."""
LAST_POSE_TYPE = len(POSE_TYPES)

_PART = re.compile(r"(.*)_(\d{1,9})", re.DOTALL)


def join_parts(recordings: Sequence[FoundLog]) -> list[FoundLog]:
    """Join NAME_0, NAME_1, ... to one recording if each begins after the one before: two drones stay two."""
    result: list[FoundLog] = []
    for recording in sorted(recordings, key=lambda each: _part(each.place)):
        before = result[-1] if result else None
        if before and _continues(before, recording):
            topics = dict(before.topics)
            for name, topic in recording.topics.items():
                known = topics.get(name)
                if known is None or known.span is None or topic.span is None:
                    topics[name] = topic if known is None or known.span is None else known
                else:
                    topics[name] = replace(known, span=TimeSpan(known.span.first_ns, topic.span.last_ns))
            edges = tuple(dict.fromkeys((*before.edges, *recording.edges)))
            result[-1] = replace(before, parts=(*before.parts, recording.path), topics=topics, edges=edges)
        else:
            result.append(replace(recording, parts=(recording.path,)))
    return sorted(result, key=lambda recording: recording.place)


def _part(place: NamePlace) -> tuple[NamePlace, str, int]:
    match = _PART.fullmatch(place[-1])
    name, number = (match[1], int(match[2])) if match else (place[-1], -1)
    return place[:-1], name, number


def _continues(before: FoundLog, recording: FoundLog) -> bool:
    *name, number = _part(recording.place)
    *first, zero = _part(before.place)
    if name != first or zero != 0 or number != len(before.parts):
        return False
    shared = [
        (before.topics[topic].span, known.span)
        for topic, known in recording.topics.items()
        if topic in before.topics
    ]
    spans = [(one, other) for one, other in shared if one and other]
    return bool(spans) and all(one.last_ns <= other.first_ns for one, other in spans)


def choose_stamps(recordings: Sequence[FoundLog]) -> list[FoundLog]:
    """Choose one kind of stamps for all logs; with it, the spans are those of these stamps.

    Header stamps are taken, unless they differ from those of receipt by more than a log is long (simulation
    time, time since boot) and are not alike in all topics of all logs.
    """
    once = {"intrinsics", "map"}  # published once, perhaps long before
    moving = [
        (recording, topic)
        for recording in recordings
        for topic in recording.topics.values()
        if topic.span and topic.kind not in once and not topic.topic.endswith("static")
    ]
    longest_ns = max([MIN_CLOCKS_APART_NS, *(log.span.length_ns for log, _ in moving)])
    if all(abs(topic.lead_ns or 0) <= max(log.span.length_ns, MIN_CLOCKS_APART_NS) for log, topic in moving):
        return list(recordings)
    known = [topic.lead_ns for _, topic in moving if topic.lead_ns is not None]
    alike = len(known) == len(moving) and max(known) - min(known) <= longest_ns
    found = []
    for recording in recordings:
        leads = [t.lead_ns for log, t in moving if log is recording and t.lead_ns is not None]
        if not alike:
            ahead_ns = max(leads, key=abs, default=0)
            found.append(replace(recording, stamps="receive", ahead_ns=ahead_ns))
            continue
        ahead_ns = max(known, key=abs)
        topics = {
            name: replace(t, span=t.span.later(ahead_ns if t.lead_ns is None else t.lead_ns)) if t.span else t
            for name, t in recording.topics.items()
        }
        edges = tuple(
            replace(edge, first_ns=edge.first_ns + (ahead_ns if edge.lead_ns is None else edge.lead_ns))
            for edge in recording.edges
        )
        found.append(replace(recording, topics=topics, edges=edges, ahead_ns=ahead_ns))
    return found


def chains(edges: Sequence[FoundLink]) -> list[tuple[str, str, int]]:
    """List (parent, child) of every moving frame below the tree's root, and from when (ns) it is known."""
    above: dict[str, FoundLink] = {}
    for edge in edges:
        above.setdefault(edge.child, edge)
    found = []
    for child in sorted(above):
        way: list[FoundLink] = []
        frame = child
        while frame in above and len(way) <= len(above):
            way.append(above[frame])
            frame = above[frame].parent
        moving = [edge.first_ns for edge in way if not edge.still]
        if moving and len(way) <= len(above):  # a longer way goes in circles
            found.append((way[-1].parent, child, max(moving)))
    cameras = [pair for pair in found if is_called(pair[1], OPTICAL)]
    # A picture's frame is the optical one; its mounting frame has the axes of a body.
    optical = [pair for pair in cameras if is_called(pair[1], frozenset({"optical"}))]
    bodies = [pair for pair in found if pair not in cameras and is_called(pair[1], BODIES)]
    return [*(optical or cameras), *bodies]
