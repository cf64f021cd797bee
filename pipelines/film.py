"""Stage `film`: rendered films of a comparison's arms, with a real detector on the pictures.

The scenario's world is built again, and what every camera would have seen is rendered, detected,
reconstructed as `auto` does it in several draws of the poses' noise, and measured against the truth, which
also says whom a detection shows. Where the films and the modelled measurement disagree, the films decide.
The model also measures with the film's keypoints, which tells its detector's part in that from the rest.
`replan` is only read.
"""

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipelines.detect import TIME_BETWEEN_STILLS_S
from pipelines.formats.skeletons.bvh import read_motion
from pipelines.formats.videos.video_writing import write_h264
from pipelines.geometry.arrays import Bool, Float, Int64, Picture
from pipelines.geometry.cameras import project
from pipelines.geometry.noise import NoiseModel, pose_errors
from pipelines.geometry.poses import quaternion_from_matrix
from pipelines.geometry.triangulation import triangulate
from pipelines.keypoints.corrections import (
    Calibration,
    measured_for,
    read_calibration,
    undo_swaps_of_tracks,
)
from pipelines.keypoints.search import ACTOR_SIGMA_M, UNKNOWN_SIGMA_RAD, project_actor
from pipelines.keypoints.tracking import FollowedPeople
from pipelines.planning.comparison import common_frames, figures_of, filmed_verdict, judge, verdict
from pipelines.planning.config import PlannerConfig
from pipelines.planning.distance_field import DistanceField, distance_field, in_turn
from pipelines.planning.formation import TILT, slot_of
from pipelines.planning.replay import CameraPaths, MeasuredJoints, joined, known_from, measure, poses_from
from pipelines.planning.scene import LoggedFlight, load_flight
from pipelines.reconstruct import agreeing_sides, find_people
from pipelines.reconstruction.background import refine_cameras
from pipelines.reconstruction.background_tracks import (
    Followed,
    Follower,
    Stills,
    Tracks,
    off_people,
    people_boxes,
)
from pipelines.reconstruction.ground import bind_positions
from pipelines.reconstruction.observations import Camera, Observations, observe
from pipelines.reconstruction.refining import refined_points
from pipelines.reconstruction.solving import views_as_stated
from pipelines.reconstruction.view_errors import without_view_errors
from pipelines.session.description import Description, Interpolation, read_description
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps
from pipelines.session.people import LoggedActor, logged_people
from pipelines.session.progress import Progress, Silent
from pipelines.session.records import Detections, JointMotion, Trajectory
from pipelines.session.registries import Detector, find_detector, hashes_of_models
from pipelines.session.stages import Stage, StageRecord, locked
from pipelines.session.storage import SIMULATION_MARK, hash_of, jsonable, read_json, sha256_of, write_json
from pipelines.session.tables import REPLAN, TRUTH, motion_table, read_table, write_table
from pipelines.simulation.detector_errors import detect_by_model, filmed_errors, see
from pipelines.simulation.flight import Set, build_set
from pipelines.simulation.renderer import Renderer
from pipelines.simulation.scenario import Scenario, read_scenario
from pipelines.simulation.walks import (
    MIN_CONFIDENCE,
    CameraFormation,
    SimulatedKeypoints,
    Walk,
    measure_arm,
    views_of,
)

FILM = Stage("film", revision=19)

# The session's truth is interpolated, which moves the hips of a runner by less than this.
MAX_HIPS_OFF_M = 0.05
# Student's factor for ten draws is 2.3, and hardly less for more. Each takes as long as a picture or two.
DRAWS = 10
# A detection whose joints lie farther than this from a person's, in the median, shows somebody else.
MAX_MEDIAN_OFF_M = 0.25

_HIPS = ("left_hip", "right_hip")


@dataclass(frozen=True)
class FilmSettings:
    """FilmSettings that determine a film: rate, span and detector."""

    rate_hz: float = 5.0
    start_s: float | None = None  # since the replay's first moment, which is the default
    end_s: float | None = None  # the default is the replay's last moment
    detector: str = "blazepose"


def film_settings(stated: str) -> tuple[FilmSettings, Path | None]:
    """Read `HZ[,KEY=VALUE...]`, and the scenario; ValueError: a wrong key or number."""
    rate_hz, *parts = re.split(",(?=(?:start|end|detector|scenario)=)", stated)
    values = {"rate_hz": rate_hz} | dict(part.split("=", 1) for part in parts)
    numbers = {}
    for key, low, high in (("rate_hz", 0.1, 30.0), ("start", 0.0, 1e6), ("end", 0.0, 1e6)):
        if key in values:
            try:
                numbers[key] = float(values[key])
            except ValueError:
                numbers[key] = np.nan
            if not low <= numbers[key] <= high:
                problem = f"{key} {values[key]!r} is no number from {low:g} to {high:g}"
                raise ValueError(f"{problem}; the keys are start=, end=, detector= and scenario=")
    settings = FilmSettings(
        numbers["rate_hz"], numbers.get("start"), numbers.get("end"), values.get("detector", "blazepose")
    )
    return settings, Path(values["scenario"]) if "scenario" in values else None


@dataclass(frozen=True)
class FilmResult:
    """Result of filming."""

    folder: Path
    record: StageRecord
    metrics: dict[str, Any]
    skipped: bool  # True if nothing had changed


def film(
    folder: Path,
    settings: FilmSettings | None = None,
    *,
    scenario: Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> FilmResult:
    """Film every arm of a session's comparison; the `scenario` of the flight is searched beside its pictures.

    DataError: nothing was compared yet, a table of the session was changed, the flight was not simulated, its
    scenario is missing or another flight's, the span holds fewer than two pictures, or the detector's files
    are missing. BusyError: another process writes the session.
    """
    settings = settings or FilmSettings()
    progress = progress or Silent()
    with locked(folder) as session:
        session.intact_record("ingest")
        compared = session.intact_record("replan")
        if compared is None:
            raise DataError(folder, "holds no comparison to film", "run `mocap replan-compare` first")
        description = read_description(folder)
        if not description.simulated:
            raise DataError(folder, "was really flown: only simulated flights can be filmed again")
        path = scenario or _scenario_of(folder, description)
        detector = find_detector(settings.detector)
        detector.load(threads=1)  # raises an error at once if a file is missing
        confidences = measured_for(settings.detector)
        calibration = read_calibration(confidences) if confidences else None
        plan = read_scenario(path)
        inputs = {"replan": compared.key, "scenario": hash_of(plan.identity())}
        if hashes := {name: sha256_of(file) for name, (file, _) in plan.motion_files(path.parent).items()}:
            inputs["bvh"] = hash_of(hashes) if plan.actors else hashes["actor"]
        inputs |= {f"model {name}": digest for name, digest in hashes_of_models(detector).items()}
        run = session.begin(FILM, settings=asdict(settings), inputs=inputs, force=force)
        if run.finished:
            return FilmResult(folder, run.record, read_json(folder / "film" / "metrics.json"), skipped=True)

        flight = load_flight(
            folder,
            description,
            session.intact_record("reconstruct"),
            pose_noise=compared.settings["pose_noise"],
        )
        setting = _set(plan, path, flight)
        logged = logged_people(folder, description)
        replanned = read_json(folder / "replan" / "metrics.json")
        arms = {arm: _arm(folder, logged, flight, plan, setting, arm, settings) for arm in replanned["arms"]}
        progress.start("Filming", sum(arm.seen_by.position.shape[0] * len(arm.t_ns) for arm in arms.values()))
        renderer = Renderer(
            setting.world.surfaces(),
            flight.cameras[0].intrinsics,
            sun=np.array(plan.world.sun),
            seed=plan.seed,
        )
        metrics: dict[str, dict[str, Any]] = {}
        errors: dict[str, MeasuredJoints] = {}
        modelled: dict[str, MeasuredJoints] = {}
        unknown = description.map.unknown if description.map else "free"
        maps = load_maps(folder) if description.map else []
        fields = [distance_field(one, unknown=unknown) for one in sorted(maps, key=lambda one: one.from_ns)]
        for name, arm in arms.items():
            parts = [
                run.chunk(f"{name}-{camera}", partial(_film_camera, arm, k, renderer, detector, progress))
                for k, camera in enumerate(arm.names)
            ]
            sightings = _read_sightings(parts)
            seed = compared.settings["seed"]  # one draw of the comparison's pose noise
            found = _detections(arm, parts, calibration)
            cameras = [
                [
                    replace(camera, blazepose=confidences is not None)
                    for camera in _corrected(arm, sightings, found, parts, seed=seed, draw=draw)
                ]
                for draw in range(DRAWS)
            ]
            observed = [_observed(arm, own) for own in cameras]
            measured = [_measured(arm, p, seen, cameras, observed) for p, seen in enumerate(sightings)]
            points = np.stack([own for own, _, _ in measured], axis=1)
            errors[name] = joined([of_draws for _, of_draws, _ in measured])
            joints, usual = arm.people[0].person.joints, filmed_errors(settings.detector)
            by_model = partial(detect_by_model, joints=joints, errors=usual, rate_hz=settings.rate_hz)
            modelled[name] = _modelled(arm, fields, [by_model] * len(arm.people), seed=seed)
            as_filmed = [
                partial(_detect_as_filmed, arm, p, cameras[0], observed[0]) for p in range(len(arm.people))
            ]
            by_keypoints = _modelled(arm, fields, as_filmed, seed=seed).error_m
            each = [own for _, _, own in measured]
            by_person = dict(zip((who.name for who in setting.people), each, strict=True))
            metrics[name] = each[0] if len(each) == 1 else _means(each) | {"by_person": by_person}
            out = run.folder / name
            out.mkdir()
            motion = JointMotion(arm.t_ns, joints, points)
            write_table(out / "skeleton.parquet", motion_table(motion), TRUTH)
            for camera, part in zip(arm.names, parts, strict=True):
                shutil.copyfile(part / "pictures.mp4", out / f"{camera}.mp4")
            filmed_m, modelled_m = errors[name].error_m, modelled[name].error_m
            np.savez(out / "errors.npz", filmed=filmed_m, modelled=modelled_m, by_keypoints=by_keypoints)
        t_ns = next(iter(arms.values())).t_ns
        shared = common_frames({name: own.error_m for name, own in errors.items()})
        for name, own in errors.items():
            metrics[name]["reconstruction_error"] = figures_of(own, None, shared, t_ns)
        breaking = {name for name, arm in replanned["arms"].items() if any(arm["limit_violations"].values())}
        best, expected = judge(errors, breaking, t_ns), judge(modelled, breaking)
        figures = jsonable(
            {
                "schema": 1,
                "simulated": True,
                "detector": detector.title,
                "rate_hz": settings.rate_hz,
                "draws": DRAWS,
                "arms": metrics,
                "best": best,
                "verdict": filmed_verdict(best, replanned["best"], list(metrics)),
                "modelled": expected,
                "modelled_verdict": verdict(expected, list(metrics)),
            }
        )
        write_json(run.folder / "metrics.json", figures)
        counts = {name: len(arm.t_ns) for name, arm in arms.items()}
        record = run.publish(counts={"moments": counts, "detector": detector.title})
    return FilmResult(folder, record, figures, skipped=False)


@dataclass(frozen=True)
class _Arm:
    """The N cameras of an arm at the T moments of its pictures, and the people that they film."""

    names: tuple[str, ...]
    people: list[Walk]
    tilt_rad: Float | None  # [N, T] above whom each camera films; None for one person
    seen_by: CameraFormation
    logged: Sequence[LoggedActor]
    known: Bool  # [N, T] False where a log has a gap, or a battery is empty: nothing is detected there
    noise: tuple[NoiseModel, ...]

    @property
    def t_ns(self) -> Int64:
        """Moments [T] of the pictures."""
        return self.people[0].t_ns


def _scenario_of(folder: Path, description: Description) -> Path:
    """Find the scenario that `mocap simulate` left beside the flight."""
    beside = [folder.parent, folder.with_suffix("")]
    for entry in description.cameras.values():
        if entry.media is not None:
            beside += [(folder / path).parent for path in entry.media.paths]
    for place in beside:
        if (place / SIMULATION_MARK).is_file() and (place / "scenario.yaml").is_file():
            return place / "scenario.yaml"
    problem = "has no scenario.yaml of a simulated flight beside it"
    raise DataError(folder, problem, "name it: --render HZ,scenario=SCENARIO.yaml", code="no-such-file")


def _set(plan: Scenario, path: Path, flight: LoggedFlight) -> Set:
    """World and actor of a scenario, if it is this flight's."""
    bvh = {
        name: read_motion(file, unit=motion.unit, axes=motion.axes)
        for name, (file, motion) in plan.motion_files(path.parent).items()
    }
    setting = build_set(plan, bvh=bvh)
    if flight.hips is None:
        raise DataError(path, "cannot be recognised as this flight's", "ingest the flight with its truth")
    followed = setting.people[0]
    joints = followed.person.keypoints(followed.moving((flight.hips.t_ns - plan.start_ns) / 1e9))
    hips = joints[:, [followed.person.joints.index(name) for name in _HIPS]].mean(axis=1)
    off_m = float(np.nanmax(np.linalg.norm(hips - flight.hips.position[:, 0, 0], axis=-1)))
    if not off_m <= MAX_HIPS_OFF_M:
        problem = f"is not this flight's: its actor is {off_m:.2f} m from the session's truth"
        raise DataError(path, problem, "name the flight's own: --render HZ,scenario=SCENARIO.yaml")
    return setting


def _arm(
    folder: Path,
    logged: Sequence[LoggedActor],
    flight: LoggedFlight,
    plan: Scenario,
    setting: Set,
    name: str,
    settings: FilmSettings,
) -> _Arm:
    table = read_table(folder / "replan" / name / "trajectories.parquet", REPLAN)
    cameras, position, quaternion = poses_from(table)
    t_ns = table["t_ns"].to_numpy(np.int64)[:: len(cameras)]
    rows = _rows(t_ns, settings)
    if len(rows) < 2:
        problem = f"{len(rows)} pictures lie in the span that is to be filmed"
        raise DataError(folder, problem, "widen it", code="no-overlap")

    moments = t_ns[rows]
    people = []
    for performer in setting.people:
        motion, person = performer.moving((moments - plan.start_ns) / 1e9), performer.person
        joints = person.keypoints(motion)
        people.append(Walk(moments, person, performer.look.body.height_m, motion, joints, motion.root))
    lens = replace(flight.cameras[0].intrinsics, readout_s=0.0)  # each picture is of one moment
    seen_by = CameraFormation(position.take(rows, axis=1), quaternion.take(rows, axis=1), lens)
    tilt = table["tilt_rad"].to_numpy(np.float64).reshape(-1, len(cameras)).T
    return _Arm(
        cameras,
        people,
        tilt.take(rows, axis=1) if len(people) > 1 else None,
        seen_by,
        logged,
        known_from(table, len(cameras))[:, rows],
        flight.cameras[0].noise,
    )


def _rows(t_ns: Int64, settings: FilmSettings) -> Int64:
    """Find the rows of the moments [T] nearest to evenly spaced ones at the wanted rate, each once."""
    since_s = (t_ns - t_ns[0]) / 1e9
    first = settings.start_s or 0.0
    behind = since_s[-1] + 1e-9 if settings.end_s is None else settings.end_s
    wanted = np.arange(first, min(behind, since_s[-1] + 1e-9), 1 / settings.rate_hz)
    return np.unique(
        np.clip(np.rint(np.interp(wanted, since_s, np.arange(len(t_ns)))), 0, None).astype(np.int64)
    )


def _film_camera(
    arm: _Arm, camera: int, renderer: Renderer, detector: Detector, progress: Progress, folder: Path
) -> None:
    """Write one camera's pictures, the points of the background in them, some of them in grey, and keypoints.

    These are xy [T, P, J, 2] px and confidence [T, P, J].
    """
    lens = arm.seen_by.lens
    alone = len(arm.people) == 1
    follower = FollowedPeople(detector.load(threads=1), arm.people[0].person.joints, only_one=alone)
    found: list[tuple[Float, Float]] = []
    joints = len(arm.people[0].person.joints)
    nobody = np.empty((0, joints, 2)), np.empty((0, joints))
    background, stills = Follower(), _stills(arm.t_ns)
    hips_of_all = [person.hips_at(arm.t_ns) for person in arm.logged]
    greys: list[Picture] = []

    def pictures() -> Iterator[Picture]:
        for k in range(len(arm.t_ns)):
            pose = arm.seen_by.position[camera, k], arm.seen_by.quaternion_xyzw[camera, k]
            bodies = [of.person.surface(of.motion.root[k], of.motion.rotation[k]) for of in arm.people]
            picture = renderer.picture(*pose, bodies, k)
            grey = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
            background.step(k, grey)
            greys.extend([grey] if k in stills else [])
            hints = [
                project_actor(hips[k], pose, lens, sigma_m=ACTOR_SIGMA_M, sigma_rad=UNKNOWN_SIGMA_RAD)
                for hips in hips_of_all
            ]
            seen = follower.step(picture, hints=hints) if arm.known[camera, k] else nobody
            found.append(_whose(arm, pose, k, *seen))
            yield picture
            progress.advance()

    write_h264(
        folder / "pictures.mp4", pictures(), arm.t_ns - arm.t_ns[0], width=lens.width, height=lens.height
    )
    xy, confidence = (np.stack(part) for part in zip(*found, strict=True))
    np.savez(folder / "keypoints.npz", xy=xy, confidence=confidence)
    np.savez_compressed(folder / "background.npz", **asdict(background.tracks()), greys=np.stack(greys))


def _stills(t_ns: Int64) -> Int64:
    """Choose the pictures, of times [T], in which the ground is compared."""
    count = round((t_ns[-1] - t_ns[0]) / 1e9 / TIME_BETWEEN_STILLS_S) + 1
    return np.unique(np.linspace(0, len(t_ns) - 1, min(count, len(t_ns))).round().astype(np.int64))


def _whose(
    arm: _Arm, pose: tuple[Float, Float], moment: int, xy: Float, confidence: Float
) -> tuple[Float, Float]:
    """Choose the detection of each person: xy [P, J, 2] px, confidence [P, J]."""
    found = np.full((len(arm.people), *xy.shape[1:]), np.nan)
    sure = np.zeros(found.shape[:2])
    if len(arm.people) == 1:
        found[: len(xy)], sure[: len(xy)] = xy[:1], confidence[:1]
        return found, sure
    off_m = np.full((len(arm.people), len(xy)), np.inf)
    for p, of in enumerate(arm.people):
        off_px = np.linalg.norm(xy - see(of.joints[moment], *pose, arm.seen_by.lens), axis=-1)
        off_px[np.isnan(off_px)] = np.inf
        range_m = np.linalg.norm(of.motion.root[moment] - pose[0])
        off_m[p] = np.median(off_px, axis=-1) * range_m / arm.seen_by.lens.fx
    while off_m.min(initial=np.inf) < MAX_MEDIAN_OFF_M:
        whose, which = np.unravel_index(off_m.argmin(), off_m.shape)
        found[whose], sure[whose] = xy[which], confidence[which]
        off_m[whose] = off_m[:, which] = np.inf
    return found, sure


def _read_sightings(parts: Sequence[Path]) -> list[SimulatedKeypoints]:
    xy, confidence = [], []
    for part in parts:
        with np.load(part / "keypoints.npz") as stored:
            xy.append(stored["xy"])
            confidence.append(stored["confidence"])
    found, sure = np.stack(xy), np.stack(confidence)
    return [SimulatedKeypoints(found[:, :, p], sure[:, :, p]) for p in range(found.shape[2])]


def _detections(arm: _Arm, parts: Sequence[Path], calibration: Calibration | None) -> list[Detections]:
    """Return each camera's usable keypoints, with probabilities and left and right as `reconstruct` has."""
    joints, found = tuple(arm.people[0].person.joints), []
    for part in parts:
        with np.load(part / "keypoints.npz") as stored:
            xy, raw = stored["xy"], stored["confidence"]
        sure = raw if calibration is None else calibration.probability(raw, joints)
        sure = np.where(raw >= MIN_CONFIDENCE, sure, 0.0)
        frame, person = np.nonzero(sure.any(axis=2))
        places = np.where(sure[..., None] > 0, xy, np.nan)[frame, person]
        own = Detections(joints, frame, person, places, sure[frame, person], np.arange(len(arm.t_ns)))
        found.append(undo_swaps_of_tracks(own, arm.t_ns)[0])
    return found


def _corrected(
    arm: _Arm,
    sightings: Sequence[SimulatedKeypoints],
    detections: Sequence[Detections],
    parts: Sequence[Path],
    *,
    seed: int,
    draw: int,
) -> list[Camera]:
    """Disturb an arm's poses, and correct them by backgrounds and ground, as `auto` does."""
    t_ns, rows = arm.t_ns, np.arange(len(arm.t_ns))
    logged = views_of(arm.people[0], arm.seen_by, sightings[0], arm.noise, seed=seed, trial=draw)
    cameras: list[Camera] = []
    followed: dict[str, Followed | str] = {}
    stills: dict[str, Stills] = {}
    for k, (name, part) in enumerate(zip(arm.names, parts, strict=True)):
        attitude = quaternion_from_matrix(logged.rotation[:, k])
        camera = Camera(
            name,
            arm.seen_by.lens,
            rows,
            t_ns,
            np.ones(len(rows), dtype=np.bool_),
            Trajectory(t_ns, logged.position[:, k], attitude),
            static=False,
            sigma=logged.pose_sigma[:, k],
            detections=detections[k],
        )
        with np.load(part / "background.npz") as stored:
            tracks = Tracks(stored["picture"], stored["point"], stored["xy"])
            greys: Picture = stored["greys"]
        tracks = off_people(tracks, people_boxes(camera))
        cameras.append(camera)
        followed[name] = Followed(rows, rows[:1], [partial(replace, tracks)])
        stills[name] = Stills(_stills(t_ns), greys.__getitem__)
    errors, between = pose_errors(arm.noise), _between(t_ns)
    if arm.noise:
        cameras, _, _ = refine_cameras(cameras, followed, [errors] * len(cameras), between=between)
        cameras = bind_positions(cameras, followed, stills, between=between).cameras
    return [replace(of, errors=of.errors or errors) for of in cameras]


def _between(t_ns: Int64) -> Interpolation:
    return Interpolation(max_gap_s=float(np.ptp(t_ns)) / 1e9, max_extrapolation_s=0.0)


def _observed(arm: _Arm, cameras: list[Camera]) -> Observations:
    """Observe the P people of an arm in the detections that `auto` takes for them.

    Who is who of several is known; an only person is chosen by their log and by the rays of all cameras, so
    that a tree that a detector takes for a person is nobody.
    """
    between = _between(arm.t_ns)
    found, association, sigma = find_people(cameras, between, arm.logged)
    choice = association.choice
    if len(arm.people) > 1:
        choice = np.full((*found.frame.shape, len(arm.people)), -1)
        for c, seen in enumerate(camera.detections for camera in cameras):
            rank = np.arange(len(seen.frame)) - np.searchsorted(seen.frame, seen.frame)
            choice[seen.frame, c, seen.person] = rank
    sides, _ = agreeing_sides(observe(cameras, found, choice, arm.t_ns, between), sigma)
    observed = observe(cameras, found, choice, arm.t_ns, between, sides)
    points = triangulate(views_as_stated(cameras, observed), method="robust")
    cameras = without_view_errors(cameras, found, choice, observed, sides, points, None)
    return observe(cameras, found, choice, arm.t_ns, between, sides)


def _measured(
    arm: _Arm,
    person: int,
    sightings: SimulatedKeypoints,
    cameras: Sequence[Sequence[Camera]],
    observed: Sequence[Observations],
) -> tuple[Float, MeasuredJoints, dict[str, Any]]:
    """Reconstruct a person [T, J, 3] in cameras [K, N] of K draws, with errors, and measure the arm."""
    of, elapsed_s = arm.people[person], (arm.t_ns - arm.t_ns[0]) / 1e9

    def reconstructed(draw: int) -> tuple[Float, str | None]:
        own, seen = cameras[draw], observed[draw]
        alone = {name: getattr(seen, name)[:, person : person + 1] for name in ("rays", "confidence")}
        views = views_as_stated(own, replace(seen, **alone))
        prior = [errors for camera in own if (errors := camera.errors) is not None]
        corrected = any(camera.modes is not None for camera in own)
        _, found, doubt = refined_points(views, elapsed_s, seen.joints, prior, measured=corrected)
        return found.reshape(of.joints.shape), doubt

    points, doubt = reconstructed(0)
    each = [points, *(reconstructed(draw)[0] for draw in range(1, DRAWS))]
    off_m = np.linalg.norm(np.stack(each) - of.joints, axis=-1).astype(np.float32)
    slots = slot_of(arm.seen_by.position - of.motion.root)
    figures = measure_arm(
        of,
        arm.seen_by,
        sightings,
        points,
        tilt_deg=np.degrees(slots[..., TILT] if arm.tilt_rad is None else arm.tilt_rad),
        range_m=slots[..., 2],
    )
    known = int(np.isfinite(of.joints[..., 0]).sum())
    return points, MeasuredJoints(off_m, known), figures | {"fallback": doubt}


def _detect_as_filmed(
    arm: _Arm,
    person: int,
    cameras: Sequence[Camera],
    observed: Observations,
    _pixels: Float,
    _free: Bool,
    camera: Float,
    *_: object,
) -> tuple[Float, Float]:
    """Return what `auto` used of the film of the camera at `camera` [T, 3] m (`replay.Detect`)."""
    which = [np.array_equal(path, camera) for path in arm.seen_by.position].index(True)
    rays = observed.rays[:, person, :, which]
    along = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
    return project(along, cameras[which].intrinsics), observed.confidence[:, person, :, which]


def _modelled(
    arm: _Arm,
    fields: Sequence[DistanceField],
    detect: Sequence[Callable[..., tuple[Float, Float]]],
    *,
    seed: int,
) -> MeasuredJoints:
    """Measure an arm as `replan` models it, over the film's pictures and with the film's errors of poses."""
    count, middles = len(arm.names), [of.motion.root for of in arm.people]
    found = []
    for p, of in enumerate(arm.people):
        others = middles[:p] + middles[p + 1 :]
        paths = CameraPaths(
            t_ns=arm.t_ns,
            position=arm.seen_by.position,
            quaternion_xyzw=arm.seen_by.quaternion_xyzw,
            known=arm.known,
            intrinsics=[arm.seen_by.lens] * count,
            noise=[arm.noise] * count,
            joints=of.joints,
            middle=middles[p],
            person=p,
            others=np.stack(others) if others else None,
        )
        start_m = PlannerConfig().tuning.sight_start_m
        maps = in_turn(fields, arm.t_ns)
        found.append(measure(paths, maps, detect[p], start_m=start_m, trials=DRAWS, seed=seed))
    return joined(found)


def _means(each: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Average equal keys of dictionaries, in dictionaries of them as well; of texts the first one holds."""
    found: dict[str, Any] = {}
    for key in each[0]:
        known = [own[key] for own in each if own[key] is not None]
        if not known or isinstance(known[0], str):
            found[key] = known[0] if known else None
        else:
            found[key] = _means(known) if isinstance(known[0], dict) else type(known[0])(np.mean(known))
    return found
