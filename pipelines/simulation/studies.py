"""Settings of a study of a simulated walk: formations, pose noise, methods."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from pipelines.geometry.noise import NoiseModel
from pipelines.geometry.triangulation import Method
from pipelines.session.errors import DataError
from pipelines.session.registries import find_detector, parsed_noise_models

Axis = Literal["tilt_deg", "robots", "noise"]
StudyMethod = Method | Literal["auto"]

METHODS: tuple[StudyMethod, ...] = (*get_args(Method), "auto")
"""Methods that a study compares, in the order of its tables."""

LEVELS = {"none": (0.0, 0.0), "low": (0.1, 0.5), "medium": (0.3, 1.0), "high": (0.5, 2.0)}
"""Pose noise per axis, m and degrees."""

# Levels of the noise in Ho et al., Sim E1 and E2, in which `auto` may be left out for speed.
_USUAL = {"method": METHODS, "keypoints": ("model",), "seconds": ("75",), "trials": ("10",), "seed": ("0",)}
KNOWN = (
    "tilt_deg",
    "robots",
    "noise",
    "method",
    "keypoints",
    "detector",
    "seconds",
    "rate_hz",
    "trials",
    "seed",
)
"""Variables of a study of a walk."""

# Errors of a satellite receiver and a compass stay alike for about this time.
_CORRELATION_S = 10.0
# The refinement falls back to `robust` with fewer pictures, so that its row would be that of `robust`.
_MIN_TIMES_FOR_AUTO = 20


@dataclass(frozen=True)
class StudiedNoise:
    """Errors of the logged poses."""

    label: str
    model: str  # as users write it; empty for exact poses

    def models(self) -> list[NoiseModel]:
        """Parse the noise models.

        Raises:
            DataError: the text is not a noise model, or a name is unknown.
        """
        return parsed_noise_models("noise", self.model) if self.model else []


@dataclass(frozen=True)
class WalkStudy:
    """Settings of a study of a walk. `walk_study` makes it and checks the values."""

    axis: Axis  # that a figure has along its horizontal axis, and that the ratio compares
    tilts_deg: tuple[float, ...]
    robots: tuple[int, ...]
    noise: tuple[StudiedNoise, ...]
    methods: tuple[StudyMethod, ...]
    keypoints: Literal["model", "exact"]
    detector: str | None  # looks at rendered pictures in place of `keypoints`
    seconds: float
    rate_hz: float
    trials: int
    seed: int


def walk_study(stated: Mapping[str, Sequence[str]]) -> WalkStudy:
    """Return the settings of a study; what is not stated is as in the experiments of Ho et al.

    Args:
        stated: variable (of `KNOWN`) to its values, as users write them. `noise` has names of `LEVELS` (white
            noise), kinds of noise of the same mean size (`white`, `bias`, `body-bias`, `drift`,
            `gauss-markov`; of medium size, or as in `bias@high`), or models as `--pose-noise` has them.

    Raises:
        DataError: an unknown name, a value given twice, or a number out of range.
    """
    values = {**_USUAL, "detector": (), "rate_hz": (), **stated}
    unknown = [name for name in values if name not in KNOWN]
    if unknown:
        raise DataError(unknown[0], "is no variable of a study of a walk", f"there are {', '.join(KNOWN)}",
                        code="no-such-name")  # fmt: skip
    (keypoints,) = _choices(values, "keypoints", ("model", "exact"))
    detector = values["detector"][0] if values["detector"] else None
    if detector is not None:
        find_detector(detector)
        if "keypoints" in stated:
            raise DataError("detector", "cannot be given together with keypoints", "leave one of them out",
                            code="bad-option")  # fmt: skip
    seconds, rate_hz = (
        _single(values, name, 0.1, most, default)
        for name, most, default in (("seconds", 600, 75), ("rate_hz", 240, 30.0 if detector is None else 1.0))
    )
    methods = _choices(values, "method", METHODS)
    needed = _MIN_TIMES_FOR_AUTO if "auto" in methods else 2
    if seconds * rate_hz < needed:
        raise DataError(
            "seconds",
            f"{seconds:g} s at {rate_hz:g} Hz are less than {needed} pictures"
            + (", too few for auto" if needed > 2 else ""),
            "film longer" + (", or leave auto out of method" if needed > 2 else ""),
            code="bad-value",
        )
    axis = _axis(stated)
    noise = [studied_noise(text, seconds) for text in values.get("noise", tuple(LEVELS))]
    _refuse_twice("noise", [each.label for each in noise])
    for each in noise:
        each.models()
    return WalkStudy(
        axis,
        tuple(map(float, numbers(values, "tilt_deg", float, -10, 85, ("15",)))),
        tuple(numbers(values, "robots", int, 2, 8, ("2",))),
        tuple(noise),
        tuple(name for name in METHODS if name in methods),
        "exact" if keypoints == "exact" else "model",
        detector,
        float(seconds),
        float(rate_hz),
        int(_single(values, "trials", 1, 10_000, 10)),
        int(_single(values, "seed", 0, 2**32 - 1, 0)),
    )


def _axis(stated: Mapping[str, Sequence[str]]) -> Axis:
    """Choose the first number that varies; without one the noise if it was stated, else the tilt."""
    order: tuple[Axis, ...] = ("tilt_deg", "robots")
    varied = [name for name in stated if name in order and len(stated[name]) > 1]
    if varied:
        return "tilt_deg" if varied[0] == "tilt_deg" else "robots"
    if "noise" in stated:
        return "noise"
    return "robots" if "robots" in stated and "tilt_deg" not in stated else "tilt_deg"


def studied_noise(text: str, seconds: float) -> StudiedNoise:
    """Return the noise of a level, of a kind with the mean size of a level, or of a model."""
    if text in LEVELS:
        return StudiedNoise(text, _white(text))
    kind, _, level = text.partition("@")
    if not re.fullmatch(r"[a-z-]+", kind) or (level and level not in LEVELS):
        return StudiedNoise(text, text)
    position_m, rotation_deg = LEVELS[level or "medium"]
    size = f"position_m={position_m:g},rotation_deg={rotation_deg:g}"
    # The mean square of a random walk over its length is half its last variance.
    per_sqrt_s = 1 / math.sqrt(seconds / 2)
    drift = (
        f"drift:position_m_per_sqrt_s={position_m * per_sqrt_s:.4g},"
        f"rotation_deg_per_sqrt_s={rotation_deg * per_sqrt_s:.4g}"
    )
    kinds = {
        "white": f"white:{size}",
        "bias": f"bias:{size}",
        "body-bias": f"bias:{size},frame=body",
        "drift": drift,
        "gauss-markov": f"gauss-markov:{size},correlation_s={_CORRELATION_S:g}",
    }
    if kind not in kinds:
        raise DataError(
            f"noise={text}",
            "is neither a level, a kind nor a model of noise",
            f"there are the levels {', '.join(LEVELS)} and the kinds {', '.join(kinds)}",
            code="no-such-name",
        )
    return StudiedNoise(text, "" if level == "none" else kinds[kind])


def _white(level: str) -> str:
    position_m, rotation_deg = LEVELS[level]
    return f"white:position_m={position_m:g},rotation_deg={rotation_deg:g}" if position_m else ""


# --- values --------------------------------------------------------------------------------------------


def numbers(
    values: Mapping[str, Sequence[str]],
    name: str,
    number: Callable[[str], Any],
    least: float,
    most: float,
    default: Sequence[str] = (),
) -> list[Any]:
    """Read the numbers of a variable.

    Raises:
        DataError: one is no number, out of range (NaN, too), or given twice.
    """
    texts = values.get(name) or default
    try:
        found = [number(text) for text in texts]
    except ValueError:
        raise DataError(
            f"{name}={','.join(texts)}", "is no list of numbers", "write 2,3,4 or 0:60:15", code="bad-value"
        ) from None
    for value in found:
        if not least <= value <= most:
            raise DataError(
                f"{name}={value:g}", f"is not between {least:g} and {most:g}", "change it", code="bad-value"
            )
    _refuse_twice(name, found)
    return found


def _single(
    values: Mapping[str, Sequence[str]], name: str, least: float, most: float, default: float
) -> float:
    found = numbers(values, name, float, least, most, (f"{default:g}",))
    if len(found) > 1:
        raise DataError(name, "takes one value", "leave the others out", code="bad-value")
    value: float = found[0]
    return value


def _choices(values: Mapping[str, Sequence[str]], name: str, known: Sequence[str]) -> Sequence[str]:
    given = values[name]
    unknown = [text for text in given if text not in known]
    if unknown or not given or (name == "keypoints" and len(given) > 1):
        problem = f"no such name: {', '.join(unknown)}" if unknown else "takes one value"
        raise DataError(name, problem, f"there are {', '.join(known)}", code="no-such-name")
    _refuse_twice(name, given)
    return given


def _refuse_twice(name: str, given: Sequence[object]) -> None:
    if len(set(given)) < len(given):
        raise DataError(name, "states a value twice", "name each once", code="stated-twice")
