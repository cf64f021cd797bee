"""Rendered pictures against the geometry of the scene."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Intrinsics
from pipelines.geometry.cameras import project, row_delay_s, undistort
from pipelines.geometry.poses import (
    invert,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotate,
    transform,
)
from pipelines.simulation.raster import TriangleSurface, hidden_by
from pipelines.simulation.renderer import EXPOSURE, STEP_S, ExposedMoment, Renderer, exposed_moments

Pose = tuple[Float, Float]

SUN = np.array([0.4, -0.3, 0.8])
CAMERA = Intrinsics(160, 120, 150.0, 140.0, 82.3, 57.6)
SEED = 3


def looking(position: tuple[float, float, float], at: tuple[float, float, float]) -> Pose:
    """Return a camera that looks at a point with its x axis level (world x if it looks straight down)."""
    forward = np.array(at, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-9 else right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return np.array(position, float), quaternion_from_matrix(rotation)


def rays(pose: Pose, intrinsics: Intrinsics = CAMERA) -> Float:
    """Return directions [H, W, 3] in the world through the pixels' centres, of depth 1."""
    x, y = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    normalised = undistort(np.stack([x, y], axis=-1).astype(float), intrinsics)
    return rotate(pose[1], np.concatenate([normalised, np.ones((*x.shape, 1))], axis=-1))


def surface(
    vertices: Float, faces: NDArray[np.int32], grey: float = 0.5, *, smooth: bool = False
) -> TriangleSurface:
    return TriangleSurface(vertices, faces, np.full((len(vertices), 3), grey, np.float32), smooth)


def rectangle(centre: Float, along: Float, across: Float, grey: float = 0.5) -> TriangleSurface:
    """Make a rectangle of two triangles; `along` and `across` are half its sides."""
    corners = np.stack(
        [centre - along - across, centre + along - across, centre + along + across, centre - along + across]
    )
    return surface(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), grey)


def level(half_m: float, height_m: float = 0.0, grey: float = 0.5) -> TriangleSurface:
    return rectangle(
        np.array([0.0, 0.0, height_m]), np.array([half_m, 0.0, 0.0]), np.array([0.0, half_m, 0.0]), grey
    )


def box(low: Float, high: Float) -> TriangleSurface:
    """Make a box of twelve triangles."""
    corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return surface(np.where(corner == 1, high, low), np.array(faces, np.int32))


def sphere(centre: Float, radius: float, sectors: int = 48, rings: int = 24) -> TriangleSurface:
    """Make a sphere with corners on its surface, each counted once."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    turn = np.arange(sectors) * 2 * np.pi / sectors
    z, rho = np.broadcast_to(np.cos(polar), (rings - 1, sectors)), np.sin(polar)
    ring = np.stack([rho * np.cos(turn), rho * np.sin(turn), z], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([ring, [[0, 0, 1.0], [0, 0, -1.0]]])
    top, bottom = len(ring), len(ring) + 1
    faces = []
    for j in range(sectors):
        following = (j + 1) % sectors
        faces += [(top, j, following), (bottom, top - sectors + following, top - sectors + j)]
        for i in range(rings - 2):
            a, b = i * sectors + j, i * sectors + following
            faces += [(a, a + sectors, b), (b, a + sectors, b + sectors)]
    return surface(centre + radius * vertices, np.array(faces, np.int32), smooth=True)


def renderer(*static: TriangleSurface, intrinsics: Intrinsics = CAMERA) -> Renderer:
    return Renderer(static, intrinsics, sun=SUN, seed=SEED)


def test_what_lies_behind_a_sphere_is_hidden() -> None:
    """Lines that pass the middle within 0.99 of the radius meet the polyhedron, beyond 1 they do not."""
    ball, eye = sphere(np.array([0.0, 0.0, 1.0]), 0.8), np.array([0.0, -6.0, 1.0])
    turn = np.linspace(0, 2 * np.pi, 50)
    for share, expected in ((0.3, True), (0.99, True), (1.001, False)):
        sine = share * 0.8 / 6.0
        along = np.stack(
            [sine * np.cos(turn), np.full(50, np.sqrt(1 - sine**2)), sine * np.sin(turn)], axis=1
        )
        assert (hidden_by(ball, eye, eye + 12.0 * along) == expected).all()
        assert not hidden_by(ball, eye, eye + 5.1 * along).any()


def linear(picture: NDArray[np.uint8]) -> Float:
    """Convert bytes to light, below the tone curve's shoulder: the inverse of sRGB."""
    value = picture.astype(float) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4) / EXPOSURE


@pytest.mark.parametrize("moves", [False, True])
def test_the_shadow_of_a_box_falls_where_its_corners_throw_it(moves: bool) -> None:
    """Every pixel of the ground whose line to the sun hits the box is dark, the others are light.

    Left out are pixels nearer to the shadow's border than a map can tell: a look-up reaches two texels
    of 2 cm, which the sun's elevation of 58 degrees stretches by 1.2, and leaves the surface by two
    texels: 0.09 m in all, and a pixel of 0.08 m with the lens's softness on either side.
    """
    low, high = np.array([-0.5, -0.4, 0.0]), np.array([0.5, 0.6, 1.5])
    cube = box(low, high)
    pose = looking((0.0, 0.0, 12.0), (0.0, 0.0, 0.0))
    plane = level(30.0)
    one = renderer(plane) if moves else renderer(plane, cube)
    picture = one.picture(*pose, [cube] if moves else [], 0)
    light = linear(picture)[..., 1]
    points = pose[0] + rays(pose) * (pose[0][2] / -rays(pose)[..., 2:])

    def shaded(ground: Float) -> Bool:
        with np.errstate(divide="ignore"):
            ends = np.stack([(low - ground) / SUN, (high - ground) / SUN])
        return np.asarray(ends.min(axis=0).max(axis=-1) < ends.max(axis=0).min(axis=-1))

    reach = 0.09 + 2 * 0.08
    around = [reach * np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(16) * np.pi / 8]
    votes = np.mean([shaded(points + step) for step in around], axis=0)
    # Seen from 12 m above, the box covers what its top does at 10.5 m, and a pixel more.
    way = points - pose[0]
    near = pose[0] + way * ((12.0 - high[2]) / 12.0)
    beside = ~((near > low - 0.1) & (near < high + 0.1))[..., :2].all(axis=-1)
    dark, bright = beside & (votes == 1), beside & (votes == 0)
    assert dark.sum() > 30
    between = (np.median(light[dark]) + np.median(light[bright])) / 2
    assert np.median(light[bright]) > 2.5 * np.median(light[dark])
    assert (light[dark] < between).all()
    assert (light[bright] > between).all()


@pytest.mark.parametrize(
    ("camera", "sun", "message"),
    [
        (Intrinsics(64, 48, 20, 20, 31, 23, "radtan", (-0.3, 0, 0, 0)), SUN, "no ray reaches"),
        (CAMERA, np.array([1.0, 0.0, -0.1]), "above the horizon"),
    ],
)
def test_what_cannot_be_rendered_is_refused(camera: Intrinsics, sun: Float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Renderer([], camera, sun=sun, seed=0)


LENS = Intrinsics(240, 180, 170.0, 165.0, 121.0, 88.0, "radtan", (-0.132, 0.111, 0.001, -0.002, -0.016), 0.03)
TURN_RADPS = np.array([0.2, -1.5, 0.3])  # of the camera about its own axes: 255 px/s
FALL_MPS = np.array([0.3, 0.0, -2.0])  # of the markers


@pytest.mark.parametrize(("exposure_s", "readout_s"), [(0.0, 0.0), (0.004, 0.0), (0.0, 0.03), (0.003, 0.02)])
def test_each_row_is_exposed_about_its_own_time(exposure_s: float, readout_s: float) -> None:
    """Weights are a box of the exposure about the row's time: their mean and variance are the box's.

    Light that is linear between moments adds the variance of the hat functions, 0 to 1/4 of a squared step.
    """
    lens = Intrinsics(64, 48, 50.0, 50.0, 31.0, 23.0, readout_s=readout_s)
    moments, weights = exposed_moments(lens.height, exposure_s=exposure_s, readout_s=readout_s)
    assert moments[len(moments) // 2] == pytest.approx(0.0, abs=1e-12)  # the picture's own time
    assert (np.diff(moments) <= STEP_S + 1e-12).all()
    assert weights.min() >= -1e-12
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-12)
    middle = row_delay_s(np.arange(48.0), lens)
    np.testing.assert_allclose(moments @ weights, middle, atol=1e-12)
    variance = moments**2 @ weights - middle**2 - exposure_s**2 / 12
    assert variance.min() > -1e-15
    assert variance.max() <= STEP_S**2 / 4 + 1e-15


def test_markers_lie_where_they_are_projected() -> None:
    """Dark balls fall while the camera turns: each is filmed where it is when its own row is read.

    The centre of a ball's outline is 0.02 px from its centre's projection. Noise of 1.8 in steps of 8 bits
    over some 50 pixels of 150 steps moves the centre of gravity by 0.01 px. Light that is linear between
    moments of 1 ms is not off on average; within one the image moves by 0.3 px.
    """
    lens = LENS
    places = np.array([[x, 8.0, z] for x in (-4.0, 0.1, 4.2) for z in (-2.4, 0.3, 2.7)])
    pose = looking((0.0, 0.0, 0.3), (0.0, 8.0, 0.2))

    def at(t_s: float) -> tuple[Pose, Float]:
        turned = multiply(pose[1], quaternion_from_rotation_vector(t_s * TURN_RADPS))
        return (pose[0] + t_s * np.array([1.0, 0.5, 0.0]), turned), places + t_s * FALL_MPS

    def moment(t_s: float, seen: bool) -> ExposedMoment:
        camera, centres = at(t_s)
        return ExposedMoment(
            *camera, [surface_of_all([sphere(c, 0.12, 24, 12) for c in centres])] if seen else []
        )

    moments, weights = exposed_moments(lens.height, exposure_s=0.004, readout_s=lens.readout_s)
    one = renderer(intrinsics=lens)
    with_balls, without = (
        linear(one.exposed([moment(t_s, seen) for t_s in moments], weights, 0)) for seen in (True, False)
    )
    dark = (1 - with_balls / without).mean(axis=2)
    y, x = np.mgrid[: lens.height, : lens.width]
    moved = 0.0
    for number in range(len(places)):
        t_s = 0.0
        for _ in range(6):
            camera, centres = at(t_s)
            expected = project(transform(invert(*camera), centres[number]), lens)
            t_s = float(row_delay_s(expected[1], lens))
        camera, centres = at(0.0)
        moved = max(
            moved, float(np.abs(expected - project(transform(invert(*camera), centres[number]), lens)).max())
        )
        near = np.hypot(x - expected[0], y - expected[1]) < 7
        found = [(dark * near * axis).sum() / (dark * near).sum() for axis in (x, y)]
        np.testing.assert_allclose(found, expected, atol=0.1)
    assert moved > 2.0


def surface_of_all(parts: list[TriangleSurface]) -> TriangleSurface:
    """Black, as one surface."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, first, strict=False)]).astype(
            np.int32
        ),
        0.0,
    )
