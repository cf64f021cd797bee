"""A lens with distortion: a wider picture of a pinhole, bent into the picture that the lens gives."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Float
from pipelines.geometry.cameras import Intrinsics, undistort

Float32 = NDArray[np.float32]

_KNOT_PX = 8  # between rays that are solved for; a cubic spline lies between, right to 1e-5 px
_MARGIN_PX = 3  # around what the lens sees: cubic interpolation takes two pixels on each side


class DistortingLens:
    """A lens that bends the light of a pinhole with the same focal length.

    Light is interpolated by cubics before it is developed, so that the sensor's softness and noise are those
    of a picture without distortion.

    Raises:
        ValueError: the distortion's model does not reach the whole picture.
    """

    pinhole: Intrinsics
    """The camera whose picture holds all that the lens sees."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        rays = _rays(intrinsics)
        low, high = rays.min(axis=(0, 1)), rays.max(axis=(0, 1))
        focal = np.array([intrinsics.fx, intrinsics.fy])
        centre = _MARGIN_PX - low * focal
        width, height = (int(n) for n in np.ceil((high - low) * focal) + 2 * _MARGIN_PX + 1)
        self.pinhole = Intrinsics(width, height, *focal.tolist(), *centre.tolist())
        self._map = (rays * focal + centre).astype(np.float32)

    def rows(self, part: slice) -> slice:
        """Return the rows of the pinhole's picture that some rows of the lens's picture need."""
        of = self._map[part, :, 1]
        return slice(int(of.min()) - _MARGIN_PX + 1, int(of.max()) + _MARGIN_PX)

    def bent(self, light: Float32, first_row: int, part: slice) -> Float32:
        """Bend the light [R, W, 3] of some rows of the picture.

        Args:
            light: [S, V, 3] of the pinhole's rows from `first_row` on.
            first_row: see `rows`.
            part: the rows of the lens's picture.
        """
        import cv2

        to: NDArray[Any] = self._map[part] - np.array([0, first_row], np.float32)
        bent = cv2.remap(light, to, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        # Cubics overshoot beside edges; there is no light below none.
        return np.maximum(np.asarray(bent, np.float32), np.float32(0))


def _rays(intrinsics: Intrinsics) -> Float:
    """Compute the undistorted normalised coordinates [H, W, 2] of every pixel's centre."""
    from scipy.interpolate import RectBivariateSpline

    rows, columns = np.arange(intrinsics.height), np.arange(intrinsics.width)
    down, right = (np.linspace(0, len(axis) - 1, max(4, len(axis) // _KNOT_PX)) for axis in (rows, columns))
    y, x = np.meshgrid(down, right, indexing="ij")
    solved = undistort(np.stack([x, y], axis=-1), intrinsics)
    if np.isnan(solved).any():
        raise ValueError(f"no ray reaches some pixels with the distortion {list(intrinsics.distortion)}")
    rays: Float = np.stack(
        [RectBivariateSpline(down, right, solved[..., axis])(rows, columns) for axis in range(2)], axis=-1
    )
    return rays
