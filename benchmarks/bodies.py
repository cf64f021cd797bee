"""Bodies fitted to the skeletons of rendered flights: `python -m benchmarks.accuracy bodies`.

The flights are those of `corpus` with the true noise model given, which is none for true poses; the default
network has two draws of the log's errors, every other case one.
Shape and rotations of the people are known. Where one person is filmed, the body is also fitted with the true
shape held: keypoints do not show how stout somebody is, so this bounds what they give. Each camera is also
one by itself, without a stated stature; with true poses once more with the true ground, because the map's
voxels of 0.25 m show its height to 0.13 m. "Landmarks" are the skeleton's shoulders, elbows, hips, knees and
ankles against the true joint centres, "centres" those of the body; both relative to the middle of the hips.
NEES is that of vertices, by body.parquet. Chi squared of three is above 4.5 in 21 % of flights, 7.8 in 5 %.
"""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import astuple, dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from ruamel.yaml import YAML

from benchmarks.corpus.drawn import DrawnFlight, Poses, kept_in_place_of_pictures
from benchmarks.corpus.stored import Flight, flights
from benchmarks.results import markdown_table
from pipelines.geometry.arrays import Float
from pipelines.geometry.body_model import SHAPE, body_model, shape_of
from pipelines.geometry.poses import cross_matrix, interpolate_poses
from pipelines.geometry.rig import BONES, CENTRES
from pipelines.ingest import ingest
from pipelines.reconstruct import ReconstructSettings, reconstruct
from pipelines.reconstruction.body_fit import Landmarks, SharedPrior, shared_prior
from pipelines.reconstruction.one_camera import GroundHeight
from pipelines.session.people import take_joints
from pipelines.session.records import POINT_COVARIANCE_COLUMNS, MovingBody
from pipelines.session.tables import (
    BODY,
    BODY_ROTATION_COLUMNS,
    BODY_SHAPE,
    SKELETON,
    load_bodies,
    read_motion,
    read_table,
)
from pipelines.simulation.scenario import Body

CASES: tuple[tuple[str, int, str, Poses], ...] = (
    ("default network", 0, "blazepose", "logged"),
    ("default network", 1, "blazepose", "logged"),
    ("heavy, true poses", 0, "blazepose-heavy", "true"),
)
"""Name, draw of the log's errors, detector and poses of the cases with all cameras."""
TRUE_SHAPE = "heavy, true shape"
ONE_CAMERA: dict[str, tuple[Poses, bool]] = {
    "one camera": ("logged", False),
    "one camera, true poses": ("true", False),
    "one camera, true poses and ground": ("true", True),
}
_GROUND_SIGMA_M = 0.03  # of a ground that was surveyed
_HELD = 1e6  # precision of a shape that is held
_TIMES = 25  # at which surfaces are compared
_VERTICES = 200


@dataclass(frozen=True)
class BodyErrors:
    """Errors of one body."""

    stature_mm: float
    stature_sigmas: float
    mpvpe_mm: float
    root_mpvpe_mm: float
    landmarks_mm: float
    centres_mm: float
    nees: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--flights", nargs="+", default=["kept"], help="tuning, kept, or names")


def run(options: argparse.Namespace) -> Iterator[tuple[str, list[str]]]:
    """Measure every flight; print a line for each body, and yield a table of means and medians."""
    found: dict[str, list[BodyErrors]] = {}
    for flight in flights():
        if flight.missing_motions or not {flight.half, flight.name} & set(options.flights):
            continue
        for case, errors in measured(flight):
            found.setdefault(case, []).append(errors)
            print(flight.name, case, *(f"{value:.1f}" for value in astuple(errors)), flush=True)
    rows = []
    for case, own in found.items():
        table = np.array([astuple(errors) for errors in own])
        mean, middle = table.mean(axis=0), np.median(table, axis=0)
        stature = np.abs(table[:, 0])
        cells = [f"{stature.mean():.0f} ({np.median(stature):.0f})"]
        cells += [f"{mean[k]:.0f} ({middle[k]:.0f})" for k in range(2, 6)]
        rows.append([case, str(len(own)), *cells, f"{mean[6]:.1f} ({table[:, 6].max():.1f})"])
    header = ["case", "bodies", "stature mm: mean (median)", "MPVPE", "MPVPE root-relative"]
    header += ["landmarks root-relative", "centres root-relative", "NEES: mean (largest)"]
    yield "bodies", markdown_table(header, rows)


def measured(flight: Flight) -> Iterator[tuple[str, BodyErrors]]:
    """Reconstruct one flight in every case, and measure the bodies."""
    with tempfile.TemporaryDirectory(prefix="bodies-") as folder:
        drawn = DrawnFlight(flight, Path(folder) / "shared")
        drawn.write_shared()
        for case, draw, detector, poses in CASES:
            session = drawn.session(Path(folder) / f"{poses}-{draw}", draw, "model", detector, poses=poses)
            with kept_in_place_of_pictures(flight, detector):
                reconstruct(session, ReconstructSettings(detector=detector))
            yield from ((case, errors) for errors in errors_of(session))
        people = drawn.simulated.people
        if len(people) == 1:
            with kept_in_place_of_pictures(flight, detector), _shape_held(people[0].look.body):
                reconstruct(session, ReconstructSettings(detector=detector), force=True)
            yield from ((TRUE_SHAPE, errors) for errors in errors_of(session))
        height = drawn.simulated.world.height
        level = GroundHeight(lambda places: height(places[:, :2]), _GROUND_SIGMA_M)
        known = patch("pipelines.reconstruction.bodies._height_of", lambda *_: level)
        for case, (given, ground_known) in ONE_CAMERA.items():
            place = Path(folder) / f"{given}-{ground_known}"
            drawn.session(place, 0, "model", "blazepose", poses=given)
            manifest = YAML(typ="safe").load(place / "flight.yaml")
            for drone, entry in manifest["cameras"].items():
                truth = manifest["truth"] | {"poses": {drone: manifest["truth"]["poses"][drone]}}
                YAML().dump(manifest | {"cameras": {drone: entry}, "truth": truth}, place / f"{drone}.yaml")
                session = ingest(place / f"{drone}.yaml", place / f"only_{drone}").folder
                with kept_in_place_of_pictures(flight, "blazepose"), known if ground_known else nullcontext():
                    reconstruct(session, ReconstructSettings())
                yield from ((case, errors) for errors in errors_of(session))


@contextmanager
def _shape_held(look: Body) -> Iterator[None]:
    """Fit bodies whose shape is that of a simulated person."""

    def prior(landmarks: Landmarks) -> SharedPrior:
        usual = shared_prior(landmarks)
        mean, precision = usual.mean.copy(), usual.precision.copy()
        mean[: len(SHAPE)] = shape_of(look.sex, look.build, look.height_m)
        precision[: len(SHAPE), : len(SHAPE)] = _HELD * np.eye(len(SHAPE))
        return SharedPrior(mean, precision)

    with patch("pipelines.reconstruction.body_fit.shared_prior", prior):
        yield


def errors_of(session: Path) -> Iterator[BodyErrors]:
    """Compare the bodies of a session with the nearest true ones."""
    place = session / "reconstruct"
    if not (place / "body.parquet").is_file():
        return
    table = read_table(place / "body.parquet", BODY)
    skeleton = read_motion(place / "skeleton.parquet", SKELETON)
    shapes = read_table(place / "body_shape.parquet", BODY_SHAPE)
    truth = load_bodies(session / "truth_body.parquet", session / "truth_body_shape.parquet")
    for body in load_bodies(place / "body.parquet", place / "body_shape.parquet"):
        near = [_at(each, body) for each in truth]
        far = [np.nanmedian(np.linalg.norm(body.centre - centre, axis=-1)) for centre, _ in near]
        centre, rotation = near[int(np.argmin(far))]
        shape = truth[int(np.argmin(far))].shape
        own = table[table["person"] == body.person]
        spread, turning = (
            own[list(columns)]
            .to_numpy(np.float64)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]
            .reshape(-1, len(BONES), 3, 3)
            for columns in (POINT_COVARIANCE_COLUMNS, BODY_ROTATION_COLUMNS)
        )
        sigma = shapes[(shapes["person"] == body.person) & (shapes["number"] == "stature_m")]["sigma"].item()
        stature = body.shape[0] - shape[0]
        rows = np.searchsorted(skeleton.t_ns, body.t_ns)
        seen = take_joints(skeleton.position[rows, body.person], skeleton.joints, tuple(CENTRES))
        bones = list(CENTRES.values())
        landmarks, centres = (
            1e3
            * float(np.nanmean(np.linalg.norm(_about_hips(each) - _about_hips(centre[:, bones]), axis=-1)))
            for each in (seen, body.centre[:, bones])
        )
        surface = _surface_errors(body, shape, centre, rotation, spread, turning)
        yield BodyErrors(1e3 * stature, stature / sigma, *surface[:2], landmarks, centres, surface[2])


def _at(truth: MovingBody, body: MovingBody) -> tuple[Float, Float]:
    """Interpolate a true body to the times of another: centres [T, 22, 3], rotations [T, 22, 4]."""
    limits = {"max_gap_ns": 200_000_000, "max_extrapolation_ns": 0}
    both = [
        interpolate_poses(truth.t_ns, truth.centre[:, bone], truth.rotation[:, bone], body.t_ns, **limits)
        for bone in range(len(BONES))
    ]
    return np.stack([each[0] for each in both], axis=1), np.stack([each[1] for each in both], axis=1)


def _about_hips(joints: Float) -> Float:
    """Subtract the middle of the hips from joints [T, J, 3] in the order of `CENTRES`."""
    hips = joints[:, [list(CENTRES).index(f"{side}_hip") for side in ("left", "right")]]
    return np.asarray(joints - hips.mean(axis=1, keepdims=True))


def _surface_errors(
    body: MovingBody, shape: Float, centre: Float, rotation: Float, spread: Float, turning: Float
) -> tuple[float, float, float]:
    """Return MPVPE, its root-relative form (mm), and the NEES of vertices."""
    model = body_model()
    chosen = np.random.default_rng(0).choice(len(model.weights), _VERTICES, replace=False)
    bone = model.weights[chosen].argmax(axis=1)
    found = []
    for k in np.unique(np.linspace(0, len(body.t_ns) - 1, _TIMES).astype(np.int64)).tolist():
        if np.isnan(centre[k]).any():
            continue
        own = model.surface(body.shape, body.centre[k, 0], body.rotation[k])
        error = own - model.surface(shape, centre[k, 0], rotation[k])
        arm = cross_matrix(own[chosen] - body.centre[k, bone])
        covariance = spread[k, bone] + arm @ turning[k, bone] @ np.swapaxes(arm, -1, -2)
        white = np.linalg.solve(covariance, error[chosen][..., None])[..., 0]
        relative = error - (body.centre[k, 0] - centre[k, 0])
        lengths = [np.linalg.norm(each, axis=1).mean() for each in (error, relative)]
        found.append([*lengths, np.sum(error[chosen] * white, axis=1).mean()])
    whole, relative_mm, nees = np.mean(found, axis=0).tolist()
    return 1e3 * whole, 1e3 * relative_mm, nees
