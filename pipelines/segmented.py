"""Reconstruction of a long flight segment by segment, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.attempt import (
    Loaded,
    ReconstructionOutcome,
    ReconstructSettings,
    Source,
    clocks_of,
    counts_of,
    reconstruct_once,
    refuse_doubted,
    unused_cameras,
    write_attempt,
)
from pipelines.detect import cameras_to_detect
from pipelines.geometry.arrays import Float, Int64
from pipelines.reconstruction.clocks import FoundClocks, agreed_clocks
from pipelines.reconstruction.loading import common_joints
from pipelines.reconstruction.results import camera_poses_table, gait_of, write_figures
from pipelines.reconstruction.segments import (
    APART_M,
    LENGTH_S,
    MOST_KEYPOINTS,
    OVERLAP_S,
    Segment,
    apart_m,
    doubts_of_flight,
    figures_of_flight,
    joined,
    mean_angles,
    mean_poses,
    mean_skeleton,
    merged,
    nothing_seen,
    numbered,
    places,
    rows_of_people,
    same_people,
    sampled,
    warnings_of_flight,
)
from pipelines.session.description import Description, Doubt, read_description
from pipelines.session.errors import DataError, NoViewsError
from pipelines.session.memory import Waiting, available_bytes, return_freed_arrays, return_unused
from pipelines.session.parallel import SharedSession, contents_of, each_part, write_contents
from pipelines.session.people import LoggedActor
from pipelines.session.progress import Progress, Silent
from pipelines.session.stages import Run, Session
from pipelines.session.storage import jsonable, read_json, write_json
from pipelines.session.tables import (
    ANGLES,
    CAMERA_POSES,
    GAIT,
    SKELETON,
    Span,
    join_tables,
    read_table,
    write_table,
)

if TYPE_CHECKING:
    import pandas as pd


# Unknown clocks are those of the whole flight: so many segments find them.
_CLOCKED = 3
# A segment takes so much memory.
_SEGMENT_BYTES = 1 << 30


@dataclass(frozen=True)
class _Order:
    """A segment for a worker."""

    session: SharedSession
    settings: ReconstructSettings
    background: bool
    left_out: str | None
    segment: Segment
    threads: int
    clocks: FoundClocks | None = None  # of all cameras of the flight
    person: LoggedActor | None = None  # place of the person at the end of the segment before

    def load(self, waiting: Waiting) -> tuple[Source, Loaded]:
        """Load the segment from the session."""
        folder = self.session.opened()
        description = read_description(folder)
        detected = Session(folder).record("detect") if cameras_to_detect(description) else None
        source = Source(folder, description, self.settings, detected, self.background, self.left_out)
        loaded = source.load(waiting, self.segment.span_ns)
        flight = replace(loaded.flight, segment=self.segment)
        if self.person is not None and not flight.actors:
            flight = replace(flight, actors=[self.person])
        if self.clocks is not None:
            names = list(description.cameras)
            here = [names.index(camera.name) for camera in loaded.cameras]
            flight = replace(flight, clocks=self.clocks.of(names, here))
        return source, replace(loaded, flight=flight)


def clocks_of_segment(order: _Order) -> dict[str, dict[str, Any]]:
    """Find the clocks of a segment on a worker; see `agreed_clocks`."""
    return_freed_arrays()
    settings = (
        replace(order.settings, method="auto") if order.settings.method == "refined" else order.settings
    )
    with TemporaryDirectory() as place:
        try:
            source, loaded = order.load(Waiting(Path(place)))
            clocks, prior_s, _ = clocks_of(loaded.flight, loaded.cameras, settings, order.threads)
        except NoViewsError:
            return {"": {"common_sigma_s": 0.0}}
    if clocks is None:
        clocks = FoundClocks(np.zeros(len(prior_s)), np.zeros(len(prior_s)), prior_s)
    found: dict[str, dict[str, Any]] = {"": {"common_sigma_s": clocks.common_sigma_s}}
    for c, camera in enumerate(loaded.cameras):
        found[camera.name] = {
            "offset_s": float(clocks.offset_s[c]),
            "sigma_s": float(clocks.sigma_s[c]),
            "prior_s": float(prior_s[c]),
        }
        if source.description.cameras[camera.name].clock.prior_sigma_s == 0:
            found[camera.name]["wrong"] = clocks.wrong.get(camera.name, "")
    return found


def reconstruct_segment(order: _Order) -> dict[str, bytes]:
    """Reconstruct a segment on a worker; return its files: the tables of a session, and part.json.

    Raises:
        DataError: the worker has no such session, or a table of it is damaged.
    """
    return_freed_arrays()
    with TemporaryDirectory() as place:
        made, waiting = Path(place, "made"), Path(place, "waiting")
        made.mkdir()
        waiting.mkdir()
        try:
            part = _made_of_segment(made, order, *order.load(Waiting(waiting)))
        except NoViewsError as error:
            part = _nothing_of_segment(made, order, str(error))
        write_json(made / "part.json", jsonable(part))
        return_unused()
        return contents_of(made)


def _made_of_segment(place: Path, order: _Order, source: Source, loaded: Loaded) -> dict[str, object]:
    """Reconstruct a segment; write its tables and return what is known of it."""
    attempt = reconstruct_once(loaded.flight, loaded.cameras, order.settings, order.threads, Silent())
    doubts = source.doubts(loaded, attempt)
    gait, walks = gait_of(attempt.observations, attempt.result)
    corrected = [] if attempt.poses is None else attempt.poses["camera"].unique().tolist()
    timed = attempt.timed(loaded.cameras)
    logged = [camera for camera in timed if camera.name not in corrected]
    poses = [attempt.poses] if attempt.poses is not None else []
    if logged:
        poses.append(camera_poses_table(logged, source.description.pose_interpolation))
    write_attempt(place, replace(attempt, poses=None), gait[gait["t_ns"].between(*order.segment.own_ns)])
    join_tables(place / "cameras.parquet", poses, CAMERA_POSES)
    metrics = attempt.metrics | {"gait": walks, "doubts": [doubt.as_json() for doubt in doubts]}
    return {
        "metrics": metrics,
        "counts": counts_of(metrics, attempt, loaded.swaps),
        "corrected": corrected,
        "warnings": [
            *loaded.warnings,
            *attempt.warnings,
            *unused_cameras(loaded.cameras, attempt.result),
        ],
        "reason": None,
    }


def _nothing_of_segment(place: Path, order: _Order, reason: str) -> dict[str, object]:
    """Write the rows of a segment in which no two cameras see anything."""
    folder = order.session.opened()
    description = read_description(folder)
    detected = Session(folder).record("detect") if cameras_to_detect(description) else None
    joints = common_joints(folder, description, detected)
    people = order.settings.people if isinstance(order.settings.people, int) else 1
    skeleton, angles = nothing_seen(order.segment, joints, people)
    write_table(place / "skeleton.parquet", skeleton, SKELETON)
    write_table(place / "angles.parquet", angles, ANGLES)
    own = order.segment.own
    count = (own.stop - own.start) * people * len(joints)
    return {"metrics": None, "reason": reason, "joint_frames": count}


def stated_segments(segments: Sequence[Segment]) -> dict[str, object]:
    """Return how a long flight is divided, for the settings that determine its result; empty for others."""
    if len(segments) < 2:
        return {}
    return {"segments": {"longest_s": LENGTH_S, "most_keypoints": MOST_KEYPOINTS, "overlap_s": OVERLAP_S}}


def by_segments(
    run: Run,
    source: Source,
    segments: Sequence[Segment],
    base: str,
    workers: int,
    executor: Executor | None,
    strict: bool,
    progress: Progress,
) -> ReconstructionOutcome:
    """Reconstruct a long flight segment by segment, and join them.

    Args:
        run: keeps the segments that are finished, so that a later run goes on with the others.
        source: the session.
        segments: at least two.
        base: the camera whose pictures give the times of the skeleton.
        workers: the number of processes on this machine, as far as its memory allows.
        executor: works on the segments instead.
        strict: refuse a flight that is doubted.
        progress: receives the progress.
    """
    folder = source.folder
    threads = 1
    if executor is None:
        memory = available_bytes()
        most = workers if memory is None else min(workers, max(memory // _SEGMENT_BYTES, 1))
        count = min(most, len(segments))
        workers, threads = count, max(workers // count, 1)
    each: Each = partial(each_part, workers=workers, executor=executor)
    progress.start("Reconstructing", len(segments))

    def order_of(segment: Segment) -> _Order:
        shared = SharedSession.at(folder)
        return _Order(shared, source.settings, source.background, source.left_out, segment, threads)

    clocks = _clocks_of_flight(run, source, [order_of(part) for part in sampled(segments, _CLOCKED)], each)
    if clocks is not None and source.settings.rate_hz is None:
        late_ns = round(1e9 * clocks.offset_s[list(source.description.cameras).index(base)])
        segments = [segment.later(late_ns) for segment in segments]
    orders = [replace(order_of(segment), clocks=clocks) for segment in segments]
    missing = [order for order in orders if not run.has_chunk(order.segment.name)]
    progress.advance(len(orders) - len(missing))
    with closing(each(reconstruct_segment, missing)) as found:
        for number, contents in found:
            run.chunk(missing[number].segment.name, partial(write_contents, contents))
            progress.advance()
    flight = _Joined.of(run, source, orders)
    doubts = flight.doubts
    _refuse_nothing_of_segments(folder, flight, doubts)
    metrics = flight.metrics | {"doubts": [doubt.as_json() for doubt in doubts]}
    if clocks is not None and (clocks.moves or _has_unknown_clocks(source.description)):
        metrics |= clocks.as_metrics(list(source.description.cameras))
    refuse_doubted(folder, metrics["doubts"], strict=strict)
    flight.write(run.folder)
    metrics = write_figures(run.folder, jsonable(metrics))
    return ReconstructionOutcome(metrics, doubts, flight.counts, flight.warnings)


Each = Callable[[Callable[[_Order], Any], Sequence[_Order]], Generator[tuple[int, Any]]]


def _clocks_of_flight(run: Run, source: Source, orders: Sequence[_Order], each: Each) -> FoundClocks | None:
    """Find the clocks of all cameras; None if all are held without a look."""
    cameras = source.description.cameras
    if source.settings.method != "auto" and not _has_unknown_clocks(source.description):
        return None

    def find(place: Path) -> None:
        found: list[dict[str, dict[str, Any]]] = [{}] * len(orders)
        with closing(each(clocks_of_segment, orders)) as parts:
            for number, clocks in parts:
                found[number] = clocks
        write_json(place / "clocks.json", {"segments": found})

    return agreed_clocks(list(cameras), read_json(run.chunk("clocks", find) / "clocks.json")["segments"])


def _has_unknown_clocks(description: Description) -> bool:
    return any(camera.clock.prior_sigma_s > 0 for camera in description.cameras.values())


@dataclass(frozen=True)
class _Joined:
    """The finished segments of a flight, and the number of each person over the flight."""

    description: Description
    segments: Sequence[Segment]
    folders: Sequence[Path]
    numbers: Sequence[Sequence[int]]
    strangers: Sequence[int]  # segments whose person is another one than before

    @classmethod
    def of(cls, run: Run, source: Source, orders: Sequence[_Order]) -> _Joined:
        """Number the people of all segments; a segment that chose somebody else is made once more."""
        logged = len(source.description.logged_people)
        folders: list[Path] = []
        numbers: list[list[int]] = []
        strangers: list[int] = []
        before: tuple[Int64, Float] | None = None
        for k, order in enumerate(orders):
            place = run.chunk(order.segment.name, _never)
            first_ns = order.segment.own_ns[0]
            shared = (first_ns - round(0.5e9 * OVERLAP_S), first_ns + round(0.5e9 * OVERLAP_S))
            here = _places(place, shared)
            if before is None:
                numbers.append(list(range(here[1].shape[1])))
            else:
                distance = apart_m(before, here)
                alone = distance.shape == (1, 1) and not logged
                if alone and distance[0, 0] > APART_M:
                    known = np.isfinite(before[1][:, 0]).all(axis=1)
                    person = LoggedActor(before[0][known], before[1][known, 0])
                    again = replace(order, person=person)
                    made = run.chunk(f"{order.segment.name}-again", partial(_write_segment, again))
                    if apart_m(before, other := _places(made, shared))[0, 0] <= APART_M:
                        place, here, distance = made, other, apart_m(before, other)
                    else:
                        strangers.append(k)
                numbers.append(numbered(same_people(distance, logged), here[1].shape[1], numbers[-1]))
            folders.append(place)
            end_ns = order.segment.own_ns[1]
            before = _places(place, (end_ns - round(0.5e9 * OVERLAP_S), end_ns + round(0.5e9 * OVERLAP_S)))
        return cls(source.description, [order.segment for order in orders], folders, numbers, strangers)

    @cached_property
    def parts(self) -> list[dict[str, Any]]:
        """Figures, counts and warnings of each segment."""
        return [dict(read_json(folder / "part.json")) for folder in self.folders]

    @property
    def people(self) -> int:
        """Number of people in the flight."""
        return 1 + max(max(of) for of in self.numbers)

    @property
    def doubts(self) -> list[Doubt]:
        """Doubts of at least half of the segments."""
        return self._doubts[0]

    @cached_property
    def _doubts(self) -> tuple[list[Doubt], list[tuple[Doubt, int, int]]]:
        return doubts_of_flight([part["metrics"]["doubts"] for part in self.parts if part["metrics"]])

    @property
    def counts(self) -> dict[str, object]:
        """Counts of all segments."""
        counts = [part["counts"] for part in self.parts if part["metrics"]]
        return dict(merged(counts, [1.0] * len(counts), summed=True))

    @property
    def metrics(self) -> dict[str, Any]:
        """Figures of the flight, and what was used in each segment."""
        made = [part["metrics"] for part in self.parts if part["metrics"]]
        if not made:
            return {"doubts": [], "status_counts": {"ok": 0}}
        named = [
            self._named(part["metrics"], number)
            for part, number in zip(self.parts, self.numbers, strict=True)
            if part["metrics"]
        ]
        flight = figures_of_flight(named)
        gone = sum(part["joint_frames"] for part in self.parts if not part["metrics"])
        if gone:
            counts = flight["status_counts"]
            counts["all"] += gone
            counts["few_views"] = counts.get("few_views", 0) + gone
            flight["reconstructed_share"] = counts["ok"] / counts["all"]
        flight["people"]["names"] = self.description.names_of_people(self.people)
        start_ns = self.description.start_ns
        flight["segments"] = [
            {
                "first_s": (segment.own_ns[0] - start_ns) / 1e9,
                "last_s": (segment.own_ns[1] - start_ns) / 1e9,
                "used": part["metrics"]["method_used"]["summary"] if part["metrics"] else part["reason"],
                "doubts": [doubt["code"] for doubt in part["metrics"]["doubts"]] if part["metrics"] else [],
            }
            for segment, part in zip(self.segments, self.parts, strict=True)
        ]
        return flight

    def _named(self, metrics: Mapping[str, Any], number: Sequence[int]) -> dict[str, Any]:
        """Return figures of a segment with the names and numbers that its people have in the flight."""
        names = self.description.names_of_people(self.people)
        by_person = list(metrics["by_person"].values())
        here = dict(zip(metrics["people"]["names"], number, strict=True))
        doubted = {names[here[name]]: cause for name, cause in metrics["people"]["doubted"].items()}
        return dict(metrics) | {
            "people": metrics["people"] | {"doubted": doubted},
            "by_person": {names[k]: of for k, of in zip(number, by_person, strict=True)},
            "gait": {str(k): metrics["gait"].get(str(p)) for p, k in enumerate(number)},
        }

    @property
    def warnings(self) -> list[str]:
        """Warnings of all segments; those that differ in numbers alone are one."""
        start_ns = self.description.start_ns
        begins_s, ends_s = (
            [(segment.own_ns[end] - start_ns) / 1e9 for segment in self.segments] for end in (0, 1)
        )
        told = [
            f"from {begin_s:.0f} s to {end_s:.0f} s nothing could be reconstructed: {part['reason']}"
            for begin_s, end_s, part in zip(begins_s, ends_s, self.parts, strict=True)
            if not part["metrics"]
        ]
        told += [
            f"from {begins_s[k]:.0f} s on another person may be the actor: state --persons, or log the actor"
            for k in self.strangers
        ]
        made = [k for k, part in enumerate(self.parts) if part["metrics"]]
        told += [
            f"{count} of {len(made)} segments, first that from {begins_s[made[k]]:.0f} s to"
            f" {ends_s[made[k]]:.0f} s: {doubt.as_warning()}"
            for doubt, count, k in self._doubts[1]
        ]
        return told + warnings_of_flight([part["warnings"] for part in self.parts if part["metrics"]])

    def write(self, place: Path) -> None:
        """Write the tables of the flight."""

        def rows(name: str, schema: Any, kinds: str) -> Iterator[tuple[Segment, pd.DataFrame]]:
            for segment, folder, number in zip(self.segments, self.folders, self.numbers, strict=True):
                table = read_table(folder / name, schema)
                yield segment, rows_of_people(table, number, self.people, kinds)

        for name, schema, kind, mean in (
            ("skeleton.parquet", SKELETON, "joint", mean_skeleton),
            ("angles.parquet", ANGLES, "angle", mean_angles),
        ):
            keys = ("t_ns", "person", kind)
            join_tables(place / name, joined(rows(name, schema, kind), keys, mean), schema)
        there = [k for k, part in enumerate(self.parts) if part["metrics"]]
        walks = []
        for k in there:
            table = read_table(self.folders[k] / "gait.parquet", GAIT)
            walks.append(table.assign(person=np.array(self.numbers[k])[table["person"].to_numpy(np.int64)]))
        join_tables(place / "gait.parquet", walks, GAIT)
        corrected = {name for k in there for name in self.parts[k]["corrected"]}

        def poses(camera: str) -> Iterator[tuple[Segment, pd.DataFrame]]:
            for k in there:
                table = read_table(self.folders[k] / "cameras.parquet", CAMERA_POSES)
                yield self.segments[k], table[table["camera"] == camera]

        cameras = [name for name in self.description.cameras if name in corrected]
        parts = (joined(poses(camera), ("t_ns", "camera"), mean_poses) for camera in cameras)
        if cameras:
            join_tables(place / "cameras.parquet", chain.from_iterable(parts), CAMERA_POSES)


def _places(place: Path, within_ns: Span) -> tuple[Int64, Float]:
    """Load where the people of a segment are at some of its times, see `segments.places`."""
    return places(read_table(place / "skeleton.parquet", SKELETON, within_ns), within_ns)


def _write_segment(order: _Order, place: Path) -> None:
    write_contents(reconstruct_segment(order), place)


def _never(place: Path) -> None:
    raise RuntimeError(f"{place} was finished before")


def _refuse_nothing_of_segments(folder: Path, flight: _Joined, doubts: Sequence[Doubt]) -> None:
    """Refuse a flight without any joint, with the reasons of its segments."""
    counts = flight.metrics["status_counts"]
    if counts["ok"]:
        return
    reasons = [*flight.warnings, *(doubt.what for doubt in doubts[:1] if doubt.remedy)]
    remedies = [doubt.remedy for doubt in doubts[:1] if doubt.remedy]
    gates = ", ".join(f"{name} {count}" for name, count in counts.items() if name not in ("all", "ok"))
    raise DataError(
        folder,
        "; ".join([f"no joint could be reconstructed ({gates})", *reasons[:3]]),
        *(remedies or ["check calibration, clocks and poses, or state another pose noise with --pose-noise"]),
        code="nothing-reconstructed",
    )
