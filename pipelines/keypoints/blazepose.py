"""Detectors `blazepose` and `blazepose-heavy`: the networks of MediaPipe's pose solution, run by LiteRT.

BlazePose GHUM has a person detector and landmark networks of three sizes, with the same inputs and outputs;
`full` and `heavy` are used here.

The code around the networks follows MediaPipe 0.10.21 (Bazarevsky et al., BlazePose: On-device Real-time
Body Pose Tracking, 2020; the calculators are named where they are followed), except for two things:

- Positions are ours: the centre of the top left pixel is (0, 0). MediaPipe takes the edges of its crops
  for the centres of pixels when it samples, and for edges when it reports. On 2639 joints of mirrored crops
  the networks themselves count from the edges to within 0.05 of a crop's pixel, which settles it.
- A joint's confidence is the peak of its heatmap. Its visibility does not separate bad joints from good.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float, Picture
from pipelines.session.errors import DataError
from pipelines.session.model_files import ModelFile, NpmPackage, PackagedModels, Wheel, find_file
from pipelines.session.people import get_skeleton
from pipelines.session.registries import Measured, Person, Region

if TYPE_CHECKING:
    from ai_edge_litert.interpreter import Interpreter

BLAZEPOSE_MODELS = PackagedModels(
    detector="blazepose",
    package=Wheel(
        "mediapipe",
        "0.10.21",  # the last one that ships models
        tags=("3.11", "cp311", "manylinux_2_28_x86_64"),
    ),
    files=(
        ModelFile(
            "mediapipe/modules/pose_detection/pose_detection.tflite",
            2_959_046,
            "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
        ),
        ModelFile(
            "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
            6_440_512,
            "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
        ),
    ),
)
PERSON_MODELS = replace(BLAZEPOSE_MODELS, files=BLAZEPOSE_MODELS.files[:1])
"""Person detector alone, common to all BlazePose detectors."""

HEAVY_MODELS = PackagedModels(
    detector="blazepose-heavy",
    # The wheel has no heavy network; this package's person detector is another one, and is left alone.
    package=NpmPackage("@mediapipe/pose", "0.5.1675469404"),
    files=(
        ModelFile(
            "package/pose_landmark_heavy.tflite",
            27_709_200,
            "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
        ),
    ),
)

# The person detector's input has this side in pixels.
_PICTURE_SIDE = 224
# The landmark network's input has this side in pixels.
_CROP_SIDE = 256
# Each cell of a heatmap covers this many pixels of the crop.
_CELL = 4
_CELLS = _CROP_SIDE // _CELL
# The network gives 33 joints, two that place the next region, and 4 that MediaPipe does not use.
_LANDMARKS = 39
_CENTRE, _TOP = 33, 34
# MediaPipe counts a person, or the peak of a heatmap, from this score on.
_MIN_SCORE = 0.5
# MediaPipe joins boxes of persons from this intersection over union on.
_SAME_PERSON_IOU = 0.3
PERSON_CONFIDENCE = 0.55
"""Least upper quartile of the confidences of a person's joints, on the mean of a few pictures.

Measured with both networks on the sample flight, a real recording of four cameras and flights with 60
degrees of tilt: medians of people are 0.67 to 0.93, those of tree crowns and furniture 0.29 to 0.55, but for
one of 0.65. `presence` does not tell them apart: most crowns have more than 0.9.
"""
# The side of a region is this many diameters of the circle around the person.
_REGION_MARGIN = 1.25


def sampled(picture: Picture, picture_from_crop: Float, size: tuple[int, int], *, beyond: str) -> Picture:
    """Sample the RGB values [height, width, 3] of a BGR picture at a crop's pixels, bilinear.

    `picture_from_crop` [2, 3] is between pixels, (0, 0) the centre of the first; `beyond` the border is
    repeated (`edge`) or 0 (`black`). OpenCV 4 and the one inside MediaPipe round positions to 1/32 px when
    they warp; OpenCV 5 does not, which moves landmarks by 0.6 px (median) where the crop is coarser than the
    picture. Fixed-point maps are rounded the same way in both.
    """
    import cv2

    column, row = np.arange(size[0]), np.arange(size[1])[:, None]
    x, y = ((a * column + (b * row + c)).astype(np.float32) for a, b, c in picture_from_crop)
    whole, part = cv2.convertMaps(x, y, cv2.CV_16SC2)
    border = cv2.BORDER_REPLICATE if beyond == "edge" else cv2.BORDER_CONSTANT
    values = cv2.remap(picture, whole, part, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(cv2.cvtColor(values, cv2.COLOR_BGR2RGB), np.uint8)


class PersonFinder:
    """Person detector alone. Not thread-safe: each thread needs its own."""

    def __init__(self, person_model: Path, *, threads: int) -> None:
        self._people = _Network(person_model, threads, lowest=-1, outputs=("Identity", "Identity_1"))
        self._anchors = _anchors()

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find people who are tall in a picture [H, W, 3] BGR, best first.

        PoseDetectionCpu: the picture is fitted into 224 x 224, black around; boxes relative to anchors
        (TensorsToDetectionsCalculator) that overlap are merged (NonMaxSuppressionCalculator, WEIGHTED).
        """
        height, width = picture.shape[:2]
        scale = max(height, width) / _PICTURE_SIDE
        corner = (np.array([width, height]) - _PICTURE_SIDE * scale) / 2
        placed = np.column_stack([np.eye(2) * scale, corner])
        fitted = sampled(picture, placed, (_PICTURE_SIDE, _PICTURE_SIDE), beyond="black")
        raw = self._people(fitted)
        score = _sigmoid(raw["Identity_1"][0, :, 0])
        sure = score >= _MIN_SCORE
        numbers = raw["Identity"][0, sure].astype(np.float64) / _PICTURE_SIDE
        points = numbers.reshape(-1, 6, 2)
        points[:, [0, 2, 3, 4, 5]] += self._anchors[sure, None]
        return [
            # The half crop pixel puts the crop where MediaPipe samples it.
            (_shifted(_region(*(merged * _PICTURE_SIDE * scale + corner)), -0.5), float(best))
            for merged, best in _merged(points, score[sure])
        ]


class BlazePose(PersonFinder):
    """Both networks: person detector and landmarks. Not thread-safe: each thread needs its own."""

    def __init__(self, person_model: Path, landmark_model: Path, *, threads: int) -> None:
        super().__init__(person_model, threads=threads)
        outputs = ("Identity", "Identity_1", "Identity_3")
        self._landmarks = _Network(landmark_model, threads, lowest=0, outputs=outputs)

    person_confidence = PERSON_CONFIDENCE

    @property
    def joints(self) -> tuple[str, ...]:
        """The 33 joints of skeleton `blazepose33`."""
        return get_skeleton("blazepose33").joints

    def locate(self, picture: Picture, regions: Sequence[Region]) -> list[Person]:
        """Locate the joints of the person in each region of a picture [H, W, 3] BGR.

        Every joint has a position. Its confidence is the smaller one of the peak of its heatmap within 4
        cells and the network's probability that it lies inside the crop; it is 0 outside the crop.
        """
        return [self._locate(picture, region) for region in regions]

    def _locate(self, picture: Picture, region: Region) -> Person:
        axes = _axes(region)
        picture_from_crop = np.column_stack(
            [axes, np.array(region.centre) - axes @ np.full(2, (_CROP_SIDE - 1) / 2)]
        )
        crop = sampled(picture, picture_from_crop, (_CROP_SIDE, _CROP_SIDE), beyond="edge")
        raw = self._landmarks(crop)
        landmarks = raw["Identity"].reshape(_LANDMARKS, 5).astype(np.float64)
        in_crop, peak = _refined(landmarks[:, :2], raw["Identity_3"][0])
        xy = (in_crop - 0.5) @ picture_from_crop[:, :2].T + picture_from_crop[:, 2]
        inside = _sigmoid(landmarks[:, 4])
        count = len(self.joints)
        return Person(
            xy=xy[:count],
            confidence=np.minimum(peak, inside)[:count],
            presence=float(raw["Identity_1"].item()),
            region=_region(xy[_CENTRE], xy[_TOP]),
        )


@dataclass(frozen=True)
class BlazePoseDetector:
    """BlazePose as registered for `mocap models` and the stages: a person detector and a landmark network."""

    name: str
    title: str
    person_models: PackagedModels  # one file
    landmark_models: PackagedModels  # its last file is the landmark network
    measured: Measured

    def models(self) -> dict[str, Path | None]:
        """Return the files of both networks: name to path, None where missing."""
        return self.person_models.present() | self.landmark_models.present()

    def fetch(self, source: Path | None = None) -> None:
        """Get the missing files; pip downloads the person detector if the source does not hold it."""
        self.landmark_models.fetch(source)
        of_person = self.person_models.files[0].name
        held = source is not None and source.is_dir() and find_file(source, of_person) is not None
        self.person_models.fetch(source if held else None)

    def load(self, *, threads: int) -> BlazePose:
        """Load the networks; the results do not depend on `threads`.

        DataError: a file is missing or is not the one that was expected.
        """
        *_, landmark_model = self.landmark_models.verified().values()
        (person_model,) = self.person_models.verified().values()
        return BlazePose(person_model, landmark_model, threads=threads)

    def load_person_finder(self, *, threads: int) -> PersonFinder:
        """Load the person detector alone, for other networks; raises the errors of `load`."""
        (person_model,) = self.person_models.verified().values()
        return PersonFinder(person_model, threads=threads)


DETECTOR = BlazePoseDetector(
    "blazepose",
    "BlazePose GHUM full (MediaPipe 0.10.21, Apache-2.0): 33 joints, on the CPU",
    PERSON_MODELS,
    BLAZEPOSE_MODELS,
    Measured(sample_mpjpe_mm=25.5, person_ms=18.0),
)
HEAVY = BlazePoseDetector(
    "blazepose-heavy",
    "BlazePose GHUM heavy (@mediapipe/pose 0.5.1675469404, Apache-2.0): 33 joints, on the CPU",
    PERSON_MODELS,
    HEAVY_MODELS,
    Measured(sample_mpjpe_mm=20.8, person_ms=60.0),
)


class _Network:
    """LiteRT model with one picture as input, values in [lowest, 1]; returns the named output tensors."""

    def __init__(self, path: Path, threads: int, *, lowest: int, outputs: tuple[str, ...]) -> None:
        from ai_edge_litert.interpreter import Interpreter

        with _quiet_stderr():
            try:
                self._interpreter: Interpreter = Interpreter(str(path), num_threads=threads)
            except ValueError as error:
                raise DataError(path, f"is no readable model ({error})", code="damaged") from None
            self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        tensors = {tensor["name"]: tensor["index"] for tensor in self._interpreter.get_output_details()}
        self._outputs = {name: tensors[name] for name in outputs}
        self._lowest = np.float32(lowest)
        self._step = np.float32((1 - lowest) / 255)

    def __call__(self, rgb: Picture) -> dict[str, NDArray[Any]]:
        values = self._interpreter.tensor(self._input)()[0]  # the network's own input memory
        np.multiply(rgb, self._step, out=values)
        if self._lowest:
            values += self._lowest
        del values  # LiteRT does not run while other code holds its memory
        self._interpreter.invoke()
        return {name: self._interpreter.get_tensor(index) for name, index in self._outputs.items()}


_stderr_lock = threading.Lock()


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Silence the stderr of the process: LiteRT prints to it from C++ and has no switch to stop this."""
    with _stderr_lock:
        sys.stderr.flush()
        kept = os.dup(2)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(nowhere)
            os.close(kept)


def _anchors() -> Float:
    """Compute the anchor centres [2254, 2] of the person detector, as shares of its input."""
    grids = []
    for cells, each in ((28, 2), (14, 2), (7, 6)):
        centre = (np.arange(cells) + 0.5) / cells
        x, y = np.meshgrid(centre, centre)
        grids.append(np.repeat(np.column_stack([x.ravel(), y.ravel()]), each, axis=0))
    return np.concatenate(grids)


def _merged(points: Float, score: Float) -> Iterator[tuple[Float, np.float64]]:
    """Merge all boxes that overlap the best one into one answer, then do the same with the rest."""
    low, high = points[:, 0] - points[:, 1] / 2, points[:, 0] + points[:, 1] / 2
    area = np.prod(high - low, axis=1)
    left = np.argsort(-score, kind="stable")
    while len(left):
        best = left[0]
        common = np.prod(
            np.clip(np.minimum(high[best], high[left]) - np.maximum(low[best], low[left]), 0, None), 1
        )
        same = common > _SAME_PERSON_IOU * (area[best] + area[left] - common)
        same[0] = True
        group = left[same]
        yield np.average(points[group, 2:4], axis=0, weights=score[group]), score[best]
        left = left[~same]


def _region(centre: Float, top: Float) -> Region:
    """Compute the square around a person from the middle of the hips and the top of the body circle."""
    right, down = top - centre
    return Region(
        centre=(float(centre[0]), float(centre[1])),
        side=float(2 * np.hypot(right, down) * _REGION_MARGIN),
        angle_rad=float(np.arctan2(right, -down)),
    )


def _shifted(region: Region, crop_px: float) -> Region:
    x, y = _axes(region) @ np.full(2, crop_px) + region.centre
    return Region((float(x), float(y)), region.side, region.angle_rad)


def _axes(region: Region) -> Float:
    """Return [2, 2] columns: one crop pixel to the right and one down, in the picture's pixels."""
    cosine, sine = np.cos(region.angle_rad), np.sin(region.angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]]) * region.side / _CROP_SIDE


def _refined(in_crop: Float, heatmap: NDArray[np.floating[Any]]) -> tuple[Float, Float]:
    """Refine positions to the weighted middle of the heatmap around them, and return its peak there."""
    cell = np.trunc(in_crop / _CELL).astype(np.int64)[:, :, None] + np.arange(-4, 5)  # [L, xy, 9]
    exists = (cell >= 0) & (cell < _CELLS)
    x, y = np.moveaxis(np.clip(cell, 0, _CELLS - 1), 1, 0)
    joint = np.arange(len(in_crop))[:, None, None]
    here = _sigmoid(heatmap[y[:, :, None], x[:, None, :], joint])  # [L, row, column]
    centred = exists[:, 0, 4] & exists[:, 1, 4]
    here = np.where(exists[:, 1, :, None] & exists[:, 0, None, :] & centred[:, None, None], here, 0.0)
    peak = here.max(axis=(1, 2))
    total = np.maximum(here.sum(axis=(1, 2)), np.finfo(float).tiny)
    middle = np.stack([np.einsum("lrc,lc->l", here, x), np.einsum("lrc,lr->l", here, y)], 1) / total[:, None]
    return np.where((peak >= _MIN_SCORE)[:, None], middle * _CELL, in_crop), peak


def _sigmoid(logit: NDArray[np.floating[Any]]) -> Float:
    # Beyond 60 nothing changes but the overflow warning.
    return 1 / (1 + np.exp(-np.clip(logit.astype(np.float64), -60, 60)))
