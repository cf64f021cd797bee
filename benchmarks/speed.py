"""Speed of all that takes time, beside peers: `python -m benchmarks.speed [--only NAME ...] [--write]`.

Times are processor times of one thread, the best of several runs with compiled code warm. Peers run too.

    triangulation  22,500 frames of 17 joints in five cameras, 2 px; also 5 % gross errors and missing views
    association    five people among each other in five cameras, 450 frames
    refinement     75 s of five cameras, 17 joints, 30 Hz
    logs           a recorder's log of 200 MB: rosbags iterates over raw messages, we ingest
    planner        a central plan of the seed's size and of the largest; 75 s of flight, and two arms compared
                   with 1 and 100 trials; a map of 25 M voxels
    sample         the commands on the sample flight, with detection in all pictures
"""

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pycolmap
from rosbags.highlevel import AnyReader

from benchmarks.flights import SAMPLE, scenario_of
from benchmarks.flights import walker as person
from benchmarks.planner import simulated
from benchmarks.results import markdown_table, parser_of, show
from benchmarks.scale import cost_of
from pipelines.geometry.arrays import Float
from pipelines.geometry.noise import pose_errors
from pipelines.geometry.triangulation import Views, estimate_noise, triangulate
from pipelines.ingest import ingest
from pipelines.planning.arms import ADAPTIVE, FIXED, JOINT
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import distance_field
from pipelines.planning.forecast import Forecast
from pipelines.planning.formation import formation_slots
from pipelines.planning.replay import Start, replay
from pipelines.planning.scene import ReplanSettings
from pipelines.reconstruction.refinement.refine import refine
from pipelines.replan import replan
from pipelines.session.records import Occupancy
from tests.geometry.rings import FOCAL, ring, with_outliers, with_pixel_noise
from tests.keypoints.test_association import film, straight
from tests.planning.worlds import mound, walker
from tests.reconstruction.formations import BONES, formation, mean_mm
from tests.synthetic import recorder_logs

Row = tuple[str, str, str]
"""Timed operation: its name, its speed, its error or its peer."""


def best_s(run: Callable[[], object], repeats: int = 5) -> float:
    """Measure the shortest processor time (s) of several runs of one thread."""
    times = []
    for _ in range(repeats):
        started = time.process_time()
        run()
        times.append(time.process_time() - started)
    return min(times)


# --- triangulation ---------------------------------------------------------------------------------------


def triangulation() -> Iterator[Row]:
    """Time triangulation, and pycolmap on fewer joint-frames."""
    rng = np.random.default_rng(1)
    truth, exact = ring(22_500, 5)
    few_truth, few_exact = ring(450, 5)
    noisy, few = (with_pixel_noise(views, rng) for views in (exact, few_exact))
    bad, few_bad = (with_outliers(views, rng, uniform=False)[0] for views in (noisy, few))
    for name, views, own in (("2 px", noisy, few), ("outliers", bad, few_bad)):
        seen = replace(views, pixel_sigma=estimate_noise(views))
        for method in ("midpoint", "robust"):
            points = triangulate(seen, method=method).points
            took_s = best_s(lambda: triangulate(seen, method=method))  # noqa: B023
            yield _points_row(f"triangulation, {method}, {name}", took_s, points, truth)
        took_s, found = best_s(partial(pycolmap_ransac, own), 1), pycolmap_ransac(own)
        yield _points_row(f"the same by pycolmap LO-RANSAC, {name}", took_s, found, few_truth)


def _points_row(what: str, took_s: float, points: Float, truth: Float) -> Row:
    error_mm = 1e3 * float(np.nanmean(np.linalg.norm(points - truth, axis=1)))
    return what, f"{len(truth) / took_s / 1e6:.2f} M joint-frames/s", f"{error_mm:.2f} mm"


def pycolmap_ransac(views: Views) -> Float:
    """Triangulate with pycolmap's robust method and a gate of 15 px, one call per joint-frame."""
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1920, height=1080, params=[FOCAL, 960, 540])
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = 15.0
    turned = np.swapaxes(views.rotation, -1, -2)
    projections = np.concatenate([turned, -turned @ views.position[..., None]], axis=-1)
    poses = [[pycolmap.Rigid3d(p) for p in row] for row in projections]
    pixels = views.rays * FOCAL + [960, 540]
    points = np.full((len(pixels), 3), np.nan)
    for n, seen in enumerate(np.isfinite(pixels.sum(axis=2))):
        row = [pose for pose, there in zip(poses[views.pose_index[n]], seen, strict=True) if there]
        if len(row) > 1:
            result = pycolmap.estimate_triangulation(pixels[n, seen], row, [camera] * len(row), options)
            if result is not None:
                points[n] = result["xyz"]
    return points


# --- several people --------------------------------------------------------------------------------------


def association() -> Iterator[Row]:
    """Time the association of five people."""
    paths = [straight((3 * np.cos(k), 3 * np.sin(k)), (-0.2 * np.cos(k), -0.1)) for k in range(5)]
    scene = film(paths, seconds=30.0, cameras=5)
    took_ms = 1e3 * best_s(lambda: scene.associate(5), 3) / len(scene.time_s)  # the first compiles
    said = "RapidPoseTriangulation claims 1 ms, triangulation included"
    yield "association, five people in five cameras", f"{took_ms:.2f} ms/frame", said


# --- refinement ------------------------------------------------------------------------------------------


def refinement() -> Iterator[Row]:
    """Time `refined` on a walk of 75 s."""
    for name, share in (("2 px", 0.0), ("outliers", 0.05)):
        flight = formation(2250, 5, (), 0, bad_share=share)
        views = flight.sightings
        prior, clocks = [pose_errors(())] * len(views), np.zeros(len(views))
        run = partial(refine, flight.t_s, views, flight.start, BONES, prior, clocks)
        took_s, result = best_s(run, 2), run()  # the first compiles
        errors = [mean_mm(each, flight.truth) for each in (result.position, flight.start)]
        speed = f"{2250 * 17 / took_s / 1e3:.1f} k joint-frames/s"
        yield f"refinement, {name}", speed, f"{errors[0]:.2f} mm; triangulated {errors[1]:.2f} mm"


# --- logs ------------------------------------------------------------------------------------------------


def with_rosbags(log: Path) -> int:
    """Read the bytes of every message with rosbags; return the count of messages with content."""
    with AnyReader([log]) as reader:
        return sum(len(data) > 0 for _, _, data in reader.messages())


def logs() -> Iterator[Row]:
    """Time the ingest of logs, and rosbags' raw iteration, each in a process of its own."""
    for container in recorder_logs.CONTAINERS:
        with tempfile.TemporaryDirectory(prefix="speed-") as folder:
            small, large = (
                recorder_logs.write(Path(folder) / str(mb), container, recorder_logs.RECORDER, 60_000, mb)
                for mb in (1, 200)
            )
            timed = partial(recorder_logs.in_a_process, recorder_logs.timed)
            raw, own = (
                min((timed(run, small, large) for _ in range(3)), key=lambda found: float(found["seconds"]))
                for run in (with_rosbags, recorder_logs.ingested)
            )
        said = f"rosbags, raw: {raw['seconds']:.2f} s"
        yield f"ingest of {container}, 200 MB", f"{own['seconds']:.2f} s, {own['peak_mb']:.0f} MB", said


# --- planner ---------------------------------------------------------------------------------------------


def planner() -> Iterator[Row]:
    """Time central plans, closed-loop flights, and the distance field of a large map."""
    field = mound(resolution_m=0.2)
    sizes_of = {ADAPTIVE: ((5.0, 2), (10.0, 2), (20.0, 5)), JOINT: ((10.0, 2),)}  # horizon in s, drones
    for arm, sizes in sizes_of.items():
        for horizon_s, drones in sizes:
            config = replace(PlannerConfig(), horizon_s=horizon_s)
            knots = round(horizon_s / config.tuning.knot_s)
            plans = arm.start(config, drones=drones, yaw_rad=0.7)
            slots = formation_slots(
                np.array([0.7]), drones, tilt_rad=config.tilt_rad, range_m=config.radius_m
            )
            took_ms = []
            for k in range(201):
                walked = 0.2 * k + 1.2 * config.tuning.knot_s * np.arange(1, knots + 1)
                actor: Float = np.stack([walked, 0 * walked, 0 * walked + 1], axis=1)
                started = time.thread_time()
                plans.plan(1.0 + k, slots[0], Forecast(actor), field)  # each is due
                took_ms.append(1e3 * (time.thread_time() - started))
            what = f"plan of {arm.name}, {horizon_s:g} s ahead, {drones} drones"
            yield what, f"{np.median(took_ms[1:]):.2f} ms", "Ho et al. 2021: 1.3 ms" if drones == 5 else ""
    for arm in (FIXED, ADAPTIVE, JOINT):
        fly = partial(replay, arm, *walker(75.0), [field], Start(2, np.pi / 4), config=PlannerConfig())
        yield f"75 s of flight by {arm.name}", f"{best_s(fly, 2):.2f} s", ""  # the first compiles
    plan = scenario_of({"one": person(0, -13.5, 0, {"walk": {"distance_m": 85, "turn_deg": 360}})}, seed=1)
    plan["world"] |= {"mounds": [{"centre": [0, 0], "sigma_m": [4, 4], "height_m": 5}]}
    plan |= {"duration_s": 75, "drones": plan["drones"] | {"count": 2}}
    with simulated(plan) as manifest:
        session = ingest(manifest, manifest.parent / "one.session").folder
        for trials in (1, 100):  # the first run compiles
            stated = ReplanSettings(arms=("fixed", "adaptive"), trials=trials)
            took_s = best_s(partial(replan, session, stated, force=True), 2)
            yield f"comparison of two arms, 75 s, {trials} trials", f"{took_s:.1f} s", ""
    with get_context("spawn").Pool(1) as pool:
        took_s, peak_gb = pool.apply(_field_of_hills)
    yield "distance field of 25 M voxels", f"{took_s:.1f} s, {peak_gb:.2f} GB", ""


def _field_of_hills() -> tuple[float, float]:
    """Return the processor time (s) of the field, and the peak memory of the process (GB)."""
    assert mound().sight  # loads what is compiled
    x, y, z = np.ogrid[:500, :500, :100]
    hills = z < 20 + 12 * np.sin(x / 40) * np.cos(y / 55)
    occupancy = Occupancy(np.where(hills, np.float32(0.9), np.float32(0.1)), np.zeros(3), 0.2)
    started = time.process_time()
    assert len(distance_field(occupancy).sight)  # lines of sight are looked up beside distances
    return time.process_time() - started, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


# --- commands -------------------------------------------------------------------------------


def sample() -> Iterator[Row]:
    """Time the commands on the sample flight, each in a process of its own."""
    with tempfile.TemporaryDirectory(prefix="speed-") as folder:
        session = f"{folder}/sample.session"
        for command, *options in (
            ("ingest", str(SAMPLE / "flight.yaml"), "-o", session),
            ("reconstruct", session, "--workers", "1"),
            ("reconstruct", session, "--workers", "1", "--smooth", "butterworth"),
            *((stage, session) for stage in ("replan-compare", "report")),
        ):
            kept = ", smoothed, with keypoints as they are" * ("--smooth" in options)
            peak_mb, took_s = cost_of(command, *options)
            yield f"`mocap {command}` of the sample{kept}", f"{took_s:.1f} s, {peak_mb:.0f} MB", ""


SUBJECTS: dict[str, Callable[[], Iterator[Row]]] = {
    "triangulation": triangulation,
    "association": association,
    "refinement": refinement,
    "logs": logs,
    "planner": planner,
    "sample": sample,
}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="+", choices=SUBJECTS, default=list(SUBJECTS))
    options = parser.parse_args()
    rows = list[list[str]]()
    for row in chain.from_iterable(SUBJECTS[name]() for name in options.only):
        print(json.dumps(row), file=sys.stderr, flush=True)
        rows.append(list(row))
    lines = markdown_table(["what", "speed", "result, or compared with"], rows)
    load = f"Load of the machine: {os.getloadavg()[0]:.0f} on {os.cpu_count()} cores."
    show("speed", [*lines, "", load], write=options.write)


if __name__ == "__main__":
    main()
