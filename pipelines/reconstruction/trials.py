"""Trials: repeated reconstructions with added pose errors, their draws and their summary.

The random draws of trial k and camera i do not depend on other options, so that two noise models, or two
methods, are compared on the same draws.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.geometry.metrics import intervals
from pipelines.geometry.noise import NoiseModel, disturb, sum_sigma
from pipelines.reconstruction.observations import Camera
from pipelines.session.errors import DataError
from pipelines.session.registries import parsed_noise_models

STORED = 0
"""Number of the trial with the stored skeleton."""

# More trials would take days and change no interval.
MAX_TRIALS = 1000

_FIGURES = (
    "mpjpe_mm",
    "root_mpjpe_mm",
    "pa_mpjpe_mm",
    "e_recon_m2",
    "e_recon_terms",
    "e_recon_per_joint_frame_m2",
    "pck150",
    "pck150_auc",
    "acceleration_error_mm_s2",
    "reconstructed_share",
)


_DRAWS = re.compile(r"(?P<text>.*?)(\s+x(?P<trials>[0-9]+))?(\s+seed=(?P<seed>[0-9]+))?\s*", re.DOTALL)


@dataclass(frozen=True)
class PoseDisturbance:
    """Errors that are added to the logged poses in several trials."""

    text: str  # the noise models, as users write them
    models: list[NoiseModel]
    trials: int
    seed: int

    @classmethod
    def parse(cls, text: str) -> "PoseDisturbance":
        """Parse `MODELS [xTRIALS] [seed=SEED]`; without them there is one trial, and the seed is 0.

        Raises:
            DataError: it cannot be parsed, all sizes are 0, or there are no trials or too many.
        """
        place = "--disturb-poses"
        found = _DRAWS.fullmatch(text)
        words = {} if found is None else found.groupdict()
        models = parsed_noise_models(place, words["text"])
        one = np.ones(1)  # any elapsed time, speed and turn rate
        if not sum_sigma(models, one, one, one).any():
            raise DataError(
                place, f"{text!r} disturbs nothing", "state at least one size above 0", code="bad-value"
            )
        trials, seed = int(words["trials"] or 1), int(words["seed"] or 0)
        if not 1 <= trials <= MAX_TRIALS or seed >= 2**32:
            problem = f"x{trials} seed={seed} is out of range"
            raise DataError(
                place, problem, f"state x1 to x{MAX_TRIALS}, and a seed below 2^32", code="bad-value"
            )
        return cls(words["text"], models, trials, seed)


def disturbed(cameras: Sequence[Camera], models: Sequence[NoiseModel], seed: int, trial: int) -> list[Camera]:
    """Add errors to every logged pose of the cameras; the stated noise of the logs stays the same."""
    moved = []
    for c, camera in enumerate(cameras):
        log = camera.trajectory
        rng = np.random.default_rng([seed, trial, c])
        position, quaternion = disturb(models, log.t_ns, log.position, log.quaternion_xyzw, rng)
        moved.append(replace(camera, trajectory=replace(log, position=position, quaternion_xyzw=quaternion)))
    return moved


def summary_of_trials(metrics: Sequence[Mapping[str, Any]], text: str, seed: int) -> dict[str, Any]:
    """Summarise all trials for metrics.json.

    Args:
        text: the errors, as users write them.
        seed: seed of the draws, and of the resampling of trials.

    Returns:
        JSON-able, null for figures that could not be measured: `each` trial's figures, their `mean`, `std`
        (about the mean, n - 1) and the `intervals` of `geometry.metrics` over trials; both null for less
        than two trials.
    """
    each = [_figures(trial) for trial in metrics]
    mean: dict[str, float | None] = {}
    std: dict[str, float | None] = {}
    ends: dict[str, list[float] | None] = {}
    for name in each[0]:
        values = np.array([trial[name] for trial in each if trial[name] is not None], dtype=np.float64)
        mean[name] = float(values.mean()) if values.size else None
        std[name] = ends[name] = None
        if values.size > 1:
            std[name] = float(values.std(ddof=1))
            found = intervals({name: (values, np.ones(values.size))}, None, seed=seed)[name]
            ends[name] = None if found is None else list(found)
    return {
        "disturb_poses": text,
        "seed": seed,
        "count": len(each),
        "stored": STORED,
        "mean": mean,
        "std": std,
        "intervals": ends,
        "each": each,
    }


def _figures(metrics: Mapping[str, Any]) -> dict[str, float | None]:
    figures: dict[str, float | None] = {name: metrics[name] for name in _FIGURES}
    figures["reprojection_px_median"] = metrics["reprojection_px"]["median"]
    if "refinement" in metrics:
        figures["fell_back"] = float(metrics["refinement"]["fallback"] is not None)
    return figures
