"""Argument of `onnx:`: a model's path, and options for information that its graph lacks.

`MODEL.onnx[,option=value...]`, for example `pose.onnx,skeleton=halpe26,people=yolox.onnx`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from pipelines.keypoints.onnx_network import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Colours,
    Layout,
    provider_name,
)
from pipelines.keypoints.pose_outputs import HeatmapCells
from pipelines.session.errors import DataError
from pipelines.session.skeletons import SKELETONS

USAGE = """\
onnx:MODEL.onnx[,option=value...]
MODEL.onnx: top-down, with SimCC or heatmap outputs (RTMPose, HRNet, ViTPose, AlphaPose's FastPose)
people=DETECTOR.onnx: a YOLOX or RTMDet model that finds people; without it BlazePose's does, once fetched
people_norm=none|imagenet, people_colours=bgr|rgb: what that wants; RTMDet is imagenet, YOLOX none [none, bgr]
skeleton=NAME: which joints [by their number]; of more joints the first are taken
heatmap=udp|msra: how a heatmap model was trained: ViTPose udp, plain HRNet and FastPose msra [udp]
mean=R/G/B, std=R/G/B, colours=rgb|bgr: what it wants, of values 0..255 [ImageNet's, rgb]
size=WxH, layout=nchw|nhwc: of its input, where the graph leaves them open
provider=NAME: ONNX Runtime's execution provider that runs it, such as cuda; --provider says the same [cpu]"""

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
            raise DataError(f"onnx:{argument}", f"states {name} twice", "state it once")
        if name not in _READERS:
            raise DataError(f"onnx:{argument}", f"no option {name!r}", f"there are {', '.join(_READERS)}")
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
            raise DataError(place, "no such choice", f"there are {', '.join(choices)}")
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
        raise DataError(place, "is not finite", "write 123.675/116.28/103.53")
    return red, green, blue


def _divisors(place: str, value: str) -> Three:
    numbers = _three(place, value)
    if not all(number > 0 for number in numbers):
        raise DataError(place, "must be above 0", "write 255/255/255 for values of 0..1")
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
