"""Poses of a camera at the seams of the stretches in which its background is adjusted.

python -m benchmarks.seams

A modelled camera circles a place at 30 pictures a second; 120 points of a modelled background are in
each picture, for a second each, with 0.2 px of noise. The log's errors are drawn once for each row. A seam's
neighbourhood is a second to both sides.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from unittest.mock import patch

import numpy as np

from pipelines.geometry.arrays import Bool, Float
from pipelines.geometry.noise import Bias, GaussMarkov, NoiseModel, White, disturb, pose_errors
from pipelines.geometry.poses import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_vector_from_quaternion,
)
from pipelines.reconstruction import background_adjustment
from pipelines.reconstruction.background_adjustment import (
    STRETCH,
    Adjusted,
    Background,
    PosePrior,
    SeenPoints,
    adjust,
)
from pipelines.simulation.flying import orbit
from tests.synthetic.flights import LENS

_FPS, _LIVED, _BORN = 30, 30, 4
_WHITE = White(position_m=0.02, rotation_deg=0.2)
_NOISE: dict[str, Sequence[NoiseModel]] = {
    "white, constant 0.05 m": (_WHITE, Bias(position_m=0.05, rotation_deg=0.3)),
    "white, 0.3 m correlated over 20 s": (
        _WHITE,
        GaussMarkov(position_m=0.3, rotation_deg=0.5, correlation_s=20.0),
    ),
}


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    pictures = 3 * STRETCH
    t_ns = np.arange(pictures) * 10**9 // _FPS
    target = np.tile([0.0, 0.0, 1.0], (pictures, 1))
    position, quaternion = (poses[0] for poses in orbit(t_ns / 1e9, target, cameras=1))
    rotation = matrix_from_quaternion(quaternion)
    seen = _seen(position, rotation)
    background = Background(seen.between, (LENS.fx + LENS.fy) / 2, t_ns / 1e9)
    print(
        "| errors of the log | known | stretches | step at a seam, usual mm | deg"
        " | acceleration near seams, elsewhere m/s² | position error near seams, elsewhere mm |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, models in _NOISE.items():
        at, turned = disturb(models, t_ns, position, quaternion, np.random.default_rng(7))
        for known in ("stated", "no"):
            prior = PosePrior.of(pose_errors(models) if known == "stated" else None)
            for kind, reach in (("apart", STRETCH + 1), ("overlapping", background_adjustment._REACH)):
                with patch.object(background_adjustment, "_REACH", reach):
                    found = adjust(background, at, matrix_from_quaternion(turned), prior)
                print(f"| {name} | {known} | {kind} {_figures(found, position, rotation)}", flush=True)


def _seen(position: Float, rotation: Float) -> SeenPoints:
    """Show points 8 to 40 m away, four new ones in each picture."""
    rng = np.random.default_rng(0)
    birth = np.repeat(np.arange(-_LIVED, len(position)), _BORN)
    at = np.maximum(birth, 0)
    xy = rng.uniform((20, 20), (LENS.width - 20, LENS.height - 20), (len(birth), 2))
    ray = np.column_stack([(xy - [LENS.cx, LENS.cy]) / [LENS.fx, LENS.fy], np.ones(len(xy))])
    away = ray * rng.uniform(8, 40, len(xy))[:, None]
    world = position[at] + np.einsum("kij,kj->ki", rotation[at], away)
    parts = []
    for lag in range(_LIVED):
        point = np.flatnonzero((birth + lag >= 0) & (birth + lag < len(position)))
        picture = birth[point] + lag
        own = np.einsum("kji,kj->ki", rotation[picture], world[point] - position[picture])
        rays = own[:, :2] / own[:, 2:]
        pixels = np.abs(
            rays * [LENS.fx, LENS.fy] + [LENS.cx, LENS.cy] - np.array([LENS.width, LENS.height]) / 2
        )
        inside = (own[:, 2] > 1) & (pixels < [LENS.width / 2, LENS.height / 2]).all(axis=1)
        parts.append((picture[inside], point[inside], rays[inside]))
    picture, point, rays = (np.concatenate(part) for part in zip(*parts, strict=True))
    return SeenPoints(picture, point, rays + rng.normal(0, 0.2 / LENS.fx, rays.shape))


def _figures(found: Adjusted, position: Float, rotation: Float) -> str:
    if found.refused is not None:
        return f"| {found.refused} |"
    error = found.position - position
    left = np.einsum("tji,tjk->tik", rotation, found.rotation)
    turn = np.degrees(rotation_vector_from_quaternion(quaternion_from_matrix(left)))
    parts = np.array_split(np.arange(len(position)), -(-len(position) // STRETCH))
    seams = np.array([part[0] for part in parts[1:]], dtype=np.int64)
    near = (np.abs(np.arange(len(position))[:, None] - seams) < _FPS).any(axis=1)
    steps, turns = (np.linalg.norm(np.diff(each, axis=0), axis=1) for each in (error, turn))
    acceleration = np.linalg.norm(np.diff(error, 2, axis=0), axis=1) * _FPS**2

    def both(values: Float, where: Bool) -> str:
        return ", ".join(f"{np.sqrt(np.mean(values[of] ** 2)):.3g}" for of in (where, ~where))

    return (
        f"| {1e3 * steps[seams - 1].max():.1f}, {1e3 * np.median(steps):.1f}"
        f" | {turns[seams - 1].max():.3f}, {np.median(turns):.3f}"
        f" | {both(acceleration, near[1:-1])} | {both(1e3 * np.linalg.norm(error, axis=1), near)} |"
    )


if __name__ == "__main__":
    main()
