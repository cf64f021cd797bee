"""Settings of a study: formations, pose noise, methods."""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from pipelines.geometry.noise import NoiseModel
from pipelines.geometry.triangulation import Method
from pipelines.session.errors import DataError
from pipelines.session.registries import find_detector, parsed_noise_models

Study = Literal["tilt", "robots", "noise"]
Keypoints = Literal["model", "exact"]

LEVELS = {"none": (0.0, 0.0), "low": (0.1, 0.5), "medium": (0.3, 1.0), "high": (0.5, 2.0)}
"""Pose noise per axis, m and degrees."""

StudyMethod = Method | Literal["auto"]
METHODS: tuple[StudyMethod, ...] = (*get_args(Method), "auto")

_LONGEST_S = 600.0  # of a walk
_CORRELATION_S = 10.0  # of gauss-markov
_FEWEST_TIMES = 20  # pictures: below, auto would always be robust
_DRONES, _TILT_DEG, _STEEPEST_DEG = (2, 8), 15.0, 85.0


@dataclass(frozen=True)
class Noise:
    """Errors of the logged poses."""

    label: str
    model: str  # as users write it; empty for exact poses

    def models(self) -> list[NoiseModel]:
        """Parse the noise models.

        Raises:
            DataError: the text is not a noise model, or a name is unknown.
        """
        return parsed_noise_models("--noise", self.model) if self.model else []


@dataclass(frozen=True)
class Settings:
    """A study. `settings_for` makes it and checks the values."""

    study: Study
    tilts_deg: tuple[float, ...]
    drones: tuple[int, ...]
    noise: tuple[Noise, ...]
    methods: tuple[StudyMethod, ...]
    keypoints: Keypoints
    detector: str | None  # looks at rendered pictures in place of `keypoints`
    seconds: float
    rate_hz: float
    trials: int
    seed: int


def settings_for(
    study: Study,
    *,
    tilts_deg: Sequence[float] | None = None,
    drones: Sequence[int] | None = None,
    levels: Sequence[str] | None = None,
    noise: Sequence[str] = (),
    methods: Sequence[str] = METHODS,
    keypoints: Keypoints | None = None,
    detector: str | None = None,
    seconds: float = 75.0,
    rate_hz: float | None = None,
    trials: int = 10,
    seed: int = 0,
) -> Settings:
    """Return the settings of a study, with the paper's values as defaults.

    Args:
        study: `tilt` varies tilts, `robots` the number of drones, `noise` the kind of noise.
        tilts_deg: of the formations; 0 to 60 by 15, or 15.
        drones: numbers of drones; 2 to 5, or 2.
        levels: names out of `LEVELS`; all four, or medium.
        noise: models instead of levels, as users write them.
        methods: side by side.
        keypoints: with the errors of a detector (by default), or exact.
        detector: one that looks at rendered pictures instead.
        rate_hz: of the pictures; 30, or 1 where they are rendered.
        trials: independent draws of all noise.

    Raises:
        DataError: an unknown name, a value given twice, or a number out of range.
    """
    if noise and levels is not None:
        raise DataError(
            "--noise", "cannot be given together with --levels", "leave one of them out", code="bad-option"
        )
    if detector is not None:
        find_detector(detector)
        if keypoints is not None:
            raise DataError(
                "--detector",
                "cannot be given together with --keypoints",
                "leave one of them out",
                code="bad-option",
            )
    tilts_deg = tilts_deg or ((0.0, 15.0, 30.0, 45.0, 60.0) if study == "tilt" else (_TILT_DEG,))
    drones = drones or ((2, 3, 4, 5) if study == "robots" else (2,))
    levels = levels or (("medium",) if study == "noise" else tuple(LEVELS))
    rate_hz = rate_hz or (30.0 if detector is None else 1.0)
    _check_names("--methods", methods, METHODS)
    _check_names("--levels", levels, tuple(LEVELS))
    _check_range("--tilts", tilts_deg, -10.0, _STEEPEST_DEG)
    _check_range("--robots", drones, *_DRONES)
    _check_range("--seconds", [seconds], 0.1, _LONGEST_S)
    _check_range("--rate", [rate_hz], 0.1, 240.0)
    _check_range("--trials", [trials], 1, 10_000)
    for name, values in (("--tilts", tilts_deg), ("--robots", drones), ("--noise", noise)):
        _check_once(name, values)
    if seconds * rate_hz < 2:
        raise DataError(
            "--seconds",
            f"{seconds:g} s at {rate_hz:g} Hz are not two pictures",
            "film longer",
            code="bad-option",
        )
    if "auto" in methods and seconds * rate_hz < _FEWEST_TIMES:
        raise DataError(
            "--seconds",
            f"{seconds:g} s at {rate_hz:g} Hz are too few pictures for auto ({_FEWEST_TIMES})",
            "film longer, or leave it out of --methods",
            code="bad-option",
        )
    asked = [Noise(text, text) for text in noise] or _levels(study, levels, seconds)
    for each in asked:
        each.models()
    chosen: tuple[StudyMethod, ...] = tuple(name for name in METHODS if name in methods)
    return Settings(
        study,
        tuple(float(tilt) for tilt in tilts_deg),
        tuple(drones),
        tuple(asked),
        chosen,
        keypoints or "model",
        detector,
        seconds,
        rate_hz,
        trials,
        seed,
    )


def command_of(settings: Mapping[str, Any], output: str) -> str:
    """Return the `mocap ablate ...` that makes a study again; defaults are left out.

    `settings` are those of summary.json, the noise as models by label.

    Raises:
        KeyError, TypeError, ValueError: they are not the settings of a study.
    """
    study, drones, tilts = settings["study"], settings["drones"], settings["tilts_deg"]
    seconds, detector, noise = settings["seconds"], settings["detector"], settings["noise"]
    plain = settings_for(study, methods=METHODS[:1], seconds=seconds)
    words: list[str] = []
    if tilts != list(plain.tilts_deg):
        words += ["--tilts" if study == "tilt" else "--tilt", ",".join(map(_written, tilts))]
    if drones != list(plain.drones):
        words += ["--robots" if study == "robots" else "--drones", ",".join(map(str, drones))]
    if noise != {each.label: each.model for each in plain.noise}:
        words += _noise_words(study, noise, seconds)
    if settings["methods"] != list(METHODS):
        words += ["--methods", ",".join(settings["methods"])]
    if detector is not None:
        words += ["--detector", detector]
    elif settings["keypoints"] != "model":
        words += ["--keypoints", settings["keypoints"]]
    numbers = {"seconds": 75.0, "rate_hz": 30.0 if detector is None else 1.0, "trials": 10, "seed": 0}
    for name, default in numbers.items():
        if settings[name] != default:
            words += [f"--{name.removesuffix('_hz')}", _written(settings[name])]
    return shlex.join(["mocap", "ablate", study, *words, "-o", output])


def _written(number: float) -> str:
    """Format a number as the options take it: whole ones without a point, all of them with every digit."""
    return str(int(number)) if float(number).is_integer() else repr(float(number))


def _noise_words(study: Study, noise: Mapping[str, str], seconds: float) -> list[str]:
    """Return the options that ask for this noise."""
    levels = [level for level in LEVELS if any(level in label.split() for label in noise)]
    for asked in (levels, *([level] for level in LEVELS)):
        if asked and dict(noise) == {each.label: each.model for each in _levels(study, asked, seconds)}:
            return ["--levels", ",".join(asked)]
    return [word for model in noise.values() for word in ("--noise", model)]


def _levels(study: Study, levels: Sequence[str], seconds: float) -> list[Noise]:
    """Return white noise of every level; for the study of noise, every kind with the same mean size."""
    asked: list[Noise] = []
    for level in levels:
        position_m, rotation_deg = LEVELS[level]
        size = f"position_m={position_m:g},rotation_deg={rotation_deg:g}"
        if not position_m:
            asked.append(Noise(level, ""))
        elif study != "noise":
            asked.append(Noise(level, f"white:{size}"))
        else:
            # The mean square of a random walk over its length is half its last variance.
            per_sqrt_s = 1 / math.sqrt(seconds / 2)
            drift = (
                f"drift:position_m_per_sqrt_s={position_m * per_sqrt_s:.4g},"
                f"rotation_deg_per_sqrt_s={rotation_deg * per_sqrt_s:.4g}"
            )
            of = "" if len(levels) == 1 else f" {level}"
            asked += [
                Noise(f"white{of}", f"white:{size}"),
                Noise(f"bias{of}", f"bias:{size}"),
                Noise(f"body bias{of}", f"bias:{size},frame=body"),
                Noise(f"drift{of}", drift),
                Noise(f"gauss-markov{of}", f"gauss-markov:{size},correlation_s={_CORRELATION_S:g}"),
            ]
    return asked


def _check_names(option: str, given: Sequence[str], known: Sequence[str]) -> None:
    unknown = [name for name in given if name not in known]
    if unknown or not given:
        problem = f"no such name: {', '.join(unknown)}" if unknown else "names nothing"
        raise DataError(option, problem, f"there are {', '.join(known)}")
    _check_once(option, given)


def _check_once(option: str, given: Sequence[object]) -> None:
    if len(set(given)) < len(given):
        raise DataError(option, "says something twice", "name each once", code="stated-twice")


def _check_range(option: str, given: Sequence[float], least: float, most: float) -> None:
    for number in given:
        if not least <= number <= most:  # NaN, too
            raise DataError(
                option, f"{number:g} is not between {least:g} and {most:g}", "change it", code="bad-value"
            )
