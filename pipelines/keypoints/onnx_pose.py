"""Detector `onnx:MODEL.onnx`: the user's own top-down model, run by ONNX Runtime.

Crops follow MMPose's top-down models: upright, the box of a person padded by 1.25, the aspect of the
network's input kept. Positions are pixels, the centre of the top left one at (0, 0). Outputs are:

- SimCC (Li et al., "SimCC: a Simple Coordinate Classification Perspective", 2022; RTMPose): one score for
  each bin of x and of y, `split` bins to a pixel; bin b lies at b / split, as MMPose encodes and decodes.
  Networks are trained on Gaussians of several bins, so their scores are about the logarithm of a Gaussian: a
  parabola. It is fitted by least squares to the best bin and two on either side; the joint is at its top.
- Heatmaps (HRNet, ViTPose, AlphaPose's FastPose): cell k of w lies at k (W - 1) / (w - 1) where they were
  trained unbiased (`udp`: Huang et al., "The Devil Is in the Details", 2020; ViTPose), and at k W / w where
  not (`msra`: HRNet and FastPose as published). Between the cells, the logarithm of the smoothed map is
  developed to the second order about the best cell (DARK: Zhang et al., "Distribution-Aware Coordinate
  Representation", 2020): exact for a Gaussian.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import PydanticCustomError

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.blazepose import DETECTOR as BLAZEPOSE
from pipelines.keypoints.blazepose import sampled
from pipelines.session.errors import DataError
from pipelines.session.people import SKELETONS, get_skeleton, skeleton_with
from pipelines.session.registries import Person, Region, need
from pipelines.session.yaml_files import OPTION_CODES, checked
from pipelines.session.yaml_models import YamlModel

USAGE = """\
onnx:MODEL.onnx[,option=value...]
MODEL.onnx: top-down, with SimCC or heatmap outputs (RTMPose, HRNet, ViTPose, AlphaPose's FastPose)
people=DETECTOR.onnx: a model that finds people, RTMDet or YOLOX with boxes and scores; else BlazePose's does
people_norm=none|imagenet, people_colours=bgr|rgb: what that wants; RTMDet is imagenet, YOLOX none [none, bgr]
skeleton=NAME: which joints [by their number]; of more joints the first are taken
heatmap=udp|msra: how a heatmap model was trained: ViTPose udp, plain HRNet and FastPose msra [udp]
mean=R/G/B, std=R/G/B, colours=rgb|bgr: what it wants, of values 0..255 [ImageNet's, rgb]
size=WxH: of its input, where the graph leaves it open
provider=NAME: ONNX Runtime's execution provider that runs it, such as cuda [cpu]"""

HeatmapCells = Literal["udp", "msra"]
Three = tuple[float, float, float]
_IMAGENET: tuple[Three, Three] = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
_PEOPLE_NORMS: dict[str, tuple[Three, Three]] = {
    "none": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    "imagenet": _IMAGENET,
}

# Unasked, CUDA times its algorithms and takes the fastest, so that two runs may differ.
_PROVIDER_OPTIONS = {"cuda": {"cudnn_conv_algo_search": "HEURISTIC"}}
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
# This is ONNX Runtime's quietest level, because failures are reported here as DataError.
_FATAL = 4


# --- options -------------------------------------------------------------------------------------------


def _short_name(provider: str) -> str:
    """Return the short name of an execution provider: `cuda` for `CUDAExecutionProvider` and `CUDA`."""
    return provider.lower().removesuffix("executionprovider")


def _known_skeleton(name: str) -> str:
    if name not in SKELETONS:
        raise PydanticCustomError("literal_error", "there are {names}", {"names": ", ".join(SKELETONS)})
    return name


Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Side = Annotated[int, Field(ge=10, lt=10_000)]
Colours = Literal["rgb", "bgr"]
_BY_SLASHES = BeforeValidator(lambda text: text.split("/") if isinstance(text, str) else text)
_BY_X = BeforeValidator(lambda text: text.split("x") if isinstance(text, str) else text)


class OnnxOptions(YamlModel):
    """Parsed argument of `onnx:`."""

    model: Path
    people: Path | None = None
    people_norm: Literal["none", "imagenet"] = "none"
    people_colours: Colours = "bgr"
    skeleton: Annotated[str, AfterValidator(_known_skeleton)] | None = None
    heatmap: HeatmapCells = "udp"
    mean: Annotated[tuple[Number, Number, Number], _BY_SLASHES] = _IMAGENET[0]
    std: Annotated[tuple[Positive, Positive, Positive], _BY_SLASHES] = _IMAGENET[1]
    colours: Colours = "rgb"
    size: Annotated[tuple[Side, Side], _BY_X] | None = None
    provider: Annotated[str, Field(pattern=r"^\w+$"), AfterValidator(_short_name)] = "cpu"
    stated: tuple[tuple[str, str], ...] = ()
    """The options as written, sorted, without paths and provider."""


def parse_options(argument: str) -> OnnxOptions:
    """Parse the text after the colon; a path may hold commas. DataError: an unknown or bad option."""
    parts = argument.split(",")
    first = next((i for i, part in enumerate(parts) if i and re.match(r"[a-z_]+=", part)), len(parts))
    given = {"model": ",".join(parts[:first]), "stated": ""}
    unstated = (*given, "people", "provider")
    for part in parts[first:]:
        name, _, value = part.partition("=")
        if name in given:
            raise DataError(f"onnx:{argument}", f"states {name} twice", "state it once", code="stated-twice")
        given[name] = value
    values: dict[str, object] = {**given}
    values["stated"] = tuple(sorted((name, given[name]) for name in given if name not in unstated))
    values |= {name: Path(str(values[name])).expanduser() for name in ("model", "people") if name in values}
    return checked(OnnxOptions, values, f"onnx:{argument}", OPTION_CODES)


# --- a network -----------------------------------------------------------------------------------------


class OnnxNetwork:
    """Loaded model with one picture as input. Not thread-safe: each thread needs its own.

    `order` is that of its channels, `norm` mean and standard deviation of red, green and blue: its input is
    (value 0..255 - mean) / std. `size` are width and height of its input, to be given where the graph leaves
    them open, `shapes` those of the outputs, by name, for one picture. DataError: not a model that ONNX
    Runtime can run, or not one of a single picture as input; no such provider.
    """

    def __init__(
        self,
        path: Path,
        order: str,
        norm: tuple[Three, Three],
        *,
        provider: str,
        size: tuple[int, int] | None = None,
        threads: int,
    ) -> None:
        self.path = path
        self._step = 1 if order == "rgb" else -1
        self._mean, self._std = (np.array(of[:: self._step], np.float32) for of in norm)
        self._session = _session(path, provider, threads)
        (given, *more) = self._session.get_inputs()
        shape = given.shape
        nchw = len(shape) == 4 and (shape[1] == 3 or not isinstance(shape[1], int))
        if more or len(shape) != 4 or given.type not in _TYPES or not (nchw or shape[3] == 3):
            remedy = "it must be one picture of floats, [N,3,H,W] or [N,H,W,3]"
            raise DataError(path, f"its input is {given.type} {_written(shape)}", remedy, code="wrong-model")
        self._input, self._type = given.name, _TYPES[given.type]
        # A graph that leaves both axes open is what the exporters of PyTorch write, channels first.
        self._nchw = nchw and not (shape[3] == 3 and shape[1] != 3)
        self._batch: int | None = shape[0] if isinstance(shape[0], int) else None
        self.size = _size(path, shape[2:] if self._nchw else shape[1:3], size)
        blank = np.zeros((self._batch or 1, *self.size[::-1], 3), np.uint8)
        self.shapes = {name: values.shape for name, values in self.run(blank).items()}

    def batch(self, rgb: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Compute outputs [N, ...] for RGB pictures [N, H, W, 3] 0..255; fixed batches are padded."""
        step = self._batch or len(rgb)
        short = -len(rgb) % step
        filled = np.concatenate([rgb, np.zeros((short, *rgb.shape[1:]), np.uint8)])
        parts = [self.run(filled[first : first + step]) for first in range(0, len(filled), step)]
        return {name: np.concatenate([part[name] for part in parts])[: len(rgb)] for name in parts[0]}

    def run(self, rgb: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """Compute all outputs, by name, in one run; their first axis need not be the batch."""
        pixels = np.array(rgb[..., :: self._step], np.float32, order="C")  # in place is several times faster
        pixels -= self._mean
        pixels /= self._std
        if self._nchw:
            pixels = np.ascontiguousarray(np.moveaxis(pixels, -1, 1))
        names = [output.name for output in self._session.get_outputs()]
        try:
            values = self._session.run(names, {self._input: pixels.astype(self._type, copy=False)})
        except Exception as error:  # ONNX Runtime's exceptions share no other base
            problem = f"does not run on an input of {_written(pixels.shape)} ({_line(error)})"
            raise DataError(self.path, problem, code="wrong-model") from None
        return dict(zip(names, map(np.asarray, values), strict=True))

    def not_understood(self, expected: str) -> DataError:
        """Return the error for outputs that nothing here decodes."""
        shapes = ", ".join(f"{name} {_written(shape)}" for name, shape in self.shapes.items())
        width, height = self.size
        problem = f"its outputs are not understood: {shapes} for an input of {width}x{height}"
        return DataError(self.path, problem, f"expected {expected}", code="wrong-model")


def _session(path: Path, provider: str, threads: int) -> Any:
    runtime = need("onnxruntime", "onnx")
    if not path.is_file():
        raise DataError(path, "does not exist", "give the path of an ONNX model", code="no-such-file")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _FATAL
    there = {_short_name(full): full for full in runtime.get_available_providers()}
    place = f"--detector ...,provider={provider}"
    if provider not in there:
        remedy = f"there are {', '.join(sorted(there))}; other builds of it, as onnxruntime-gpu, have others"
        raise DataError(place, "is not in this ONNX Runtime", remedy, code="missing-library")
    wanted = there[provider]
    given = [(wanted, _PROVIDER_OPTIONS.get(provider, {}))]
    try:
        session = runtime.InferenceSession(str(path), options, providers=given)
    except Exception as error:  # ONNX Runtime's exceptions share no other base
        problem = f"is no model that ONNX Runtime can run ({_line(error)})"
        raise DataError(path, problem, code="wrong-kind") from None
    if session.get_providers()[0] != wanted:
        raise DataError(place, "could not be started", "leave it out: the CPU runs it", code="bad-option")
    return session


def _size(path: Path, shape: Sequence[object], stated: tuple[int, int] | None) -> tuple[int, int]:
    height, width = shape
    if isinstance(height, int) and isinstance(width, int):
        if stated not in (None, (width, height)):
            raise DataError(path, f"its input is {width}x{height}", "leave the size away", code="bad-option")
        return width, height
    if stated is None:
        remedy = "state it: size=192x256 (width x height)"
        raise DataError(path, "leaves the size of its input open", remedy, code="bad-option")
    return stated


def _written(shape: Sequence[object]) -> str:
    return "[" + ",".join(str(length) if isinstance(length, int) else "?" for length in shape) + "]"


def _line(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:200]


# --- decoding ------------------------------------------------------------------------------------------

_SMOOTHING_CELLS, _SMOOTHING_SIGMA = 11, 2.0  # DARK's kernel for 64 x 48 cells
# The refinement looks at this many bins on either side of the best one.
_REACH_BINS = 2
# The logarithm of a heatmap needs values above 0, as in DARK.
_FLOOR = 1e-10


@dataclass(frozen=True)
class PoseDecoder:
    """Decoder of scores in x and y, or heatmaps, of `count` joints, with bins or cells [2] for each pixel."""

    outputs: tuple[str, ...]
    count: int
    per_px: tuple[float, float]

    def decode(self, outputs: Mapping[str, NDArray[Any]]) -> tuple[Float, Float]:
        """Decode joints [N, K, 2] in pixels of the input, NaN if no score is above 0, and scores [N, K]."""
        maps = [outputs[name].astype(np.float64) for name in self.outputs]
        place, score = simcc_peaks(*maps) if len(maps) == 2 else heatmap_peaks(maps[0])
        xy = place / np.array(self.per_px)
        return np.where((score > 0)[..., None], xy, np.nan), np.clip(score, 0.0, 1.0)


def decoder_for(network: OnnxNetwork, cells: HeatmapCells) -> PoseDecoder:
    """Choose the decoder of a network's outputs from their shapes; DataError: they are of no known kind."""
    width, height = network.size
    lines = {name: shape for name, shape in network.shapes.items() if len(shape) == 3}
    if len(lines) == 2 and len({shape[1] for shape in lines.values()}) == 1:
        for x, y in (tuple(lines), tuple(lines)[::-1]):
            split = lines[x][2] / width
            if split >= 1 and split == lines[y][2] / height:
                return PoseDecoder((x, y), lines[x][1], (split, split))
    maps = {name: shape for name, shape in network.shapes.items() if len(shape) == 4}
    if len(maps) == 1:
        ((name, (_, count, rows, columns)),) = maps.items()
        if 1 < rows <= height and 1 < columns <= width and columns * height == rows * width:
            inner = int(cells == "udp")
            per_px = (columns - inner) / (width - inner), (rows - inner) / (height - inner)
            return PoseDecoder((name,), count, per_px)
    raise network.not_understood(
        f"SimCC, [N,K,{width}s] and [N,K,{height}s], or heatmaps, [N,K,{height}/s,{width}/s]"
    )


def simcc_peaks(x: Float, y: Float) -> tuple[Float, Float]:
    """Find joints [N, K, 2] in bins and their scores [N, K], the smaller of the best scores in x and y."""
    places, scores = zip(*(_line_peaks(line) for line in (x, y)), strict=True)
    return np.stack(places, axis=-1), np.minimum(*scores)


def _line_peaks(scores: Float) -> tuple[Float, Float]:
    """Find the tops [N, K] of parabolas around the best bins of [N, K, B], and the scores [N, K] there."""
    last = scores.shape[-1] - 1
    best = scores.argmax(axis=-1)
    offset = np.arange(-_REACH_BINS, _REACH_BINS + 1)
    around = np.take_along_axis(scores, np.clip(best[..., None] + offset, 0, last), axis=-1)
    slope = np.einsum("nkd,d->nk", around, offset) / 10
    bend = np.einsum("nkd,d->nk", around, offset**2 - 2) / 14
    inside = (best >= _REACH_BINS) & (best <= last - _REACH_BINS) & (bend < 0)
    shift = np.where(inside, -slope / np.where(inside, 2 * bend, 1.0), 0.0)
    return best + np.clip(shift, -1.0, 1.0), around[..., _REACH_BINS]


def heatmap_peaks(maps: Float) -> tuple[Float, Float]:
    """Find joints [N, K, 2] in cells, by one Newton step from the largest values [N, K] of maps."""
    people, joints, rows, columns = maps.shape
    flat = maps.reshape(people * joints, rows, columns)
    index = flat.reshape(len(flat), -1).argmax(axis=1)
    row, column = np.divmod(index, columns)
    score = flat[np.arange(len(flat)), row, column]
    place = np.column_stack([column, row]).astype(np.float64)
    inside = (row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1) & (score > 0)
    place[inside] += _newton_steps(_log_around(flat[inside], row[inside], column[inside]))
    return place.reshape(people, joints, 2), score.reshape(people, joints)


def _log_around(maps: Float, row: NDArray[np.intp], column: NDArray[np.intp]) -> Float:
    """Compute the logarithm [M, 3, 3] of smoothed maps [M, h, w] around one cell each, padded with 0."""
    reach = _SMOOTHING_CELLS // 2
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SMOOTHING_SIGMA) ** 2)
    shifted = np.stack([np.pad(kernel / kernel.sum(), (shift, 2 - shift)) for shift in range(3)])
    padded = np.pad(np.maximum(maps, 0.0), ((0, 0), (reach + 1, reach + 1), (reach + 1, reach + 1)))
    offset = np.arange(_SMOOTHING_CELLS + 2)
    which = np.arange(len(maps))[:, None, None]
    part = padded[which, (row[:, None] + offset)[:, :, None], (column[:, None] + offset)[:, None, :]]
    smoothed = np.einsum("mrj,cj->mrc", np.einsum("mij,ri->mrj", part, shifted), shifted)
    around: Float = np.log(np.maximum(smoothed, _FLOOR))
    return around


def _newton_steps(around: Float) -> Float:
    """Compute steps [M, 2] (x, y) from the middle of [M, 3, 3] values to the tops of their paraboloids."""
    dx, dy = (around[:, 1, 2] - around[:, 1, 0]) / 2, (around[:, 2, 1] - around[:, 0, 1]) / 2
    dxx = around[:, 1, 2] - 2 * around[:, 1, 1] + around[:, 1, 0]
    dyy = around[:, 2, 1] - 2 * around[:, 1, 1] + around[:, 0, 1]
    dxy = (around[:, 2, 2] - around[:, 2, 0] - around[:, 0, 2] + around[:, 0, 0]) / 4
    determinant = dxx * dyy - dxy**2
    has_top = (dxx < 0) & (determinant > 0)
    step = np.stack([dxy * dy - dyy * dx, dxy * dx - dxx * dy], axis=1)
    step = step / np.where(has_top, determinant, 1.0)[:, None]
    return np.where(has_top[:, None], np.clip(step, -1.0, 1.0), 0.0)


# --- people --------------------------------------------------------------------------------------------

# RTMLib draws boxes from this score on.
_MIN_BOX_SCORE = 0.3
# YOLOX was trained with this grey beside the picture.
_PADDING_GREY = 114
# This is the class of persons in COCO, and in every list of persons alone.
_PERSON_CLASS = 0
# MMPose enlarges boxes by this factor before it cuts them out.
_BOX_PADDING = 1.25
# MMPose draws joints above this score, and they place the next region here.
_MIN_JOINT_SCORE = 0.3
_EYES, _ANKLES = 0.936, 0.039  # heights above the ground, as shares of the body's (Drillis & Contini)


class FindsPeople(Protocol):
    """Source of regions."""

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find people; see `KeypointNetworks.find_people`."""


class OnnxPeople:
    """Person detector, whose boxes become regions for a pose model of an input `size`. Not thread-safe."""

    def __init__(self, network: OnnxNetwork, size: tuple[int, int]) -> None:
        self._network = network
        self._size = size

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find people in a picture [H, W, 3] BGR, best first.

        The picture is fitted into the top left of the network's input, which counts from the edge of the
        first pixel. DataError: the outputs are not [1, N, 5] boxes with scores, with or without labels.
        """
        width, height = self._network.size
        scale = max(picture.shape[1] / width, picture.shape[0] / height)
        placed = np.array([[scale, 0.0, (scale - 1) / 2], [0.0, scale, (scale - 1) / 2]])
        fitted = sampled(picture, placed, (width, height), beyond="edge")
        fitted[int(np.ceil(picture.shape[0] / scale)) :] = _PADDING_GREY
        fitted[:, int(np.ceil(picture.shape[1] / scale)) :] = _PADDING_GREY
        outputs = list(self._network.run(fitted[None]).values())
        tables = [np.asarray(v, np.float64) for v in outputs if v.dtype.kind == "f"]
        labels = [v for v in outputs if v.dtype.kind in "iu"]
        if len(tables) != 1 or tables[0].ndim != 3 or tables[0].shape[2] != 5 or len(labels) > 1:
            raise self._network.not_understood("boxes with scores, [1,N,5], and their labels, [1,N]")
        table = tables[0][0]
        sure = table[:, 4] >= _MIN_BOX_SCORE
        if labels:
            sure &= np.ravel(labels[0]) == _PERSON_CLASS
        table = table[sure][np.argsort(-table[sure, 4], kind="stable")]
        boxes = table[:, :4] * scale - 0.5
        return [
            (_region_of(box[:2], box[2:], self._size), float(score))
            for box, score in zip(boxes, table[:, 4], strict=True)
        ]


def _region_of(low: Float, high: Float, size: tuple[int, int]) -> Region:
    """Compute the region of a padded box (its corners [2] px) for an input of (width, height)."""
    (x, y), (across, down) = (low + high) / 2, high - low
    longer = max(size)
    side = _BOX_PADDING * max(across * longer / size[0], down * longer / size[1])
    return Region((float(x), float(y)), float(side))


def _upright_crop(region: Region, size: tuple[int, int]) -> Float:
    """Compute picture_from_crop [2, 3] for a region whose side becomes the crop's longer side."""
    scale = region.side / max(size)
    middle = np.array([size[0] - 1, size[1] - 1]) / 2
    return np.column_stack([np.eye(2) * scale, np.array(region.centre) - scale * middle])


class OnnxPose:
    """Loaded networks for one thread; without a finder of people only the log gives their place."""

    def __init__(
        self, network: OnnxNetwork, decoder: PoseDecoder, joints: tuple[str, ...], people: FindsPeople | None
    ) -> None:
        self._network = network
        self._decoder = decoder
        self.joints = joints
        self._people = people
        self._share = (1.0 if "head" in joints else _EYES) - (0.0 if "left_heel" in joints else _ANKLES)

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find people in a picture [H, W, 3] BGR, best first; none without a person detector."""
        return [] if self._people is None else self._people.find_people(picture)

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        """Locate the joints of the person in each region, in one run if the graph's batch is open.

        `presence` is the share of joints with a score of at least 0.3. The next region is that of these
        joints, from the ankles to the eyes only unless the skeleton has heels and the head's top.
        """
        if not regions:
            return []
        size, people = self._network.size, []
        placed = [_upright_crop(region, size) for region in regions]
        crops = np.stack([sampled(picture, crop, size, beyond="black") for crop in placed])
        found = self._decoder.decode(self._network.batch(crops))
        for in_crop, score, crop, region in zip(*found, placed, regions, strict=True):
            count = len(self.joints)
            xy = in_crop[:count] * np.diag(crop[:, :2]) + crop[:, 2]
            sure = score[:count] >= _MIN_JOINT_SCORE
            following = region
            if sure.sum() >= 2:
                middle = (xy[sure].min(axis=0) + xy[sure].max(axis=0)) / 2
                half = np.ptp(xy[sure], axis=0) / 2 / self._share
                following = _region_of(middle - half, middle + half, size)
            people.append(Person(xy, score[:count], float(sure.mean()), following))
        return people


# --- the detector --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OnnxDetector:
    """Pose model with its options."""

    options: OnnxOptions

    @property
    def name(self) -> str:
        """The options without paths, and what runs the model, since another gives other last digits."""
        own = _PROVIDER_OPTIONS.get(self.provider, {})
        provider = ":".join([self.provider, *(f"{option}={value}" for option, value in sorted(own.items()))])
        stated = {**dict(self.options.stated), "provider": provider}
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
        """Refuse, with a DataError: the user's own models cannot be fetched."""
        raise DataError("onnx", "is your own model", "write --detector onnx:MODEL.onnx")

    def load(self, *, threads: int) -> OnnxPose:
        """Load the networks; the results do not depend on `threads`.

        DataError: ONNX Runtime or a file is missing, or a model is of no known kind.
        """
        own = self.options
        norm = own.mean, own.std
        network = OnnxNetwork(
            own.model, own.colours, norm, provider=own.provider, size=own.size, threads=threads
        )
        decoder = decoder_for(network, own.heatmap)
        people: FindsPeople | None = None
        if own.people is not None:
            norm = _PEOPLE_NORMS[own.people_norm]
            finder = OnnxNetwork(own.people, own.people_colours, norm, provider=own.provider, threads=threads)
            people = OnnxPeople(finder, network.size)
        elif self._has_blazepose:
            people = BLAZEPOSE.load_person_finder(threads=threads)
        return OnnxPose(network, decoder, _joints(own.model, decoder.count, own.skeleton), people)


def _joints(path: Path, count: int, stated: str | None) -> tuple[str, ...]:
    known = skeleton_with(count) if stated is None else (get_skeleton(stated),)
    if not known or len(known[0].joints) > count:
        problem = f"has {count} joints, which {'no known skeleton' if stated is None else stated} has not"
        remedy = "state whose come first: skeleton=coco17 for COCO-WholeBody, skeleton=halpe26 for Halpe"
        raise DataError(path, problem, remedy, code="bad-option")
    return known[0].joints


class OnnxFamily:
    """Family of detectors `onnx:...` for `mocap models` and `--detector`."""

    name = "onnx"
    title = "Your own top-down model (ONNX Runtime)"
    usage = USAGE

    def configured(self, argument: str) -> OnnxDetector:
        """Build the detector from a model and its options; DataError: a missing file, or a wrong option."""
        options = parse_options(argument)
        for path in (options.model, options.people):
            if path is not None and not path.is_file():
                raise DataError(path, "does not exist", "give the path of an ONNX model", code="no-such-file")
        people = None if options.people is None else options.people.absolute()
        # Other processes, with other working directories, may run it.
        return OnnxDetector(options.model_copy(update={"model": options.model.absolute(), "people": people}))


DETECTOR = OnnxFamily()
