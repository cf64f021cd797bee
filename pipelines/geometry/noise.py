"""Models of the errors of logged poses, used as priors and to simulate noisy logs.

An error is a translation in m along the world's axes, or the camera's with `frame: body`, and a rotation
vector in rad about the camera's axes: noisy world_from_camera = (p + translation, q * exp(rotation)). Sigmas
are per axis. The errors of several models add up. `PoseErrors` is the prior that they are for the estimate of
poses.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Literal

import numpy as np

from pipelines.geometry.arrays import Float, Int64
from pipelines.geometry.poses import (
    conjugate,
    interpolate_poses,
    multiply,
    quaternion_from_rotation_vector,
    rotate,
    rotation_vector_from_quaternion,
)

# Larger parameters make no sense, and their squares may overflow.
_MAX_PARAMETER = 1e6

Frame = Literal["world", "body"]


@dataclass(frozen=True, kw_only=True)
class NoiseModel(ABC):
    """One kind of pose error, of the parameters that users write; ValueError: one is out of range."""

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_parameter(field.name, getattr(self, field.name))

    @abstractmethod
    def marginal_sigma(self, elapsed_s: Float, speed_mps: Float, turn_rate_radps: Float) -> Float:
        """Compute the standard deviation [T, 2] of the error, per axis of position (m) and rotation (rad).

        `elapsed_s` counts from the first pose; `speed_mps` and `turn_rate_radps` are the camera's.
        """

    @abstractmethod
    def errors(self, t_ns: Int64, position: Float, quaternion_xyzw: Float, rng: np.random.Generator) -> Float:
        """Draw the errors of a whole log: [T, 6] translation in the world, rotation vector in the camera.

        The stamps increase strictly; position [T, 3] m and quaternion [T, 4] are the true world_from_camera.
        """


@dataclass(frozen=True, kw_only=True)
class _RandomProcess(NoiseModel):
    """One random process in time for six independent axes; the camera's motion has no influence."""

    frame: Frame = "world"

    @abstractmethod
    def _scale(self) -> tuple[float, float]:
        """Return the factors on the process of unit scale: m for the position, rad for the rotation."""

    @abstractmethod
    def _unit_sigma(self, elapsed_s: Float) -> Float:
        """Compute the standard deviation [T] of the process of unit scale."""

    @abstractmethod
    def _unit_draw(self, elapsed_s: Float, rng: np.random.Generator) -> Float:
        """Draw the process of unit scale once, [T, 6]."""

    def marginal_sigma(self, elapsed_s: Float, speed_mps: Float, turn_rate_radps: Float) -> Float:
        """Compute `NoiseModel.marginal_sigma`; motion has no influence."""
        return self._unit_sigma(elapsed_s)[:, None] * self._scale()

    def errors(self, t_ns: Int64, position: Float, quaternion_xyzw: Float, rng: np.random.Generator) -> Float:
        """Draw `NoiseModel.errors`."""
        draw: Float = self._unit_draw((t_ns - t_ns[:1]) / 1e9, rng) * np.repeat(self._scale(), 3)
        if self.frame == "body":
            draw[:, :3] = rotate(quaternion_xyzw, draw[:, :3])
        return draw


@dataclass(frozen=True, kw_only=True)
class _Stationary(_RandomProcess):
    """A process whose standard deviation is the same at any time."""

    position_m: float = 0.0  # Nothing is added unless it is stated.
    rotation_deg: float = 0.0  # Nothing is added unless it is stated.

    def _scale(self) -> tuple[float, float]:
        return self.position_m, math.radians(self.rotation_deg)

    def _unit_sigma(self, elapsed_s: Float) -> Float:
        return np.ones_like(elapsed_s)


@dataclass(frozen=True, kw_only=True)
class White(_Stationary):
    """White noise: an independent error for every pose."""

    def _unit_draw(self, elapsed_s: Float, rng: np.random.Generator) -> Float:
        return rng.standard_normal((len(elapsed_s), 6))


@dataclass(frozen=True, kw_only=True)
class Bias(_Stationary):
    """A constant bias: one error for the whole flight."""

    def _unit_draw(self, elapsed_s: Float, rng: np.random.Generator) -> Float:
        return np.tile(rng.standard_normal(6), (len(elapsed_s), 1))


@dataclass(frozen=True, kw_only=True)
class GaussMarkov(_Stationary):
    """An error that decorrelates with a correlation time, like that of satellite positioning."""

    correlation_s: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.correlation_s == 0:
            raise ValueError("correlation_s is 0: an error without memory is the model white")

    def _unit_draw(self, elapsed_s: Float, rng: np.random.Generator) -> Float:
        draw = rng.standard_normal((len(elapsed_s), 6))
        # Gelb 1974, Applied Optimal Estimation, 3.8.
        kept = np.exp(-np.diff(elapsed_s) / self.correlation_s)
        fresh = np.sqrt(-np.expm1(-2 * np.diff(elapsed_s) / self.correlation_s))
        for k in range(1, len(draw)):
            draw[k] = kept[k - 1] * draw[k - 1] + fresh[k - 1] * draw[k]
        return draw


@dataclass(frozen=True, kw_only=True)
class Drift(_RandomProcess):
    """A random walk that starts at zero with the first pose."""

    position_m_per_sqrt_s: float = 0.0  # Nothing is added unless it is stated.
    rotation_deg_per_sqrt_s: float = 0.0  # Nothing is added unless it is stated.

    def _scale(self) -> tuple[float, float]:
        return self.position_m_per_sqrt_s, math.radians(self.rotation_deg_per_sqrt_s)

    def _unit_sigma(self, elapsed_s: Float) -> Float:
        return np.sqrt(elapsed_s)

    def _unit_draw(self, elapsed_s: Float, rng: np.random.Generator) -> Float:
        steps = np.diff(elapsed_s, prepend=elapsed_s[:1])
        return np.cumsum(np.sqrt(steps)[:, None] * rng.standard_normal((len(steps), 6)), axis=0)


@dataclass(frozen=True, kw_only=True)
class Latency(NoiseModel):
    """A delayed log: the pose stamped t is the pose of the camera at `latency_ms` before t."""

    latency_ms: float

    def marginal_sigma(self, elapsed_s: Float, speed_mps: Float, turn_rate_radps: Float) -> Float:
        """Compute `NoiseModel.marginal_sigma`: the full error, which is along the motion, for every axis."""
        return np.stack([speed_mps, turn_rate_radps], axis=-1) * (self.latency_ms / 1e3)

    def errors(self, t_ns: Int64, position: Float, quaternion_xyzw: Float, rng: np.random.Generator) -> Float:
        """Compute `NoiseModel.errors`; before the log begins, the camera is assumed to stand still."""
        delay_ns = round(self.latency_ms * 1e6)
        late_position, late_quaternion = interpolate_poses(
            t_ns,
            position,
            quaternion_xyzw,
            t_ns - delay_ns,
            max_gap_ns=int(np.ptp(t_ns)) if len(t_ns) else 0,
            max_extrapolation_ns=delay_ns,
        )
        turned = rotation_vector_from_quaternion(multiply(conjugate(quaternion_xyzw), late_quaternion))
        return np.concatenate([late_position - position, turned], axis=1)


def sum_sigma(
    models: Sequence[NoiseModel], elapsed_s: Float, speed_mps: Float, turn_rate_radps: Float
) -> Float:
    """Compute the standard deviation [T, 2] per axis (m, rad) of the sum of independent models."""
    variance = np.zeros((len(elapsed_s), 2))
    for model in models:
        variance += model.marginal_sigma(elapsed_s, speed_mps, turn_rate_radps) ** 2
    return np.sqrt(variance)


def disturb(
    models: Sequence[NoiseModel],
    t_ns: Int64,
    position: Float,
    quaternion_xyzw: Float,
    rng: np.random.Generator,
) -> tuple[Float, Float]:
    """Apply the models' errors, added up before, to a log of true world_from_camera."""
    error = np.zeros((len(t_ns), 6))
    for model in models:
        error += model.errors(t_ns, position, quaternion_xyzw, rng)
    turned = multiply(quaternion_xyzw, quaternion_from_rotation_vector(error[:, 3:]))
    return position + error[:, :3], turned


# --- priors of pose errors -------------------------------------------------------------------------------

SHIFT_IN_WORLD, ROTATION, SHIFT_IN_CAMERA = 0, 3, 6
"""First index of each part of the corrections of a picture's pose (see `refinement.kernels`)."""

UNKNOWN_SIGMA = (0.3, math.radians(1.0))
"""Pose noise (m, rad) that is possible where none is stated: the studies' medium level."""

USUAL_CONSTANT, USUAL_COUNT = (0.1, math.radians(0.3)), 3.0
"""Usual level (m, rad) of constant errors that nobody stated, and how many numbers that is worth."""

SURVEYED_M = 0.01
"""Usual position error (m, per axis) of a camera that was surveyed: see `background.adjust`."""

EXACT = 1e-5
"""Constant error (m and rad) that stands for none, so that the equations stay well posed."""

WHITE_SHARE = 0.5
"""White share of a logged variance; a log gives the size of errors, not their correlation over time."""


@dataclass(frozen=True)
class Process:
    """Pose error of one kind over time, the same on three axes: sigma0 at the start, then a random walk.

    With a correlation time it is a Gauss-Markov process whose standard deviation is always sigma0.
    """

    number: int  # SHIFT_IN_WORLD, ROTATION or SHIFT_IN_CAMERA
    sigma0: float  # m or rad
    rate: float = 0.0  # m or rad per sqrt(s)
    correlation_s: float = np.inf

    @property
    def constant(self) -> bool:
        """True if it never changes."""
        return self.rate == 0 and not np.isfinite(self.correlation_s)

    def stray(self, elapsed_s: float) -> float:
        """Compute the mean variance about the line between values `elapsed_s` apart, of a Brownian bridge."""
        rate2 = self.rate**2
        if np.isfinite(self.correlation_s):
            rate2 += 2 * self.sigma0**2 / self.correlation_s
        return min(rate2 * elapsed_s / 6, max(self.sigma0, self.rate) ** 2)

    def step(self, elapsed_s: float) -> tuple[float, float]:
        """Compute the share that is left after some time, and the added variance."""
        if np.isfinite(self.correlation_s):
            kept = float(np.exp(-elapsed_s / self.correlation_s))
            return kept, self.sigma0**2 * (1 - kept**2)
        return 1.0, self.rate**2 * elapsed_s


@dataclass(frozen=True)
class PoseErrors:
    """Prior of one camera's pose errors."""

    white: tuple[float, float]  # m, rad per axis; 0, 0 for none
    processes: tuple[Process, ...]
    logged: bool = False
    """True if white errors have the logged covariance of each pose; `white` is then its level."""
    assumed: bool = False
    """True if nobody knows the level of the constant errors, and `processes` have a wide one."""

    def later(self, elapsed_s: float) -> PoseErrors:
        """Return the same errors some seconds after the start, when a drift has a size already."""
        processes = (
            replace(each, sigma0=float(np.hypot(each.sigma0, each.rate * np.sqrt(elapsed_s))))
            for each in self.processes
        )
        return replace(self, processes=tuple(processes))

    def white_with_stray(self, knot_s: float) -> Float:
        """Compute the standard deviation [2] (m, rad) of white errors, with slow errors between knots."""
        variance = np.square(self.white)
        for process in self.processes:
            variance[1 if process.number == ROTATION else 0] += process.stray(knot_s)
        if variance.any():
            variance = np.maximum(variance, EXACT**2)
        return np.sqrt(variance)


def pose_errors(models: Sequence[NoiseModel]) -> PoseErrors:
    """Convert stated noise models to a prior; ValueError for a model that is not one of flight.yaml's.

    Latency is left to the clock: a delayed log and a clock offset differ only where cameras accelerate.
    """
    white = np.zeros(2)
    merged: dict[int, tuple[float, float]] = {}
    processes = []

    def add(number: int, sigma0: float, rate: float) -> None:
        old = merged.get(number, (0.0, 0.0))
        merged[number] = (float(np.hypot(old[0], sigma0)), float(np.hypot(old[1], rate)))

    for model in models:
        match model:
            case White():
                white += np.square([model.position_m, np.radians(model.rotation_deg)])
            case Bias():
                add(_shift(model.frame), model.position_m, 0.0)
                add(ROTATION, float(np.radians(model.rotation_deg)), 0.0)
            case Drift():
                add(_shift(model.frame), 0.0, model.position_m_per_sqrt_s)
                add(ROTATION, 0.0, float(np.radians(model.rotation_deg_per_sqrt_s)))
            case GaussMarkov():
                sizes = ((_shift(model.frame), model.position_m), (ROTATION, np.radians(model.rotation_deg)))
                processes += [
                    Process(number, float(size), correlation_s=model.correlation_s)
                    for number, size in sizes
                    if size > 0
                ]
            case Latency():
                pass
            case _:
                raise ValueError(f"{type(model).__name__} cannot be a prior of the refinement")
    processes += [
        Process(number, max(sigma0, EXACT), rate)
        for number, (sigma0, rate) in sorted(merged.items())
        if sigma0 > 0 or rate > 0
    ]
    # A position without noise beside a rotation with noise (or the reverse) is a very small noise.
    known = np.sqrt(white)
    if known.any():
        known = np.maximum(known, EXACT)
    return PoseErrors((float(known[0]), float(known[1])), tuple(processes))


def _shift(frame: str) -> int:
    return SHIFT_IN_WORLD if frame == "world" else SHIFT_IN_CAMERA


def errors_of_level(level: Float) -> PoseErrors:
    """Build pose errors from their level [2] (m, rad) alone: half of the variance white, half constant."""
    white, constant = np.sqrt(WHITE_SHARE) * level, np.sqrt(1 - WHITE_SHARE) * level
    processes = (Process(SHIFT_IN_WORLD, float(constant[0])), Process(ROTATION, float(constant[1])))
    return PoseErrors((float(white[0]), float(white[1])), processes)


# --- models as users write them --------------------------------------------------------------------------


def build(
    parts: Iterable[tuple[str, Mapping[str, object]]], classes: Mapping[str, type[NoiseModel]]
) -> list[NoiseModel]:
    """Build noise models of names and parameters; ValueError: an unknown one, a missing or wrong value."""
    return [_build_one(name, parameters, classes) for name, parameters in parts]


def parse(text: str) -> list[tuple[str, dict[str, object]]]:
    """Parse `white:position_m=0.3,rotation_deg=1 + bias:position_m=0.1`; ValueError for another form."""
    # The sign of an exponent (1e+3) does not start another model: a digit follows directly.
    return [_parse_one(part.strip()) for part in re.split(r"\+(?!\d)", text)]


def _build_one(
    name: str, parameters: Mapping[str, object], classes: Mapping[str, type[NoiseModel]]
) -> NoiseModel:
    if name not in classes:
        raise ValueError(f"noise model {name} is none of {', '.join(sorted(classes))}")
    known = {field.name: field.default is MISSING for field in fields(classes[name])}
    unknown = sorted(set(parameters) - set(known))
    if unknown:
        raise ValueError(f"{name} has no {', '.join(unknown)}; its parameters are {', '.join(sorted(known))}")
    missing = [key for key, required in known.items() if required and key not in parameters]
    if missing:
        raise ValueError(f"{name} needs {', '.join(missing)}")
    try:
        return classes[name](**parameters)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _check_parameter(name: str, value: object) -> None:
    if name == "frame":
        if value not in ("world", "body"):
            raise ValueError(f"frame is {value!r} instead of world or body")
    elif not isinstance(value, (int, float)) or isinstance(value, bool):
        raise ValueError(f"{name} is {value!r} instead of a number")
    elif not 0 <= value <= _MAX_PARAMETER:
        raise ValueError(f"{name} is {value}; it must lie between 0 and {_MAX_PARAMETER:g}")


def _parse_one(part: str) -> tuple[str, dict[str, object]]:
    match = re.fullmatch(r"([A-Za-z][\w-]*)\s*:\s*(.+)", part)
    assignments = [item.partition("=") for item in match[2].split(",")] if match else []
    if match is None or not all(key.strip() and value.strip() for key, _, value in assignments):
        raise ValueError(f"{part!r} does not read as model:parameter=value,parameter=value")
    parameters: dict[str, object] = {}
    for key, _, value in assignments:
        if key.strip() in parameters:
            raise ValueError(f"{part!r} gives {key.strip()} twice")
        parameters[key.strip()] = _number_or_word(value.strip())
    return match[1], parameters


def _number_or_word(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
