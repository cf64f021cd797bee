"""Detector `onnx:MODEL.onnx`: the user's own top-down model, run by ONNX Runtime.

Crops follow MMPose's top-down models: upright, the box of a person padded by 1.25, the aspect of the
network's input kept. Options give the information that a graph lacks (see `onnx_options`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from pipelines.geometry.arrays import Float, Picture
from pipelines.keypoints.blazepose import DETECTOR as BLAZEPOSE
from pipelines.keypoints.crops import in_picture, sampled, side_of_box, upright_crop
from pipelines.keypoints.onnx_network import OnnxNetwork, provider_with_options
from pipelines.keypoints.onnx_options import USAGE, OnnxOptions, parse_options
from pipelines.keypoints.onnx_people import OnnxPeople
from pipelines.keypoints.pose_outputs import PoseDecoder, decoder_for
from pipelines.session.errors import DataError
from pipelines.session.registries import Person, Region
from pipelines.session.skeletons import get_skeleton, skeleton_with

_PADDING = 1.25
_SURE = 0.3  # joints above it are drawn by MMPose, and place the next region here
_EYES, _ANKLES = 0.936, 0.039  # heights above the ground, as shares of the body's (Drillis & Contini)


class FindsPeople(Protocol):
    """Source of regions."""

    def find_people(self, picture: Picture) -> list[tuple[Region, float]]:
        """Find people; see `KeypointNetworks.find_people`."""


class OnnxPose:
    """Loaded networks. Not thread-safe.

    Args:
        network: the pose model.
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
        sure = score >= _SURE
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
        return Region((float(x), float(y)), side_of_box(width, height, self._network.size, _PADDING))


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
                Region((float(x), float(y)), side_of_box(right - left, bottom - top, self._size, _PADDING)),
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
                raise DataError(path, "does not exist", "give the path of an ONNX model")
        return OnnxDetector(options)


DETECTOR = OnnxFamily()
