"""Detector `onnx:MODEL.onnx`: the user's own top-down model, run by ONNX Runtime.

Crops follow MMPose's top-down models: upright, the box of a person padded by 1.25, the aspect of the
network's input kept. People are found by YOLOX or RTMDet, as exported by OpenMMLab and by their authors,
or by BlazePose's person detector.

The argument of `onnx:` is a model's path, with options for information that its graph lacks:
`MODEL.onnx[,option=value...]`, for example `pose.onnx,skeleton=halpe26,people=yolox.onnx`.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.blazepose import DETECTOR as BLAZEPOSE
from pipelines.keypoints.crops import in_picture, sampled, side_of_box, upright_crop
from pipelines.keypoints.onnx_network import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Colours,
    HeatmapCells,
    Layout,
    OnnxNetwork,
    PoseDecoder,
    decoder_for,
    provider_name,
    provider_with_options,
    written_shapes,
)
from pipelines.session.errors import DataError
from pipelines.session.people import SKELETONS, get_skeleton, skeleton_with
from pipelines.session.registries import Person, Region

USAGE = """\
onnx:MODEL.onnx[,option=value...]
MODEL.onnx: top-down, with SimCC or heatmap outputs (RTMPose, HRNet, ViTPose, AlphaPose's FastPose)
people=DETECTOR.onnx: a YOLOX or RTMDet model that finds people; without it BlazePose's does, once fetched
people_norm=none|imagenet, people_colours=bgr|rgb: what that wants; RTMDet is imagenet, YOLOX none [none, bgr]
skeleton=NAME: which joints [by their number]; of more joints the first are taken
heatmap=udp|msra: how a heatmap model was trained: ViTPose udp, plain HRNet and FastPose msra [udp]
mean=R/G/B, std=R/G/B, colours=rgb|bgr: what it wants, of values 0..255 [ImageNet's, rgb]
size=WxH, layout=nchw|nhwc: of its input, where the graph leaves them open
provider=NAME: ONNX Runtime's execution provider that runs it, such as cuda [cpu]"""

Three = tuple[float, float, float]

_OPTION = re.compile(r"[a-z_]+=")
_UNSTATED = {"people", "provider"}
_PEOPLE_NORMS: dict[str, tuple[Three, Three]] = {
    "none": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    "imagenet": (IMAGENET_MEAN, IMAGENET_STD),
}


@dataclass(frozen=True)
class OnnxOptions:
    """Parsed argument of `onnx:`."""

    model: Path
    people: Path | None
    people_colours: Colours
    colours: Colours
    skeleton: str | None
    heatmap: HeatmapCells
    size: tuple[int, int] | None
    layout: Layout | None
    provider: str
    stated: tuple[tuple[str, str], ...]
    """The options as written, sorted, without paths and provider."""


def parse_options(argument: str) -> OnnxOptions:
    """Parse the text after the colon; a path may contain commas.

    Raises:
        DataError: an option is unknown, repeated, or has a value out of its range.
    """
    parts = argument.split(",")
    first = next((i for i, part in enumerate(parts) if i and _OPTION.match(part)), len(parts))
    given: dict[str, str] = {}
    for part in parts[first:]:
        name, _, value = part.partition("=")
        if name in given:
            raise DataError(f"onnx:{argument}", f"states {name} twice", "state it once", code="stated-twice")
        if name not in _READERS:
            raise DataError(
                f"onnx:{argument}",
                f"no option {name!r}",
                f"there are {', '.join(_READERS)}",
                code="no-such-name",
            )
        given[name] = value
    read: dict[str, Any] = {name: _READERS[name](f"{name}={value}", value) for name, value in given.items()}
    colours, people_colours = read.get("colours", "rgb"), read.get("people_colours", "bgr")
    return OnnxOptions(
        model=Path(",".join(parts[:first])).expanduser(),
        people=read.get("people"),
        people_colours=_colours(people_colours, *_PEOPLE_NORMS[read.get("people_norm", "none")]),
        colours=_colours(colours, read.get("mean", IMAGENET_MEAN), read.get("std", IMAGENET_STD)),
        skeleton=read.get("skeleton"),
        heatmap=read.get("heatmap", "udp"),
        size=read.get("size"),
        layout=read.get("layout"),
        provider=read.get("provider", "cpu"),
        stated=tuple(sorted((name, value) for name, value in given.items() if name not in _UNSTATED)),
    )


def _colours(order: Literal["rgb", "bgr"], mean: Three, std: Three) -> Colours:
    """Convert constants stated as R/G/B to the order of the network's channels."""
    return Colours(order, mean, std) if order == "rgb" else Colours(order, mean[::-1], std[::-1])


def _one_of(*choices: str) -> Callable[[str, str], str]:
    def read(place: str, value: str) -> str:
        if value not in choices:
            raise DataError(place, "no such choice", f"there are {', '.join(choices)}", code="no-such-name")
        return value

    return read


def _provider(place: str, value: str) -> str:
    if not re.fullmatch(r"\w+", value, re.ASCII):
        raise DataError(place, "names no execution provider", "write its name, such as cpu or cuda")
    return provider_name(value)


def _three(place: str, value: str) -> Three:
    try:
        red, green, blue = (float(part) for part in value.split("/"))
    except ValueError:
        raise DataError(place, "is not three numbers", "write 123.675/116.28/103.53") from None
    if not all(math.isfinite(number) for number in (red, green, blue)):
        raise DataError(place, "is not finite", "write 123.675/116.28/103.53", code="bad-value")
    return red, green, blue


def _divisors(place: str, value: str) -> Three:
    numbers = _three(place, value)
    if not all(number > 0 for number in numbers):
        raise DataError(place, "must be above 0", "write 255/255/255 for values of 0..1", code="bad-value")
    return numbers


def _wide_and_high(place: str, value: str) -> tuple[int, int]:
    found = re.fullmatch(r"([1-9]\d{1,3})x([1-9]\d{1,3})", value)
    if found is None:
        raise DataError(place, "is no size", "write width x height: size=192x256")
    return int(found[1]), int(found[2])


_READERS: dict[str, Callable[[str, str], object]] = {
    "people": lambda _, value: Path(value).expanduser(),
    "people_norm": _one_of(*_PEOPLE_NORMS),
    "people_colours": _one_of("bgr", "rgb"),
    "skeleton": _one_of(*SKELETONS),
    "heatmap": _one_of(*get_args(HeatmapCells)),
    "mean": _three,
    "std": _divisors,
    "colours": _one_of("rgb", "bgr"),
    "size": _wide_and_high,
    "layout": _one_of(*get_args(Layout)),
    "provider": _provider,
}


# RTMLib draws boxes from this score on.
_MIN_BOX_SCORE = 0.3
# YOLOX joins boxes from this intersection over union on.
_SAME_PERSON_IOU = 0.45
_STRIDES = (8, 16, 32)
# YOLOX was trained with this grey beside the picture.
_PADDING_GREY = 114
# This is the class of persons in COCO, and in every list of persons alone.
_PERSON_CLASS = 0


class OnnxPeople:
    """Person detector. Not thread-safe."""

    def __init__(self, network: OnnxNetwork) -> None:
        self._network = network
        width, height = network.size
        self._grid = _grid(width, height)

    def find(self, picture: Picture) -> tuple[Float, Float]:
        """Find people in a picture [H, W, 3] BGR, best first.

        The picture is fitted into the top left of the network's input. The network counts from the edge of
        the first pixel, the boxes returned from its centre.

        Returns:
            Boxes [N, 4] (left, top, right, bottom) in px, and scores [N].

        Raises:
            DataError: the network's outputs are of no known kind.
        """
        width, height = self._network.size
        scale = max(picture.shape[1] / width, picture.shape[0] / height)
        placed = np.array([[scale, 0.0, (scale - 1) / 2], [0.0, scale, (scale - 1) / 2]])
        fitted = sampled(picture, placed, (width, height), beyond="edge")
        fitted[int(np.ceil(picture.shape[0] / scale)) :] = _PADDING_GREY
        fitted[:, int(np.ceil(picture.shape[1] / scale)) :] = _PADDING_GREY
        boxes, score = self._read(self._network.single(fitted))
        sure = score >= _MIN_BOX_SCORE
        boxes, score = boxes[sure], score[sure]
        kept = distinct(boxes, score)
        return boxes[kept] * scale - 0.5, score[kept]

    def _read(self, outputs: Mapping[str, NDArray[Any]]) -> tuple[Float, Float]:
        """Read boxes [N, 4] in pixels of the input and scores [N], before any filtering."""
        tables = [np.asarray(v, np.float64) for v in outputs.values() if v.dtype.kind == "f"]
        tables = [table[0] if table.ndim == 3 and len(table) == 1 else table for table in tables]
        labels = [np.ravel(v) for v in outputs.values() if v.dtype.kind in "iu"]
        if len(tables) == 1 and tables[0].ndim == 2:
            (table,) = tables
            count, columns = table.shape
            if columns >= 6 and count == len(self._grid):
                return _raw_yolox(table, self._grid)
            if columns == 5 and len(labels) <= 1:
                persons = (
                    labels[0] == _PERSON_CLASS if labels and len(labels[0]) == count else np.full(count, True)
                )
                return table[persons, :4], table[persons, 4]
            if columns == 6 and not labels:
                persons = table[:, 5] == _PERSON_CLASS
                return table[persons, :4], table[persons, 4]
        shapes = {name: values.shape for name, values in outputs.items()}
        raise DataError(
            self._network.path,
            f"its outputs are not understood: {written_shapes(shapes)}",
            "expected boxes with scores, [1,N,5] and labels [1,N], or [N,6], or"
            f" YOLOX's [1,{len(self._grid)},5+C]",
        )


def distinct(boxes: Float, score: Float) -> NDArray[np.intp]:
    """Return row numbers of boxes [N, 4], best first, without those that overlap a better one (greedy)."""
    size = np.maximum(boxes[:, 2:] - boxes[:, :2], 0.0)
    area = size[:, 0] * size[:, 1]
    left = np.argsort(-score, kind="stable")
    kept = []
    while len(left):
        best, rest = left[0], left[1:]
        kept.append(best)
        low = np.maximum(boxes[best, :2], boxes[rest, :2])
        high = np.minimum(boxes[best, 2:], boxes[rest, 2:])
        common = np.prod(np.maximum(high - low, 0.0), axis=1)
        left = rest[common <= _SAME_PERSON_IOU * (area[best] + area[rest] - common)]
    return np.array(kept, dtype=np.intp)


def _grid(width: int, height: int) -> Float:
    """Return column, row and stride [G, 3] of the cells to which YOLOX's rows belong."""
    levels = []
    for stride in _STRIDES:
        x, y = np.meshgrid(np.arange(width // stride), np.arange(height // stride))
        levels.append(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, stride)]))
    return np.concatenate(levels).astype(np.float64)


def _raw_yolox(table: Float, grid: Float) -> tuple[Float, Float]:
    """Decode raw YOLOX rows [G, 5 + C]: centre, log size, objectness and class probabilities.

    Ge et al., "YOLOX: Exceeding YOLO Series in 2021", the authors' `demo_postprocess`.
    """
    stride = grid[:, 2:]
    centre = (table[:, :2] + grid[:, :2]) * stride
    half = np.exp(np.minimum(table[:, 2:4], 20.0)) * stride / 2
    is_person = table[:, 5:].argmax(axis=1) == _PERSON_CLASS
    return np.hstack([centre - half, centre + half]), np.where(is_person, table[:, 4] * table[:, 5], 0.0)


# MMPose enlarges boxes by this factor before it cuts them out.
_BOX_PADDING = 1.25
# MMPose draws joints above this score, and they place the next region here.
_MIN_JOINT_SCORE = 0.3
_EYES, _ANKLES = 0.936, 0.039  # heights above the ground, as shares of the body's (Drillis & Contini)


class FindsPeople(Protocol):
    """Source of regions."""

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find people; see `KeypointNetworks.find_people`."""


class OnnxPose:
    """Loaded networks. Not thread-safe.

    Args:
        decoder: reads its outputs.
        joints: names of its first joints; further joints are left out.
        people: finder of people; None if only the log gives their place.
    """

    def __init__(
        self, network: OnnxNetwork, decoder: PoseDecoder, joints: tuple[str, ...], people: FindsPeople | None
    ) -> None:
        self._network = network
        self._decoder = decoder
        self._joints = joints
        self._people = people
        self._share = (1.0 if "head" in joints else _EYES) - (0.0 if "left_heel" in joints else _ANKLES)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self._joints

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find people in a picture [H, W, 3] BGR, best first; none without a person detector."""
        return [] if self._people is None else self._people.find_people(picture)

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        """Locate the joints of the person in each region, in one run if the graph's batch is open.

        `presence` is the share of joints with a score of at least 0.3.
        """
        if not regions:
            return []
        placed = [upright_crop(region, self._network.size) for region in regions]
        crops = np.stack([sampled(picture, crop, self._network.size, beyond="black") for crop in placed])
        xy, score = self._decoder.decode(self._network.batch(crops, self._decoder.outputs))
        count = len(self._joints)
        return [
            self._person(in_picture(own[:count], crop), sure[:count], region)
            for own, sure, crop, region in zip(xy, score, placed, regions, strict=True)
        ]

    def _person(self, xy: Float, score: Float, region: Region) -> Person:
        sure = score >= _MIN_JOINT_SCORE
        return Person(xy, score, float(sure.mean()), self._next_region(xy[sure], region))

    def _next_region(self, xy: Float, region: Region) -> Region:
        """Compute the region of the body with these joints; keep the old region for fewer than two joints.

        Joints reach from the ankles to the eyes only, unless the skeleton has heels and the head's top.
        """
        if len(xy) < 2:
            return region
        low, high = xy.min(axis=0), xy.max(axis=0)
        width, height = (high - low) / self._share
        x, y = (low + high) / 2
        return Region((float(x), float(y)), side_of_box(width, height, self._network.size, _BOX_PADDING))


class _BoxedPeople:
    """Adapter from a person detector's boxes to regions for a pose model of that input size."""

    def __init__(self, people: OnnxPeople, size: tuple[int, int]) -> None:
        self._people = people
        self._size = size

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        boxes, score = self._people.find(picture)
        middle = (boxes[:, :2] + boxes[:, 2:]) / 2
        return [
            (
                Region(
                    (float(x), float(y)), side_of_box(right - left, bottom - top, self._size, _BOX_PADDING)
                ),
                float(sure),
            )
            for (x, y), (left, top, right, bottom), sure in zip(middle, boxes.tolist(), score, strict=True)
        ]


@dataclass(frozen=True)
class OnnxDetector:
    """Pose model with its options."""

    options: OnnxOptions

    @property
    def name(self) -> str:
        """The options without paths, and what runs the model, since another gives other last digits."""
        stated = {**dict(self.options.stated), "provider": provider_with_options(self.options.provider)}
        return "onnx:" + ",".join(f"{name}={value}" for name, value in sorted(stated.items()))

    @property
    def provider(self) -> str:
        """The short name of the execution provider that runs the networks."""
        return self.options.provider

    @property
    def title(self) -> str:
        """File name of the model, and the finder of people."""
        if self.options.people is not None:
            finder = f"people found by {self.options.people.name}"
        elif self._has_blazepose:
            finder = "people found by BlazePose's person detector"
        else:
            finder = "no person detector: people are seen only where the log says that the actor is"
        return f"{self.options.model.name} ({finder})"

    @property
    def _has_blazepose(self) -> bool:
        return None not in BLAZEPOSE.models().values()

    def models(self) -> dict[str, Path | None]:
        """Return the files of the pose model and of the person detector, None where missing."""
        paths: dict[str, Path | None] = {"pose": self.options.model}
        if self.options.people is not None:
            paths["people"] = self.options.people
        elif self._has_blazepose:
            paths |= {f"people {name}": path for name, path in BLAZEPOSE.models().items()}
        return {name: path if path is not None and path.is_file() else None for name, path in paths.items()}

    def fetch(self, source: Path | None = None) -> None:  # noqa: ARG002  # the protocol's
        """Refuse: the user's own models cannot be fetched.

        Raises:
            DataError: always.
        """
        raise DataError("onnx", "is your own model", "write --detector onnx:MODEL.onnx")

    def load(self, *, threads: int) -> OnnxPose:
        """Load the networks; the results do not depend on `threads`.

        Raises:
            DataError: ONNX Runtime or a file is missing, or a model is of no known kind.
        """
        options = self.options
        network = OnnxNetwork(
            options.model,
            options.colours,
            provider=options.provider,
            size=options.size,
            layout=options.layout,
            threads=threads,
        )
        decoder = decoder_for(options.model, network.shapes, network.size, options.heatmap)
        joints = _joints(options.model, decoder, options.skeleton)
        return OnnxPose(network, decoder, joints, self._load_people(network.size, threads))

    def _load_people(self, size: tuple[int, int], threads: int) -> FindsPeople | None:
        options = self.options
        if options.people is not None:
            people = OnnxNetwork(
                options.people, options.people_colours, provider=options.provider, threads=threads
            )
            return _BoxedPeople(OnnxPeople(people), size)
        return BLAZEPOSE.load_person_finder(threads=threads) if self._has_blazepose else None


def _joints(path: Path, decoder: PoseDecoder, stated: str | None) -> tuple[str, ...]:
    if stated is not None:
        joints = get_skeleton(stated).joints
        if len(joints) > decoder.count:
            raise DataError(
                path, f"has {decoder.count} joints, and {stated} {len(joints)}", "state another skeleton"
            )
        return joints
    known = skeleton_with(decoder.count)
    if not known:
        raise DataError(
            path,
            f"has {decoder.count} joints, which no known skeleton has",
            "state whose come first: skeleton=coco17 for COCO-WholeBody, skeleton=halpe26 for Halpe",
        )
    return known[0].joints


class OnnxFamily:
    """Family of detectors `onnx:...` for `mocap models` and `--detector`."""

    name = "onnx"
    title = "Your own top-down model (ONNX Runtime)"
    usage = USAGE

    def configured(self, argument: str) -> OnnxDetector:
        """Build the detector from a model and its options.

        Raises:
            DataError: the file is missing, or an option is wrong.
        """
        options = parse_options(argument)
        for path in (options.model, options.people):
            if path is not None and not path.is_file():
                raise DataError(path, "does not exist", "give the path of an ONNX model", code="no-such-file")
        people = None if options.people is None else options.people.absolute()
        # Other processes, with other working directories, may run it.
        return OnnxDetector(replace(options, model=options.model.absolute(), people=people))


DETECTOR = OnnxFamily()
