"""Cameras with distortion: from points in the camera's frame to pixels and back."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from pipelines.geometry.arrays import Bool, Float, Intrinsics

# Beyond 89.94 degrees off the axis, x/z is no longer useful.
_WIDEST = 1e3


def camera_matrix(intrinsics: Intrinsics) -> Float:
    """Return the camera matrix K, [3, 3] in pixels, without skew."""
    return np.array(
        [[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]]
    )


def camera_info(intrinsics: Intrinsics) -> dict[str, Any]:
    """Return a camera's fields of ROS's message CameraInfo, with as many coefficients as its model takes."""
    matrix, distortion = camera_matrix(intrinsics), [float(v) for v in intrinsics.distortion]
    model = "rational_polynomial" if len(distortion) > 5 else "plumb_bob"
    if intrinsics.model == "fisheye":
        model = "equidistant"
    else:
        distortion += [0.0] * (5 - len(distortion))
    return {
        "width": intrinsics.width,
        "height": intrinsics.height,
        "distortion_model": model,
        "d": distortion,
        "k": matrix.ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": np.pad(matrix, [(0, 0), (0, 1)]).ravel().tolist(),
    }


def project(points_camera: Float, intrinsics: Intrinsics) -> Float:
    """Project points [..., 3] m in the camera's frame to pixels [..., 2], also outside the picture.

    NaN for points that are NaN, behind the camera (z <= 0) or beyond the radius where the distortion folds
    back on itself (OpenCV returns a pixel there), so that `undistort` is the exact inverse.
    """
    depth = np.where(points_camera[..., 2] > 0, points_camera[..., 2], np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        normalised = points_camera[..., :2] / depth[..., None]
        normalised = np.where(np.isfinite(normalised).all(axis=-1, keepdims=True), normalised, np.nan)
        distorted = _DISTORT[intrinsics.model](normalised, intrinsics.distortion)
    return distorted * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]


def undistort(pixels: Float, intrinsics: Intrinsics) -> Float:
    """Compute rays x/z, y/z [..., 2] of pixels [..., 2] to 1e-10; NaN where the model has no ray."""
    distorted = (pixels - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    flat = distorted.reshape(-1, 2)
    normalised = np.full_like(flat, np.nan)
    known = np.isfinite(flat).all(axis=1)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        normalised[known] = _UNDISTORT[intrinsics.model](flat[known], intrinsics.distortion)
    return normalised.reshape(distorted.shape)


def row_delay_s(row_px: Float, intrinsics: Intrinsics) -> Float:
    """Compute how much later than the middle row a rolling shutter takes rows [...] px; NaN stays."""
    return (row_px / max(intrinsics.height - 1, 1) - 0.5) * intrinsics.readout_s


def rescaled(intrinsics: Intrinsics, width: int, height: int) -> Intrinsics:
    """Return the intrinsics for resized pictures; corners, half a pixel beyond centres, stay corners."""
    sx, sy = width / intrinsics.width, height / intrinsics.height
    return replace(
        intrinsics,
        width=width,
        height=height,
        fx=intrinsics.fx * sx,
        fy=intrinsics.fy * sy,
        cx=(intrinsics.cx + 0.5) * sx - 0.5,
        cy=(intrinsics.cy + 0.5) * sy - 0.5,
    )


def is_resized(intrinsics: Intrinsics, width: int, height: int) -> bool:
    """Test if pictures of this size have the shape of the calibration's: aspect ratios within 0.5 %."""
    ratio = width * intrinsics.height / (height * intrinsics.width) if height else 0.0
    return abs(ratio - 1) <= 0.005


def fit_to_size(
    intrinsics: Intrinsics, width: int, height: int, bars: tuple[int, int, int, int] = (0, 0, 0, 0)
) -> tuple[Intrinsics, str | None]:
    """Adapt intrinsics to the size of the pictures; return them, and a note if the sizes differ.

    The same shape at another size (`is_resized`) means a resized picture. Another shape, of which the part
    between black `bars` (columns left, rows above, columns right, rows below, each whole pixels) has the
    calibration's shape, means a letterboxed one. Another shape without bars, with both sides within 2 %,
    means that a codec cropped or padded it: the intrinsics are kept. ValueError: the sizes differ by more.
    """
    if (width, height) == (intrinsics.width, intrinsics.height):
        return intrinsics, None
    sizes = (
        f"pictures are {width} x {height}, the calibration is for {intrinsics.width} x {intrinsics.height}"
    )
    if min(width, height) > 0 and is_resized(intrinsics, width, height):
        return rescaled(intrinsics, width, height), f"{sizes}: rescaled"
    left, top, right, bottom = bars
    inner_width, inner_height = width - left - right, height - top - bottom
    off_px2 = abs(inner_width * intrinsics.height - inner_height * intrinsics.width)
    if any(bars) and min(inner_width, inner_height) > 0 and off_px2 <= intrinsics.width + intrinsics.height:
        inner = rescaled(intrinsics, inner_width, inner_height)
        moved = replace(inner, width=width, height=height, cx=inner.cx + left, cy=inner.cy + top)
        shown = f"black bars of {left} px left, {top} above, {right} right, {bottom} below"
        return moved, f"{sizes}: {shown}; rescaled to the {inner_width} x {inner_height} px between them"
    sx, sy = width / intrinsics.width, height / intrinsics.height
    if max(abs(sx - 1), abs(sy - 1)) <= 0.02:
        return replace(intrinsics, width=width, height=height), f"{sizes}: within 2 %, used as it is"
    raise ValueError(f"{sizes}: another shape, and more than 2 % off")


def _distort_none(normalised: Float, _: tuple[float, ...]) -> Float:
    return normalised


def _distort_radtan(normalised: Float, coefficients: tuple[float, ...]) -> Float:
    distorted, jacobian = _radtan(normalised, coefficients)
    return np.where(_radtan_holds(normalised, jacobian, coefficients)[..., None], distorted, np.nan)


def _distort_fisheye(normalised: Float, coefficients: tuple[float, ...]) -> Float:
    radius = np.hypot(normalised[..., 0], normalised[..., 1])
    theta = np.arctan(radius)
    theta_distorted, _ = _fisheye_angle(theta, coefficients)
    factor = np.where(radius > 0, theta_distorted / np.where(radius > 0, radius, 1.0), 1.0)
    valid = theta < _fisheye_limit(coefficients)
    return np.where(valid[..., None], normalised * factor[..., None], np.nan)


def _undistort_radtan(distorted: Float, coefficients: tuple[float, ...]) -> Float:
    """Invert the model by Newton's method, from the exact solution without the tangential part."""
    target = np.hypot(distorted[:, 0], distorted[:, 1])
    radius = _invert(lambda r: _radtan_radius(r, coefficients), target, _radtan_limit(coefficients))
    normalised = distorted * np.where(target > 0, radius / target, 1.0)[:, None]
    for _ in range(20):
        value, jacobian = _radtan(normalised, coefficients)
        step = _solve_symmetric(jacobian, distorted - value)
        normalised = normalised + step
        small = np.abs(step) <= 1e-10 * np.maximum(1.0, np.abs(normalised))
        # NaN steps (a singular Jacobian) never become small.
        if (small | np.isnan(step)).all():
            break
    _, jacobian = _radtan(normalised, coefficients)
    solved = small.all(axis=1) & _radtan_holds(normalised, jacobian, coefficients)
    return np.where(solved[:, None], normalised, np.nan)


def _undistort_fisheye(distorted: Float, coefficients: tuple[float, ...]) -> Float:
    target = np.hypot(distorted[:, 0], distorted[:, 1])
    limit = _fisheye_limit(coefficients)
    theta = _invert(lambda angle: _fisheye_angle(angle, coefficients), target, limit)
    value, slope = _fisheye_angle(theta, coefficients)
    solved = (np.abs(value - target) <= 1e-10 * slope) & (theta < limit)
    factor = np.where(target > 0, np.tan(theta) / target, 1.0)
    return np.where(solved[:, None], distorted * factor[:, None], np.nan)


_DISTORT = {"none": _distort_none, "radtan": _distort_radtan, "fisheye": _distort_fisheye}
_UNDISTORT = {"none": _distort_none, "radtan": _undistort_radtan, "fisheye": _undistort_fisheye}


def _radtan(normalised: Float, coefficients: tuple[float, ...]) -> tuple[Float, tuple[Float, Float, Float]]:
    """Evaluate Brown's model in OpenCV's form, and its symmetric Jacobian as (xx, xy, yy)."""
    x, y = normalised[..., 0], normalised[..., 1]
    p1, p2 = coefficients[2:4]
    square = x * x + y * y
    gain, slope = _radtan_gain(square, coefficients)
    distorted = np.stack(
        [
            x * gain + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * gain + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )
    xx = gain + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yy = gain + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return distorted, (xx, xy, yy)


def _radtan_holds(
    normalised: Float, jacobian: tuple[Float, Float, Float], coefficients: tuple[float, ...]
) -> Bool:
    """Test if the model has not folded at points: inside its limit, with a positive definite Jacobian."""
    xx, xy, yy = jacobian
    inside = np.hypot(normalised[..., 0], normalised[..., 1]) < _radtan_limit(coefficients)
    return inside & (xx * yy - xy * xy > 0) & (xx + yy > 0)


def _radtan_gain(square: Float, coefficients: tuple[float, ...]) -> tuple[Float, Float]:
    """Compute the radial factor at a squared radius, and its derivative by the squared radius."""
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    gain = 1 + square * (k1 + square * (k2 + square * k3))
    slope = k1 + square * (2 * k2 + square * (3 * k3))
    if k4 or k5 or k6:
        below = 1 + square * (k4 + square * (k5 + square * k6))
        gain = gain / below
        slope = (slope - gain * (k4 + square * (2 * k5 + square * (3 * k6)))) / below
    return gain, slope


def _radtan_radius(radius: Float, coefficients: tuple[float, ...]) -> tuple[Float, Float]:
    """Compute the distorted radius without the tangential part, and its derivative."""
    square = radius * radius
    gain, slope = _radtan_gain(square, coefficients)
    return radius * gain, gain + 2 * square * slope


@lru_cache(maxsize=256)
def _radtan_limit(coefficients: tuple[float, ...]) -> float:
    """Find the radius up to which the distorted radius grows: its first maximum, or the first pole."""
    k1, k2, _, _, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    above, below = np.polynomial.Polynomial([1, k1, k2, k3]), np.polynomial.Polynomial([1, k4, k5, k6])
    square = np.polynomial.Polynomial([0, 1])
    slope = above * below + 2 * square * (above.deriv() * below - above * below.deriv())
    return min(math.sqrt(min(_first_positive_root(slope), _first_positive_root(below))), _WIDEST)


def _fisheye_angle(theta: Float, coefficients: tuple[float, ...]) -> tuple[Float, Float]:
    """Compute the distorted angle (Kannala & Brandt 2006, Eq. 6, in OpenCV's scaling) and its derivative."""
    k1, k2, k3, k4 = coefficients
    square = theta * theta
    gain = 1 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
    slope = 1 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
    return theta * gain, slope


@lru_cache(maxsize=256)
def _fisheye_limit(coefficients: tuple[float, ...]) -> float:
    """Find the angle up to which the distorted angle grows and the point is in front of the camera."""
    k1, k2, k3, k4 = coefficients
    slope = np.polynomial.Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    return min(math.sqrt(_first_positive_root(slope)), math.atan(_WIDEST))


def _first_positive_root(polynomial: np.polynomial.Polynomial) -> float:
    """Find the smallest positive root of a polynomial that is 1 at 0; infinity without one."""
    # Roots of the reversed polynomial are the reciprocals. Its leading coefficient is 1, so it stays
    # well conditioned when the highest coefficients are tiny or zero.
    reciprocals = np.asarray(np.polynomial.Polynomial(polynomial.coef[::-1]).roots(), dtype=np.complex128)
    largest = float(np.max(reciprocals.real[reciprocals.imag == 0], initial=0.0))
    return 1 / largest if largest > 1 / _WIDEST**2 else math.inf


def _invert(function: Callable[[Float], tuple[Float, Float]], target: Float, limit: float) -> Float:
    """Solve f(u) = target on [0, limit] by Newton and bisection for an f (with f') that grows; or limit."""
    low, high = np.zeros_like(target), np.full_like(target, limit)
    solution = np.minimum(target, limit)
    for _ in range(100):
        value, slope = function(solution)
        above = value > target
        high, low = np.where(above, solution, high), np.where(above, low, solution)
        newton = solution - (value - target) / slope
        better = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
        settled = np.abs(better - solution) <= 1e-14 * np.maximum(1.0, solution)
        solution = better
        if settled.all():
            break
    return solution


def _solve_symmetric(matrix: tuple[Float, Float, Float], right: Float) -> Float:
    """Solve 2 x 2 systems given as (xx, xy, yy); NaN or infinite where singular."""
    xx, xy, yy = matrix
    x, y = right[..., 0], right[..., 1]
    determinant = xx * yy - xy * xy
    return np.stack([(yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant], axis=-1)
