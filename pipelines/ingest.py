"""Stage `ingest`: read everything that `flight.yaml` names once, check it, and store it as one session.

Frames get their world times here, poses their world axes, intrinsics the size of the pictures. Doubtful data
are counted and reported. Unusable data are refused, with the file at fault. Each camera is a chunk of its
own: an interrupted ingest continues with the cameras that it had not finished.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pipelines.formats.common.files import leads_out
from pipelines.formats.flights.flight_reader import FlightReader, span_words
from pipelines.formats.flights.flight_sources import losses
from pipelines.formats.flights.source_hashes import (
    hash_sources,
    refuse_written,
    source_stamps,
    stated_paths,
)
from pipelines.session.description import CameraEntry, Description, Interpolation, read_description
from pipelines.session.errors import DataError, NotYetReadError
from pipelines.session.manifest import Flight, read_flight
from pipelines.session.progress import Progress, Silent
from pipelines.session.stage_records import Stage, StageRecord, note_sources
from pipelines.session.stages import Run, locked
from pipelines.session.storage import read_json, write_json

INGEST = Stage("ingest", revision=5)


@dataclass(frozen=True)
class Ingested:
    """Result of an ingest."""

    folder: Path
    record: StageRecord
    description: Description
    skipped: bool  # True if nothing had changed


def ingest(
    flight_path: Path,
    session: Path | None = None,
    *,
    max_pose_gap_s: float = 0.5,
    max_extrapolation_s: float = 0.1,
    strict: bool = False,
    overwrite: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> Ingested:
    """Read a flight into a session.

    Args:
        flight_path: the manifest.
        session: the output folder; by default `<name of the manifest>.session` beside it.
        max_pose_gap_s: frames between two logged poses further apart than this have no pose.
        max_extrapolation_s: frames further than this before or after all logged poses have none.
        strict: refuse a flight if any part of it could not be read or used.
        overwrite: write also to a target that holds something else.
        force: read everything again even if nothing changed.
        progress: receives the progress.

    Raises:
        DataError: something cannot be used, or was changed while it was read; the session stays as it was.
        BusyError: another process writes the session.
    """
    progress = progress or Silent()
    flight = read_flight(flight_path)
    _refuse_unread_parts(flight, flight_path)
    _refuse_ways_out(flight, flight_path)
    target = session or flight_path.with_suffix(".session")
    _refuse_other_flight(target, flight, overwrite)
    interpolation = Interpolation(max_gap_s=max_pose_gap_s, max_extrapolation_s=max_extrapolation_s)
    settings = {
        "flight": flight.model_dump(mode="json"),
        "cameras": list(flight.cameras),  # their order breaks ties
        "pose_interpolation": interpolation.model_dump(),
        "flight_from_session": Path(os.path.relpath(flight_path.parent, target)).as_posix(),  # for media
    }

    with FlightReader(flight, flight_path, target, interpolation) as reader:
        stamps = source_stamps(flight, flight_path.parent)
        check_sources = partial(refuse_written, flight, flight_path.parent, stamps)
        # If nothing can be skipped, sources are read while they are hashed.
        meanwhile = reader.read_ahead() if force or _is_new(target) else iter(())
        sources, damage = hash_sources(flight, flight_path.parent, progress, meanwhile)
        with locked(target, create=True, overwrite=overwrite) as writable:
            run = writable.begin(INGEST, settings=settings, inputs=sources, force=force)
            if run.finished:
                note_sources(target, sources, stamps)
                stored_description = read_description(target)
                if strict:
                    _refuse_losses(flight_path, stored_description)
                return Ingested(target, run.record, stored_description, skipped=True)

            progress.start("Reading cameras", len(flight.cameras))
            entries, warnings = _store_cameras(run, reader, list(flight.cameras), check_sources, progress)
            _check_overlap(flight_path, entries)
            truth = reader.store_truth(run.folder, entries)
            actor = reader.store_actor(run.folder, entries)
            map_ = reader.store_map(run.folder, entries)
            plan = reader.store_plan(run.folder, entries)
            origin = reader.origin()
            check_sources()
            warnings += reader.take_notes()
            warnings += [f"{path}: {losses(causes)}: copy it again" for path, causes in damage.items()]

            description = Description(
                schema_version=1,
                flight=flight.name,
                simulated=flight.simulated,
                clock_reference=flight.reference_camera,
                pose_interpolation=interpolation,
                origin=origin,
                cameras=entries,
                actor=actor,
                map=map_,
                truth=truth,
                plan=plan,
                sources=sources,
                damage=damage,
                warnings=warnings,
            )
            if strict:
                _refuse_losses(flight_path, description)
            write_json(run.folder / "session.json", description.model_dump(mode="json", by_alias=True))
            record = run.publish(counts=_counts(entries), warnings=warnings)
            note_sources(target, sources, stamps)
    return Ingested(target, record, description, skipped=False)


def _store_cameras(
    run: Run,
    reader: FlightReader,
    names: Sequence[str],
    check_sources: Callable[[], None],
    progress: Progress,
) -> tuple[dict[str, CameraEntry], list[str]]:
    """Read the cameras that no interrupted ingest has read; return their entries, and warnings."""
    entries: dict[str, CameraEntry] = {}
    warnings: list[str] = []
    for name in names:
        chunk = run.chunk(name, partial(_store_camera, reader, name, check_sources))
        shutil.copytree(chunk / "tables", run.folder / "cameras" / name)
        stored = read_json(chunk / "entry.json")
        entries[name] = CameraEntry.model_validate(stored["entry"])
        warnings += stored["warnings"]
        progress.advance()
    return entries, warnings


def _store_camera(reader: FlightReader, name: str, check_sources: Callable[[], None], folder: Path) -> None:
    """Store one camera; raise an error if its sources were changed meanwhile."""
    reader.store_camera(name, folder)
    check_sources()


def _refuse_losses(flight_path: Path, description: Description) -> None:
    """Refuse a flight of which anything was dropped, in one line with all losses by part and cause."""
    parts = {
        f"{name}: {what}": dropped
        for name, camera in description.cameras.items()
        for what, dropped in (
            ("frames", camera.frames.dropped),
            ("poses", camera.poses.dropped),
            ("keypoints", camera.keypoints.dropped if camera.keypoints else {}),
        )
    }
    parts |= description.damage
    parts["actor"] = description.actor.dropped if description.actor else {}
    parts["truth"] = description.truth.dropped if description.truth else {}
    poses_dropped = description.truth.poses_dropped if description.truth else {}
    parts |= {f"{name}: true poses": dropped for name, dropped in poses_dropped.items()}
    parts["map"] = description.map.dropped if description.map else {}
    parts |= {f"{name}: plan": sent.dropped for name, sent in (description.plan or {}).items()}
    lost = [f"{part}: {losses(dropped)}" for part, dropped in parts.items() if dropped]
    if lost:
        raise DataError(
            flight_path,
            f"is not whole, and --strict was given ({'; '.join(lost)})",
            "copy what is damaged again, or ingest without --strict",
        )


def _refuse_unread_parts(flight: Flight, path: Path) -> None:
    """Refuse, in one line, parts that are valid in a manifest but have no reader in this version."""
    if flight.actors:
        raise NotYetReadError(
            path,
            "actors: this version has no reader for it yet",
            "leave it out, or give the same data in a format of `mocap info --help`",
        )


def _refuse_ways_out(flight: Flight, path: Path) -> None:
    """Refuse relative paths out of the manifest's folder: a flight that was sent reads its own files."""
    ways_out = [stated for stated in stated_paths(flight) if leads_out(stated)]
    if ways_out:
        raise DataError(
            path,
            f"leads out of its folder ({', '.join(ways_out)})",
            "write such paths in full, from the root on, or put the files beside the manifest",
        )


def _refuse_other_flight(target: Path, flight: Flight, overwrite: bool) -> None:
    existing = target / "session.json"
    if overwrite or not existing.is_file():
        return
    try:
        held = read_json(existing).get("flight", flight.name)
    except DataError:
        return  # a damaged session is written again
    if held != flight.name:
        raise DataError(
            target,
            f"holds the flight {held!r}, not {flight.name!r}",
            "choose another place with --output, or replace it with --overwrite",
        )


def _is_new(target: Path) -> bool:
    """Return True if no ingest was finished or interrupted here."""
    return not any((target / entry).exists() for entry in (INGEST.name, ".partial"))


def _counts(entries: Mapping[str, CameraEntry]) -> dict[str, object]:
    return {
        "cameras": len(entries),
        "frames": sum(entry.frames.count for entry in entries.values()),
        "frames_without_pose": sum(entry.poses.frames_without_pose for entry in entries.values()),
        "detections": sum(entry.keypoints.detections for entry in entries.values() if entry.keypoints),
    }


def _check_overlap(flight_path: Path, entries: Mapping[str, CameraEntry]) -> None:
    """Refuse cameras whose frames overlap in time with no others, not even through a third camera."""
    ordered = sorted(entries, key=lambda name: entries[name].frames.first_t_ns)
    reached_ns = entries[ordered[0]].frames.last_t_ns
    for place, name in enumerate(ordered):
        frames = entries[name].frames
        if frames.first_t_ns > reached_ns:
            # The smaller side is the odd one out.
            late = 2 * place >= len(ordered)
            odd, rest = (ordered[place:], ordered[:place]) if late else (ordered[:place], ordered[place:])
            raise DataError(
                flight_path,
                f"cameras.{', '.join(odd)}: frames ({_span_of(odd, entries)}) overlap in time with no other"
                f" camera's ({_span_of(rest, entries)})",
                "check frame_times.start and clock.offset_s",
            )
        reached_ns = max(reached_ns, frames.last_t_ns)


def _span_of(names: Sequence[str], entries: Mapping[str, CameraEntry]) -> str:
    frames = [entries[name].frames for name in names]
    return span_words(min(f.first_t_ns for f in frames), max(f.last_t_ns for f in frames))
