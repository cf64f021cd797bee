"""The ground with its mounds, trees and walls: exact solids, their places, surfaces and map.

Shapes are rows of numbers, all in metres of the world:

- mound: x, y, cos yaw, sin yaw, sigma along, sigma across, height
- trunk, an upright capped cylinder: x, y, low z, high z, radius
- crown, an ellipsoid: x, y, z, horizontal semi-axis, vertical semi-axis; crown k belongs to trunk k
- slab, an upright box: x, y, cos yaw, sin yaw, half length, half thickness, low z, high z

Solids are open sets: a point that only touches them is not hidden.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.arrays import Bool, Float, Int32, Int64
from pipelines.geometry.compilation import cached
from pipelines.session.errors import DataError
from pipelines.session.records import Occupancy
from pipelines.simulation import scenario
from pipelines.simulation.raster import TriangleSurface, joined


@dataclass(frozen=True)
class MoundedGround:
    """Mounds h exp(-(a^2 + b^2) / 2) over z = 0, in sigmas a and b along their yawed axes."""

    mounds: Float  # [M, 7]

    def height(self, xy: Float) -> Float:
        """Compute the ground's height, m, [...] at points [..., 2]; NaN at NaN where there are mounds."""
        points = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2)
        out = np.empty(len(points))
        _heights(self.mounds, points, out)
        return out.reshape(np.shape(xy)[:-1])

    @property
    def slope(self) -> float:
        """Upper bound of the ground's slope: a Gaussian is steepest one sigma out, h / sigma exp(-1/2)."""
        return float((self.mounds[:, 6] / self.mounds[:, 4:6].min(axis=1)).sum() * math.exp(-0.5))

    @property
    def curvature(self) -> float:
        """Upper bound of second derivatives, any direction, 1/m: a Gaussian's is h / sigma^2, at its top."""
        return float((self.mounds[:, 6] / self.mounds[:, 4:6].min(axis=1) ** 2).sum())

    def curvature_within(self, centre: Float, radius_m: float) -> Float:
        """Compute an upper bound like `curvature`, within circles about points [N, 2].

        r sigmas out, |r^2 - 1| exp(-r^2 / 2) and exp(-r^2 / 2) times h / sigma^2 are the principal second
        derivatives of a round mound; for an oval one they are at most those with its smaller sigma.
        """
        total = np.zeros(len(centre))
        for x, y, _, _, along, across, height in self.mounds:
            away = np.hypot(centre[:, 0] - x, centre[:, 1] - y) - radius_m
            squared = np.maximum(away / max(along, across), 0) ** 2
            total += height / min(along, across) ** 2 * np.minimum(1, (1 + squared) * np.exp(-squared / 2))
        return total


@cached
def _heights(mounds: Float, xy: Float, out: Float) -> None:
    # Compiled for the exponential of the C library: NumPy's differs in the last digit between processors.
    for n in range(len(xy)):
        total = 0.0
        for k in range(len(mounds)):
            east, north = xy[n, 0] - mounds[k, 0], xy[n, 1] - mounds[k, 1]
            along = (mounds[k, 2] * east + mounds[k, 3] * north) / mounds[k, 4]
            across = (mounds[k, 2] * north - mounds[k, 3] * east) / mounds[k, 5]
            total += mounds[k, 6] * math.exp(-0.5 * (along * along + across * across))
        out[n] = total


def raise_mounds(mounds: Sequence[scenario.Mound]) -> MoundedGround:
    """Return the ground that a scenario describes."""
    rows = [
        (
            *m.centre,
            math.cos(math.radians(m.yaw_deg)),
            math.sin(math.radians(m.yaw_deg)),
            *m.sigma_m,
            m.height_m,
        )
        for m in mounds
    ]
    return MoundedGround(np.array(rows, dtype=np.float64).reshape(-1, 7))


# Beyond this the horizon is less than two pixels away for a drone at 5 m.
_FAR_M = 2000.0
# The square of the ground has at least so many cells along a side.
_CELLS = 16
# Cells outside of the square are at most half as wide as their distance from it.
_GROWTH = 0.5
# Triangles lie no further than this from the ground.
_FLATNESS_M = 0.02
# So many halvings give cells of 3 to 6 cm, however steep a mound is.
_FINEST = 17
_GRASS = (0.115, 0.15, 0.055)  # mean reflectance of a meadow; the texture of the ground varies it


def ground_surface(ground: scenario.GroundSquare, terrain: MoundedGround) -> TriangleSurface:
    """Triangulate the corners of a quadtree, whose cells are halved until the ground in them is flat.

    A linear triangle within a circle of radius r errs by at most curvature r^2 / 2 (r = side / sqrt 2).
    """
    from scipy.spatial import Delaunay

    cell_m = ground.size_m / _CELLS
    whole_m = cell_m * 2 ** math.ceil(math.log2(2 * max(_FAR_M, 3 * ground.size_m) / cell_m))
    corners, finest_m = _corners(ground, terrain, whole_m)
    local = corners * finest_m - whole_m / 2
    faces = Delaunay(local).simplices.astype(np.int32)  # counterclockwise in the plane
    xy = local + np.array(ground.centre)
    a, b, c = xy[faces[:, 0]], xy[faces[:, 1]], xy[faces[:, 2]]
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces[turn < 0] = faces[turn < 0][:, ::-1]
    vertices = np.concatenate([xy, terrain.height(xy)[:, None]], axis=1)
    colour = np.tile(np.array(_GRASS, np.float32), (len(vertices), 1))
    return TriangleSurface(vertices, faces, colour, smooth=True, ground=True)


def _corners(ground: scenario.GroundSquare, terrain: MoundedGround, whole_m: float) -> tuple[Int64, float]:
    """Return the cells' corners [V, 2], in units of the finest cell's side, and that side in metres."""
    finest_m = whole_m / 2**_FINEST
    cells, side = np.zeros((1, 2), dtype=np.int64), 2**_FINEST
    found = []
    while len(cells):
        centre = (cells + side / 2) * finest_m - whole_m / 2
        side_m = side * finest_m
        outside = np.abs(centre).max(axis=1) - side_m / 2 - ground.size_m / 2
        allowed = np.maximum(1.001 * ground.size_m / _CELLS, _GROWTH * outside)
        # Triangles join corners of neighbouring cells, too: look a cell further.
        curvature = terrain.curvature_within(centre + np.array(ground.centre), side_m * 1.5)
        wide: NDArray[np.bool_] = (side_m > allowed) | (curvature * side_m**2 / 4 > _FLATNESS_M)
        split = wide & (side > 1)
        steps = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
        found.append((cells[~split][:, None] + steps * side).reshape(-1, 2))
        side //= 2
        cells = (cells[split][:, None] + steps * side).reshape(-1, 2)
    return np.unique(np.concatenate(found), axis=0), finest_m


# A wood that has no room after so many tries is too dense.
_TRIES = 200
# Trunks stand at least this share of a crown radius apart, so that no two trees coincide.
_APART = 0.9
# A tree is up to this share lower or higher than the wood.
_HEIGHT_SPREAD = 0.25
_SLENDER, _STOUT = 0.21, 0.31  # crown radius of the tree's height


def plant(
    wood: scenario.Wood,
    rng: np.random.Generator,
    *,
    keep_clear: Float,
    standing: Sequence[scenario.Tree],
    walls: Sequence[scenario.Wall],
) -> list[scenario.Tree]:
    """Place a wood's trees at random, apart from all else, clear of the actor's way; DataError: no room."""
    trees = list(standing)
    for planted in range(wood.count):
        for _ in range(_TRIES):
            tree = _seedling(wood, rng)
            x, y = tree.position
            if (
                all(
                    math.hypot(x - other.position[0], y - other.position[1])
                    >= _APART * max(tree.crown_radius_m, other.crown_radius_m)
                    for other in trees
                )
                and all(
                    _away_from(wall, x, y) >= wall.thickness_m / 2 + 0.1 * tree.height_m for wall in walls
                )
                and bool((np.hypot(keep_clear[:, 0] - x, keep_clear[:, 1] - y) >= wood.clear_m).all())
            ):
                trees.append(tree)
                break
        else:
            raise DataError(
                "world.wood",
                f"found room for {planted} of {wood.count} trees within {wood.radius_m:g} m of "
                f"{wood.centre} and {wood.clear_m:g} m off the actor's way",
                "take fewer or smaller trees, a larger radius_m or a smaller clear_m",
            )
    return trees[len(standing) :]


def _seedling(wood: scenario.Wood, rng: np.random.Generator) -> scenario.Tree:
    """Draw a tree anywhere in the wood's circle."""
    bearing, share, size, girth = rng.uniform(size=4).tolist()
    away = wood.radius_m * math.sqrt(share)  # as many trees on every square metre
    height = wood.height_m * (1 + _HEIGHT_SPREAD * (2 * size - 1))
    place = [
        wood.centre[0] + away * math.cos(2 * math.pi * bearing),
        wood.centre[1] + away * math.sin(2 * math.pi * bearing),
    ]
    radius = height * (_SLENDER + (_STOUT - _SLENDER) * girth)
    return scenario.Tree.model_construct(position=place, height_m=height, crown_radius_m=radius)


def _away_from(wall: scenario.Wall, x: float, y: float) -> float:
    (ax, ay), (bx, by) = wall.start, wall.end
    square = (bx - ax) ** 2 + (by - ay) ** 2
    share = min(max(((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / square, 0), 1) if square else 0.0
    return math.hypot(x - ax - share * (bx - ax), y - ay - share * (by - ay))


# The crown takes this upper share of the height of a tree.
_CROWN_SHARE = 0.62
# The radius of a trunk is this share of the height of the tree.
_TRUNK_SHARE = 0.03
# Solids reach no deeper than this into steep ground.
_MOST_BURIED_M = 50.0


@dataclass(frozen=True)
class Obstacles:
    """Solids on the ground, as rows of numbers. Tree k has trunk and crown k."""

    trunks: Float  # [T, 5]
    crowns: Float  # [T, 5]
    slabs: Float  # [W, 8]


def erect(
    terrain: MoundedGround, trees: Sequence[scenario.Tree], walls: Sequence[scenario.Wall]
) -> Obstacles:
    """Stand trees and walls on the ground. DataError: a wall begins where it ends.

    A crown is the upper 62 % of a tree; the trunk, 3 % of the height in radius, ends in the crown's middle. A
    wall is level on top, `height_m` above the highest ground under its line. Both reach below the lowest
    ground that they stand on.
    """
    return Obstacles(
        np.array([_trunk(terrain, tree) for tree in trees]).reshape(-1, 5),
        np.array([_crown(terrain, tree) for tree in trees]).reshape(-1, 5),
        np.array([_slab(terrain, k, wall) for k, wall in enumerate(walls)]).reshape(-1, 8),
    )


def _foot(terrain: MoundedGround, tree: scenario.Tree) -> float:
    return float(terrain.height(np.array(tree.position)))


def _trunk(terrain: MoundedGround, tree: scenario.Tree) -> tuple[float, ...]:
    foot, radius = _foot(terrain, tree), min(_TRUNK_SHARE * tree.height_m, tree.crown_radius_m)
    buried = min(0.1 + radius * terrain.slope, _MOST_BURIED_M)
    return (*tree.position, foot - buried, foot + (1 - _CROWN_SHARE / 2) * tree.height_m, radius)


def _crown(terrain: MoundedGround, tree: scenario.Tree) -> tuple[float, ...]:
    upright = _CROWN_SHARE / 2 * tree.height_m
    centre = _foot(terrain, tree) + tree.height_m - upright
    return (*tree.position, centre, tree.crown_radius_m, upright)


def _slab(terrain: MoundedGround, k: int, wall: scenario.Wall) -> tuple[float, ...]:
    start, end = np.array(wall.start), np.array(wall.end)
    length = math.hypot(*(end - start))
    if length == 0:
        raise DataError(f"world.walls[{k}]", f"begins where it ends, at {wall.start}", "give it a length")
    along = (end - start) / length
    across = np.array([-along[1], along[0]]) * wall.thickness_m / 2
    steps = min(2 + math.ceil(length / 0.1), 20_000)
    line = start + np.linspace(0, length, steps)[:, None] * along
    under = terrain.height(line[:, None] + np.array([[-1.0], [0.0], [1.0]]) * across)
    # Between samples the ground falls by no more than its slope allows.
    unseen = terrain.slope * math.hypot(length / (steps - 1) / 2, wall.thickness_m / 4)
    low = under.min() - 0.1 - min(unseen, _MOST_BURIED_M)
    middle = (start + end) / 2
    return (*middle, *along, length / 2, wall.thickness_m / 2, low, under[:, 1].max() + wall.height_m)


# A trunk is drawn as a prism with so many sides.
_SIDES = 10
# Bark is mottled at so many heights of a trunk.
_RINGS = 5
# The leaves of a crown stand in so many clusters.
_CLUSTERS = 16
# Leaves always fill this share of the radius, so that no line of sight slips through.
_HEART = 0.8
# This power mean of the radii is 1, so that the outline of a crown has the size of its ellipsoid.
_OUTLINE = 12
# Leaves deviate from their cluster by this share of the radius of the crown.
_RAGGED = 0.04
# More trees than this are drawn with fewer triangles each.
_MANY_TREES = 40
_BARK = (0.16, 0.115, 0.08)
_GREENS = ((0.10, 0.19, 0.045), (0.13, 0.22, 0.05), (0.075, 0.155, 0.05), (0.165, 0.22, 0.06))
_STONE = (0.36, 0.33, 0.29)
_BLOCK_M = (0.6, 0.3)  # length and height of a wall's stones
_MOST_BLOCKS = (120, 20)  # along and up a wall; longer walls have larger stones


def tree_surfaces(obstacles: Obstacles, seed: int) -> list[TriangleSurface]:
    """Draw all trunks as one surface and all crowns as another; nothing without trees."""
    if not len(obstacles.trunks):
        return []
    sphere = _sphere(3 if len(obstacles.trunks) <= _MANY_TREES else 2)
    trunks, crowns = [], []
    for k, (trunk, crown) in enumerate(zip(obstacles.trunks, obstacles.crowns, strict=True)):
        rng = np.random.default_rng([seed, _LOOKS, k])
        trunks.append(_drawn_trunk(trunk, rng))
        crowns.append(_drawn_crown(crown, sphere, rng))
    return [joined(*trunks), joined(*crowns)]


def wall_surfaces(obstacles: Obstacles, seed: int) -> list[TriangleSurface]:
    """Draw all walls as one surface, stone by stone; nothing without walls."""
    if not len(obstacles.slabs):
        return []
    walls = [
        _drawn_wall(slab, np.random.default_rng([seed, _LOOKS + 1, k]))
        for k, slab in enumerate(obstacles.slabs)
    ]
    return [joined(*walls)]


def _drawn_trunk(trunk: Float, rng: np.random.Generator) -> TriangleSurface:
    x, y, low, high, radius = trunk
    bearing = np.arange(_SIDES) * (2 * np.pi / _SIDES)
    # The polygon has the circle's area: sides (1/2) R^2 sin(2 pi / sides) = pi r^2.
    outer = radius * math.sqrt(2 * np.pi / _SIDES / math.sin(2 * np.pi / _SIDES))
    ring = np.stack([x + outer * np.cos(bearing), y + outer * np.sin(bearing)], axis=1)
    levels = np.linspace(low, high, _RINGS)
    vertices = np.concatenate([np.column_stack([ring, np.full(_SIDES, z)]) for z in levels])
    this = np.arange(_SIDES)
    following = (this + 1) % _SIDES
    quads = np.concatenate(
        [
            np.stack([this, following, following + _SIDES, this + _SIDES], axis=1) + k * _SIDES
            for k in range(_RINGS - 1)
        ]
    )
    tone = rng.uniform(0.7, 1.3, len(vertices))
    return TriangleSurface(vertices, _split(quads), _colours(np.array(_BARK), tone), smooth=True)


def _drawn_crown(crown: Float, sphere: tuple[Float, Int32], rng: np.random.Generator) -> TriangleSurface:
    """Draw clusters of leaves around the middle: the outermost of some balls in every direction."""
    direction, faces = sphere
    middle = _spread(_CLUSTERS, rng) * rng.uniform(0.58, 0.66, _CLUSTERS)[:, None]
    size = rng.uniform(0.38, 0.46, _CLUSTERS)
    toward = np.einsum("vk,ck->vc", direction, middle)
    inside = size**2 - (middle**2).sum(axis=1) + toward**2
    reach = np.where(inside > 0, toward + np.sqrt(np.maximum(inside, 0)), 0)
    nearest = reach.argmax(axis=1)
    radius = np.maximum(reach.max(axis=1), _HEART)
    depth = np.clip((radius - _HEART) / (1.05 - _HEART), 0, 1)
    radius = np.clip(radius + rng.normal(0, _RAGGED, len(radius)), 0.7, 1.2)
    radius /= (radius**_OUTLINE).mean() ** (1 / _OUTLINE)
    green = np.array(_GREENS)[rng.integers(len(_GREENS))] * rng.uniform(0.85, 1.15)
    tone = rng.uniform(0.75, 1.25, _CLUSTERS)[nearest] * (0.5 + 0.5 * depth)  # dark between the clusters
    tone *= rng.uniform(0.75, 1.25, len(radius))
    vertices = crown[:3] + direction * radius[:, None] * crown[[3, 3, 4]]
    return TriangleSurface(vertices, faces, _colours(green, tone), smooth=False)


def _drawn_wall(slab: Float, rng: np.random.Generator) -> TriangleSurface:
    x, y, cos, sin, length, thickness, low, high = slab
    along, across = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    base = np.array([x, y, low])
    length, thickness, tall = 2 * length * along, 2 * thickness * across, (high - low) * up
    corner = base - length / 2 - thickness / 2
    sides = [
        (corner, length, tall),
        (corner + length + thickness, -length, tall),
        (corner + length, thickness, tall),
        (corner + thickness, -thickness, tall),
        (corner + tall, length, thickness),
    ]
    return joined(*(_stones(*side, rng) for side in sides))


def _stones(corner: Float, along: Float, up: Float, rng: np.random.Generator) -> TriangleSurface:
    """Draw a rectangle of stones, each with four corners of its own; seen from `along` x `up`."""
    columns, rows = (
        min(max(1, round(float(np.sqrt((edge**2).sum())) / size)), most)
        for edge, size, most in zip((along, up), _BLOCK_M, _MOST_BLOCKS, strict=True)
    )
    u, v = (part.ravel() for part in np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"))
    steps = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    s, t = (u[:, None] + steps[:, 0]) / columns, (v[:, None] + steps[:, 1]) / rows
    vertices = (corner + s[..., None] * along + t[..., None] * up).reshape(-1, 3)
    tone = np.repeat(rng.uniform(0.75, 1.2, len(u)), 4) * rng.uniform(0.92, 1.08, 4 * len(u))
    quads = np.arange(4 * len(u)).reshape(-1, 4)
    return TriangleSurface(vertices, _split(quads), _colours(np.array(_STONE), tone), smooth=False)


def _split(quads: NDArray[np.int64]) -> Int32:
    """Split each quadrangle [Q, 4] into two triangles [2 Q, 3]."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def _colours(colour: Float, tone: Float) -> NDArray[np.float32]:
    return np.clip(colour * tone[:, None], 0, 1).astype(np.float32)


def _spread(count: int, rng: np.random.Generator) -> Float:
    """Draw unit vectors [count, 3], evenly about the sphere (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    bearing = k * (np.pi * (1 + math.sqrt(5))) + rng.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - z**2)
    points = np.stack([flat * np.cos(bearing), flat * np.sin(bearing), z], axis=1)
    points += rng.normal(0, 0.18, points.shape)
    unit: Float = points / np.sqrt((points**2).sum(axis=1, keepdims=True))
    return unit


def _sphere(halvings: int) -> tuple[Float, Int32]:
    """Return directions and triangles of an icosahedron whose edges were halved some times."""
    g = (1 + math.sqrt(5)) / 2
    # Three golden rectangles; every triangle joins three corners that are mutually 2 apart.
    corners = np.array([np.roll((0.0, a, b * g), k) for k in range(3) for a in (-1, 1) for b in (-1, 1)])
    apart = ((corners[:, None] - corners) ** 2).sum(axis=-1)
    near = np.isclose(apart, 4)
    faces = np.array(
        [
            (a, b, c)
            for a in range(12)
            for b in range(a)
            for c in range(b)
            if near[a, b] and near[b, c] and near[a, c]
        ]
    )
    inward = np.linalg.det(corners[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(halvings):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, which = np.unique(edges, axis=0, return_inverse=True)
        middle = which.reshape(-1, 3) + len(corners)
        corners = np.concatenate([corners, corners[unique].sum(axis=1) / 2])
        (a, b, c), (ab, bc, ca) = faces.T, middle.T
        triangles = [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = np.concatenate([np.stack(triangle, axis=1) for triangle in triangles])
    return corners / np.sqrt((corners**2).sum(axis=1, keepdims=True)), faces.astype(np.int32)


# This number keeps the random numbers of looks apart from those of the wood.
_LOOKS = 2


# --- the world -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class World:
    """The surroundings: ground with mounds, trees, walls. The ground goes on beyond its square."""

    ground: scenario.GroundSquare
    terrain: MoundedGround
    obstacles: Obstacles
    seed: int

    def height(self, xy: Float) -> Float:
        """Compute the height of the ground [...], m, at points [..., 2]."""
        return self.terrain.height(xy)

    def surfaces(self) -> list[TriangleSurface]:
        """Return the visible surfaces: the ground out to the horizon, then trunks, crowns and walls if any.

        The ground is within 2 cm of `height`, trunks within 4 % of their radius, walls exact. Leaves end up
        to a fifth beyond or three tenths short of the ellipsoid of `hidden`; the outlines share about nine
        tenths.
        """
        return [
            ground_surface(self.ground, self.terrain),
            *tree_surfaces(self.obstacles, self.seed),
            *wall_surfaces(self.obstacles, self.seed),
        ]

    def hidden(self, eye: Float, target: Float) -> Bool:
        """Test if something solid stands between eyes and targets, [..., 3] each, broadcast.

        Exact for trunks, crowns and walls. The ground hides every line that dips more than 2 mm into it and
        none that dips less than 1 mm, so that points on the ground can be seen. Points inside a solid are
        hidden, and from there everything is hidden; False for NaN.
        """
        eyes, targets = np.broadcast_arrays(eye, target)
        # From the target: drones look down, so the way to them soon climbs faster than any mound.
        start = targets.reshape(-1, 3)
        way = eyes.reshape(-1, 3) - start
        found = np.zeros(len(start), dtype=np.bool_)
        left = np.flatnonzero(np.isfinite(way).all(axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            for meets in (self._meet_trees, self._meet_walls, self._meet_ground):
                found[left] = meets(start[left], way[left])
                left = left[~found[left]]
        return found.reshape(eyes.shape[:-1])

    def _meet_trees(self, start: Float, way: Float) -> Bool:
        """Test if lines [N, 3] from a start meet a trunk or a crown."""
        meet = np.zeros(len(start), dtype=np.bool_)
        flat2 = (way[:, :2] ** 2).sum(axis=1)
        for trunk, crown in zip(self.obstacles.trunks, self.obstacles.crowns, strict=True):
            (low, high, thin), (middle, wide, upright) = trunk[2:], crown[2:]
            away = start[:, :2] - trunk[:2]
            toward = (away * way[:, :2]).sum(axis=1)
            # Most trees are passed by: the nearest point of the line to the axis, seen from above.
            nearest = np.where(flat2 > 0, np.clip(-toward / flat2, 0.0, 1.0), 0.0)
            passed = away + nearest[:, None] * way[:, :2]
            (rows,) = np.nonzero(((passed**2).sum(axis=1) < max(thin, wide) ** 2) & ~meet)
            flat, along, off2 = flat2[rows], toward[rows], (away[rows] ** 2).sum(axis=1)
            z, climb = (start[rows, 2] - middle) / upright, way[rows, 2] / upright
            meet[rows] = _dips_below_zero(
                flat / wide**2 + climb * climb,
                along / wide**2 + z * climb,
                off2 / wide**2 + z * z - 1,
                0.0,
                1.0,
            )
            first, last = _between(start[rows, 2], way[rows, 2], low, high, 0.0, 1.0)
            meet[rows] |= (first < last) & _dips_below_zero(flat, along, off2 - thin**2, first, last)
        return meet

    def _meet_walls(self, start: Float, way: Float) -> Bool:
        meet = np.zeros(len(start), dtype=np.bool_)
        for x, y, cos, sin, length, thickness, low, high in self.obstacles.slabs:
            east, north = start[:, 0] - x, start[:, 1] - y
            first: Float | float = 0.0
            last: Float | float = 1.0
            for at, step, least, most in (
                (cos * east + sin * north, cos * way[:, 0] + sin * way[:, 1], -length, length),
                (cos * north - sin * east, cos * way[:, 1] - sin * way[:, 0], -thickness, thickness),
                (start[:, 2], way[:, 2], low, high),
            ):
                first, last = _between(at, step, least, most, first, last)
            meet |= first < last
        return meet

    def _meet_ground(self, start: Float, way: Float) -> Bool:
        """March along lines in steps that the slope bounds, but no shorter than the curvature allows."""
        length = np.hypot(way[:, 0], way[:, 1])
        fall = self.terrain.slope * length - way[:, 2]
        # Infinite over flat ground and for upright lines.
        least = np.sqrt(np.divide(8 * GRAZE_M, self.terrain.curvature)) / length
        end = start + way
        meet: Bool = end[:, 2] - self.height(end[:, :2]) < -GRAZE_M
        share, going = np.zeros(len(start)), np.flatnonzero(~meet)
        while len(going):
            at = start[going] + share[going, None] * way[going]
            clearance = at[:, 2] - self.height(at[:, :2])
            meet[going] = clearance < -GRAZE_M
            share[going] += np.maximum((clearance + GRAZE_M) / fall[going], least[going])
            going = going[~meet[going] & (fall[going] > 0) & (share[going] < 1)]
        return meet

    def occupancy(self, resolution_m: float, height_m: float) -> Occupancy:
        """Return voxels over the ground's square, from one below z = 0 up to a height: 1 occupied, 0 free.

        A voxel, on multiples of `resolution_m`, is occupied if the inside of a solid meets its own: exact for
        trunks, crowns and slabs, over mounds by at most 5 % of a voxel too much unless one is narrower than a
        tenth of it.
        """
        side, half, middle = resolution_m, self.ground.size_m / 2, np.array(self.ground.centre)
        first = np.floor((middle - half) / side + _TOUCH_M).astype(np.int64)
        end = np.ceil((middle + half) / side - _TOUCH_M).astype(np.int64)
        low = np.array([*first, -1], dtype=np.int64)
        shape = (*(end - first).tolist(), 1 + math.ceil(height_m / side - _TOUCH_M))
        grid = _filled_ground(self.terrain, low, shape, side)
        for trunk, crown in zip(self.obstacles.trunks, self.obstacles.crowns, strict=True):
            _mark_tree(grid, low, side, trunk, crown)
        for slab in self.obstacles.slabs:
            _mark_slab(grid, low, side, slab)
        return Occupancy(grid.astype(np.float32), low.astype(np.float64) * side, side)


GRAZE_M = 1e-3
"""Allowed depth of a line of sight in the ground, m; steps can overlook another such depth."""


def _dips_below_zero(a: Float, b: Float, c: Float, first: Float | float, last: Float | float) -> Bool:
    """Test if a t^2 + 2 b t + c, a >= 0, is negative somewhere in the open interval (first, last)."""
    lowest = np.minimum(np.maximum(np.where(a > 0, -b / a, first), first), last)
    return np.asarray((a * lowest + 2 * b) * lowest + c < 0)


def _between(
    start: Float, way: Float, low: float, high: float, first: Float | float, last: Float | float
) -> tuple[Float, Float]:
    """Return the part of (first, last) in which low < start + t way < high; empty when first >= last."""
    sides = np.stack([(low - start) / way, (high - start) / way])
    level, inside = way == 0, (low < start) & (start < high)
    enter = np.where(level, np.where(inside, first, 1.0), np.maximum(first, sides.min(axis=0)))
    leave = np.where(level, np.where(inside, last, 0.0), np.minimum(last, sides.max(axis=0)))
    return enter, leave


def _mark_tree(grid: Bool, low: Int64, side: float, trunk: Float, crown: Float) -> None:
    """Set the voxels [X, Y, Z] that a tree reaches into; voxel 0 begins at `low` sides."""
    radius, upright = crown[3:]
    reach = max(trunk[4], radius)
    lowest, highest = min(trunk[2], crown[2] - upright), max(trunk[3], crown[2] + upright)
    spans = [(trunk[0] - reach, trunk[0] + reach), (trunk[1] - reach, trunk[1] + reach), (lowest, highest)]
    voxels = tuple(_range(*span, side, low[k], grid.shape[k]) for k, span in enumerate(spans))
    begin = [(low[k] + np.arange(part.start, part.stop)) * side for k, part in enumerate(voxels)]
    # Scaling the axes keeps a box a box: its point nearest to the centre decides.
    east, north, up = (
        np.maximum(np.maximum(begin[k] - crown[k], crown[k] - begin[k] - side), 0.0) for k in range(3)
    )
    flat = (east[:, None] ** 2 + north**2)[..., None]
    in_trunk = (begin[2] + _TOUCH_M < trunk[3]) & (begin[2] + side - _TOUCH_M > trunk[2])
    grid[voxels] |= (flat / radius**2 + (up / upright) ** 2 < 1) | ((flat < trunk[4] ** 2) & in_trunk)


def _mark_slab(grid: Bool, low: Int64, side: float, slab: Float) -> None:
    """Set the voxels that a slab reaches into: from above, no axis of either separates the rectangles."""
    x, y, cos, sin, length, thickness = slab[:6]
    wide, deep = abs(cos) * length + abs(sin) * thickness, abs(sin) * length + abs(cos) * thickness
    spans = [(x - wide, x + wide), (y - deep, y + deep), (slab[6], slab[7])]
    voxels = tuple(_range(*span, side, low[k], grid.shape[k]) for k, span in enumerate(spans))
    east, north = (
        (low[k] + np.arange(part.start, part.stop)) * side + side / 2 - slab[k]
        for k, part in enumerate(voxels[:2])
    )
    spread = side / 2 * (abs(cos) + abs(sin))  # of a voxel along the slab's axes
    along = abs(cos * east[:, None] + sin * north) + _TOUCH_M < length + spread
    across = abs(cos * north - sin * east[:, None]) + _TOUCH_M < thickness + spread
    grid[voxels] |= (along & across)[..., None]


def _range(low_m: float, high_m: float, side: float, first: int, count: int) -> slice:
    """Return the voxels that an interval reaches into, cut to the grid."""
    begin = math.floor((low_m + _TOUCH_M) / side) - first
    end = math.ceil((high_m - _TOUCH_M) / side) - first
    return slice(max(begin, 0), max(min(end, count), 0))


def build_world(spec: scenario.WorldSettings, seed: int, *, keep_clear: Float) -> World:
    """Raise the mounds, plant the wood clear of points [K, 2] m, stand trees and walls on the ground."""
    terrain = raise_mounds(spec.mounds)
    trees = list(spec.trees)
    if spec.wood is not None:
        rng = np.random.default_rng([seed, _WOOD])
        trees += plant(spec.wood, rng, keep_clear=keep_clear, standing=trees, walls=spec.walls)
    return World(spec.ground, terrain, erect(terrain, trees, spec.walls), seed)


# This number keeps the random numbers of the wood apart from those of looks.
_WOOD = 1


# Voxels and solids that share a plane do not overlap for a rounding error.
_TOUCH_M = 1e-9
# The ground rises by at most this share of a voxel between two samples.
_FINE_ENOUGH = 0.05
# A voxel over a steep mound is sampled at no more places than this along a side.
_MOST_SAMPLES = 16


def _filled_ground(
    terrain: MoundedGround, low: NDArray[np.int64], shape: tuple[int, int, int], side_m: float
) -> Bool:
    # Between the corners of a square of side s a surface rises above them by at most curvature s^2 / 4:
    # linear interpolation errs by curvature r^2 / 2 within the circle of radius r = s / sqrt(2) around it.
    samples = math.ceil(math.sqrt(terrain.curvature * side_m / 4 / _FINE_ENOUGH))
    samples = min(max(samples, 1), _MOST_SAMPLES)
    margin = terrain.curvature * (side_m / samples) ** 2 / 4
    floor = (low[2] + np.arange(shape[2])) * side_m
    y = low[1] * side_m + np.arange(shape[1] * samples + 1) * (side_m / samples)
    grid = np.empty(shape, dtype=np.bool_)
    for i in range(shape[0]):
        x = (low[0] + i) * side_m + np.arange(samples + 1) * (side_m / samples)
        height = terrain.height(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)).max(axis=0)
        columns = [height[k : k + shape[1] * samples : samples] for k in range(samples + 1)]
        top = np.maximum.reduce(columns) + margin
        grid[i] = floor < top[:, None] - _TOUCH_M
    return grid
