"""Cost of a heavy-tailed loss under noisy poses: the measurement behind docs/decisions/0002.

python -m benchmarks.loss
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.geometry.triangulation import estimate_noise, triangulate
from pipelines.reconstruction.solving import triangulate_heavy_tailed
from tests.geometry.rings import ring, with_pixel_noise, with_pose_noise

DRAWS = 200
FRAMES = 4


def main() -> None:
    """Print the mean error of least squares and of Cauchy's loss under the same constant pose errors."""
    print(f"Mean mm over {DRAWS} draws of a constant pose error that nobody states, 2 px")
    print("| cameras | level | least squares | Cauchy | ratio |")
    print("| --- | --- | --- | --- | --- |")
    for cameras in (2, 3, 4, 5):
        for level in ("a", "b"):
            errors = np.mean([both_errors_mm(cameras, level, seed) for seed in range(DRAWS)], axis=0)
            print(
                f"| {cameras} | {level} | {errors[0]:.0f} | {errors[1]:.0f} | {errors[1] / errors[0]:.2f} |"
            )


def both_errors_mm(cameras: int, level: str, seed: int) -> tuple[float, float]:
    """Compute the mean errors (mm) over joint-frames that both losses reconstruct, in one draw."""
    rng = np.random.default_rng([seed, cameras])
    truth, exact = ring(FRAMES, cameras)
    views = with_pose_noise(with_pixel_noise(exact, rng), rng, level, constant=True, stated=False)
    views = replace(views, pixel_sigma=estimate_noise(views))
    plain = triangulate(views, method="robust").points
    heavy = triangulate_heavy_tailed(views, threads=1).points
    errors = np.stack([np.linalg.norm(points - truth.reshape(-1, 3), axis=-1) for points in (plain, heavy)])
    shared = np.isfinite(errors).all(axis=0)
    mean = 1e3 * errors[:, shared].mean(axis=1)
    return float(mean[0]), float(mean[1])


if __name__ == "__main__":
    main()
