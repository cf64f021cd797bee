"""Check a flight: what its description, its logs and its pictures cannot all be true of.

A flight that was not ingested yet is read into a temporary session. Where no keypoints are known, the
detector looks at a few seconds in the middle, in a temporary copy, and the backgrounds are followed: only
they tell that all cameras' clocks are alike wrong.
"""

import difflib
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.detect import BACKGROUND, DETECT, cameras_to_detect, cameras_to_follow, detect, follow
from pipelines.ingest import ingest
from pipelines.reconstruct import chosen_detections, find_people
from pipelines.reconstruction.background import turned_aside
from pipelines.reconstruction.background_tracks import load_tracks
from pipelines.reconstruction.doubts.diagnosis import doubts_of
from pipelines.reconstruction.doubts.remedies import mended
from pipelines.reconstruction.loading import load_cameras
from pipelines.session.description import Description, Doubt, read_description
from pipelines.session.errors import DataError
from pipelines.session.parallel import return_freed_arrays
from pipelines.session.people import logged_people
from pipelines.session.progress import Progress, Silent
from pipelines.session.stages import Session, StageRecord, WritableSession, copy_session, locked, open_session
from pipelines.session.storage import drop_link, write_whole

LOOK_S = 8.0
"""Seconds in the middle of a flight that the detector looks at."""
LOOK_EVERY = 3
"""It looks at every third picture of them: ten a second of thirty."""

# The confidence below which `reconstruct` leaves keypoints out unless asked otherwise.
MIN_CONFIDENCE = 0.3


@dataclass(frozen=True)
class Checked:
    """The doubts of a flight."""

    doubts: list[Doubt]
    warnings: list[str]  # of ingest
    pictures: str  # which pictures were looked at, in words; empty if all that have keypoints


def check(
    path: Path,
    *,
    pose_noise: str | None = None,
    detector: str = "blazepose",
    workers: int = 1,
    progress: Progress | None = None,
) -> Checked:
    """Check a session, or a flight by its manifest; `detector` looks at pictures without keypoints.

    `pose_noise` replaces that of flight.yaml. DataError: the flight cannot be read, or nobody is seen.
    """
    progress = progress or Silent()
    return_freed_arrays()
    with tempfile.TemporaryDirectory(prefix="mocap-check-") as folder:
        copy = Path(folder) / "check.session"
        if path.is_dir():
            session = open_session(path)
            session.ingested()
            looked_at = session.intact_record(DETECT.name) is not None
            if looked_at or not cameras_to_detect(read_description(path)):
                return _checked(session, pose_noise, detector, workers, progress)
            copy_session(path, copy)
        else:
            ingest(path, copy, progress=progress)
        with locked(copy) as writable:
            return _checked(writable, pose_noise, detector, workers, progress)


def fix(manifest: Path, **options: Any) -> tuple[Checked, list[str]]:
    """Check a flight, and write into its manifest the remedies with which it is doubted less.

    The remedy of the first doubt is put into a copy beside the manifest, which is checked as a whole. It is
    kept if its doubt is gone and no other appears; then comes that of the next first doubt. Return the doubts
    that are left, and the lines of the difference. DataError: the path is a session, or the flight cannot be
    read.
    """
    if manifest.is_dir():
        problem = "is a session: remedies are written into its flight.yaml"
        raise DataError(manifest, problem, "check that file", code="bad-option")
    checked = check(manifest, **options)
    stated = text = manifest.read_text(encoding="utf-8")
    copy = manifest.with_name(f".{manifest.name}.tried")  # beside it, since paths are relative
    try:
        while checked.doubts and (changed := mended(text, checked.doubts[0].remedy)) is not None:
            drop_link(copy)
            copy.write_text(changed, encoding="utf-8")
            after = check(copy, **options)
            left = {doubt.code for doubt in after.doubts}
            if checked.doubts[0].code in left or left - {doubt.code for doubt in checked.doubts}:
                break
            text, checked = changed, after
        if text != stated:
            write_whole(manifest, text.encode("utf-8"))
    finally:
        copy.unlink(missing_ok=True)
    name = manifest.name
    return checked, list(
        difflib.unified_diff(stated.splitlines(), text.splitlines(), name, name, n=1, lineterm="")
    )


def _checked(
    session: Session, pose_noise: str | None, detector: str, workers: int, progress: Progress
) -> Checked:
    session.ingested()
    folder = session.folder
    description = read_description(folder)
    detected, pictures = _detected(session, description, detector, workers, progress)
    cameras, _ = load_cameras(
        folder, description, detected, min_confidence=MIN_CONFIDENCE, pose_noise=pose_noise
    )
    actors = logged_people(folder, description)
    found, association, _ = find_people(cameras, description.pose_interpolation, actors)
    moving = [] if session.intact_record(BACKGROUND.name) is None else [c for c in cameras if not c.static]
    tracks = {camera.name: load_tracks(folder, camera) for camera in moving}
    doubts = doubts_of(
        folder,
        description,
        cameras,
        chosen=chosen_detections(cameras, found, association),
        followed={name: own for name, own in tracks.items() if own is not None},
        aside=turned_aside,
        pose_noise=pose_noise,
    )
    alone = ["one camera: its poses were not compared with another view"] * (len(description.cameras) == 1)
    return Checked(doubts, [*description.warnings, *alone], pictures)


def _detected(
    session: Session, description: Description, detector: str, workers: int, progress: Progress
) -> tuple[StageRecord | None, str]:
    """Return the detection that the session has, else one of a few seconds; and its pictures in words."""
    if not cameras_to_detect(description):
        return None, ""
    known = session.intact_record(DETECT.name)
    if known is not None:
        return known, ""
    if not isinstance(session, WritableSession):
        raise TypeError("pictures are looked at in a copy of the session")
    frames = [entry.frames for entry in description.cameras.values()]
    first, last = max(each.first_t_ns for each in frames), min(each.last_t_ns for each in frames)
    middle_s = ((first + last) / 2 - description.start_ns) / 1e9
    start_s, end_s = max(0.0, middle_s - LOOK_S / 2), middle_s + LOOK_S / 2
    record = detect(
        session,
        detector=detector,
        every=LOOK_EVERY,
        start_s=start_s,
        end_s=end_s,
        workers=workers,
        progress=progress,
    )
    moving = cameras_to_follow(description)
    # Of imported keypoints, all pictures would have to be decoded.
    if moving and all(description.cameras[name].keypoints is None for name in moving):
        span_s = (start_s, end_s)
        follow(session, every=LOOK_EVERY, span_s=span_s, workers=workers, progress=progress)
    return record, f"every third picture from {start_s:.1f} to {end_s:.1f} s"
