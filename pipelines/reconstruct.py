"""Stage `reconstruct`: compute a skeleton, its status and its errors from keypoints in moving cameras.

Detect people in the pictures and follow backgrounds where that was not done; reconstruct the flight at once
(`attempt`) or, if it is long, segment by segment (`segmented`); doubt what cannot be right; store.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.attempt import (
    Attempt,
    ReconstructionOutcome,
    ReconstructSettings,
    Source,
    counts_of,
    reconstruct_once,
    refuse_doubted,
    unused_cameras,
    write_attempt,
)
from pipelines.detect import detect, hints_from, hints_of
from pipelines.follow import Following, cameras_to_follow
from pipelines.geometry.triangulation import STATUS
from pipelines.keypoints.calibration import measured_for
from pipelines.reconstruction.finishing import smoother
from pipelines.reconstruction.loading import common_joints, load_time_base
from pipelines.reconstruction.results import gait_of, write_figures
from pipelines.reconstruction.segments import divided
from pipelines.reconstruction.solving import noise_text
from pipelines.reconstruction.trials import PoseDisturbance, disturbed, summary_of_trials
from pipelines.segmented import by_segments, stated_segments
from pipelines.session.description import Description, Doubt, assumptions_as_warnings, read_description
from pipelines.session.errors import DataError
from pipelines.session.memory import Waiting, return_freed_arrays
from pipelines.session.progress import Progress, Silent
from pipelines.session.stages import Run, Stage, StageRecord, WritableSession, locked
from pipelines.session.storage import jsonable, read_json, sha256_of

__all__ = ["RECONSTRUCT", "ReconstructSettings", "Reconstructed", "reconstruct"]

RECONSTRUCT = Stage("reconstruct", revision=28)
# A longer gap is no measurement.
_LONGEST_FILL_S = 10.0


@dataclass(frozen=True)
class Reconstructed:
    """Result of a reconstruction."""

    folder: Path
    record: StageRecord
    metrics: dict[str, Any]
    skipped: bool  # True if nothing had changed


def reconstruct(
    folder: Path,
    settings: ReconstructSettings | None = None,
    *,
    strict: bool = False,
    workers: int = 1,
    executor: Executor | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Reconstructed:
    """Triangulate the people of a session, measure the errors, and doubt what cannot be right.

    Args:
        folder: the session.
        settings: the settings that determine the result.
        strict: refuse a flight that is doubted.
        workers: the number of processes and threads; the result does not depend on it.
        executor: works on the pictures and segments instead; neither does the result depend on that.
        force: run it again even if nothing changed, and the detection too.
        progress: receives the progress.

    Raises:
        DataError: the session cannot be used, one of its tables or the pictures were changed, nothing could
            be reconstructed (the message gives the counts of the reasons, and the mistake that explains
            them), or the flight is doubted and `strict`.
        BusyError: another process writes the session.
    """
    settings = settings or ReconstructSettings()
    progress = progress or Silent()
    disturbance = PoseDisturbance.parse(settings.disturb_poses) if settings.disturb_poses else None
    smoother(settings.smooth)
    _check_fill(settings.fill_s)
    return_freed_arrays()
    with locked(folder) as session:
        ingested = session.ingested()
        description = read_description(folder)
        settings = replace(settings, people=settings.people or ("auto" if description.actors else 1))
        following, left_out = _following(session, description, settings, force)
        detected = _detected(session, settings, workers, force, following, executor, progress)
        background = None
        if following is not None:
            background, left_out = _finished(following, settings, workers, executor, progress)
        measured = measured_for(detected.settings["detector"]) if detected else None
        base, t_ns = load_time_base(folder, description, detected, settings.rate_hz)
        keypoints = len(description.cameras) * len(common_joints(folder, description, detected))
        segments = divided(t_ns, keypoints) if disturbance is None else []
        run = session.begin(
            RECONSTRUCT,
            settings=_stated(settings, detected) | stated_segments(segments),
            inputs=_inputs(ingested, detected, background, measured),
            force=force,
        )
        if run.finished:
            metrics = read_json(folder / "reconstruct" / "metrics.json")
            refuse_doubted(folder, metrics["doubts"], strict=strict)
            return Reconstructed(folder, run.record, metrics, skipped=True)

        source = Source(folder, description, settings, detected, background is not None, left_out)
        if len(segments) > 1:
            outcome = by_segments(run, source, segments, base, workers, executor, strict, progress)
        else:
            outcome = _at_once(run.folder, source, disturbance, workers, strict, progress)
        record = run.publish(
            counts=outcome.counts,
            warnings=[
                *(doubt.as_warning() for doubt in outcome.doubts),
                *assumptions_as_warnings(description.assumptions),
                *_hint_warnings(description, ingested, detected),
                *outcome.warnings,
            ],
        )
        _note_replaced(run, progress)
    return Reconstructed(folder, record, outcome.metrics, skipped=False)


def _at_once(
    place: Path,
    source: Source,
    disturbance: PoseDisturbance | None,
    workers: int,
    strict: bool,
    progress: Progress,
) -> ReconstructionOutcome:
    """Reconstruct a flight as a whole, with so many trials of pose errors, and write it into a folder."""
    folder, settings = source.folder, source.settings
    trials = 1 if disturbance is None else disturbance.trials
    progress.start("Reconstructing", 1 + 3 * trials)
    loaded = source.load(Waiting(place))
    cameras, warnings = loaded.cameras, list(loaded.warnings)
    progress.advance()
    attempts = (
        reconstruct_once(
            loaded.flight,
            disturbed(cameras, disturbance.models, disturbance.seed, trial) if disturbance else cameras,
            settings,
            workers,
            progress,
        )
        for trial in range(trials)
    )
    stored = next(attempts)
    doubts = source.doubts(loaded, stored)
    _refuse_nothing(folder, stored, doubts)
    gait, walks = gait_of(stored.observations, stored.result)
    metrics = stored.metrics | {"gait": walks, "doubts": [doubt.as_json() for doubt in doubts]}
    refuse_doubted(folder, metrics["doubts"], strict=strict)
    if disturbance is not None:
        every = [metrics, *(attempt.metrics for attempt in attempts)]
        metrics = metrics | {"trials": summary_of_trials(every, disturbance.text, disturbance.seed)}
        warnings.append(_disturbance_warning(disturbance))
    metrics = jsonable(metrics)
    write_attempt(place, stored, gait)
    metrics = write_figures(place, metrics)
    warnings += [*stored.warnings, *unused_cameras(cameras, stored.result)]
    return ReconstructionOutcome(metrics, doubts, counts_of(metrics, stored, loaded.swaps), warnings)


def _detected(
    session: WritableSession,
    settings: ReconstructSettings,
    workers: int,
    force: bool,
    following: Following | None,
    executor: Executor | None,
    progress: Progress,
) -> StageRecord | None:
    """Run the stage `detect`; return None if every camera has imported keypoints."""
    detected = detect(
        session,
        detector=settings.detector,
        people=settings.people if isinstance(settings.people, int) else 2,
        every=settings.every,
        start_s=settings.start_s,
        end_s=settings.end_s,
        workers=workers,
        force=force,
        following=following,
        executor=executor,
        progress=progress,
    )
    if detected is None and (settings.start_s, settings.end_s) != (None, None):
        raise DataError(
            session.folder,
            "every camera came with keypoints: no picture is looked at",
            "leave the span out of --pictures",
            code="no-pictures",
        )
    if detected is None and settings.every > 1:
        progress.note("every camera came with keypoints: --pictures says nothing about them")
    return detected


def _stated(settings: ReconstructSettings, detected: StageRecord | None) -> dict[str, object]:
    """Return the settings; the detector's name is that of the detection, without the paths of model files."""
    return asdict(settings) | {"detector": detected.settings["detector"] if detected else None}


def _inputs(
    ingested: StageRecord, detected: StageRecord | None, background: StageRecord | None, measured: Path | None
) -> dict[str, str]:
    """The hashes of what is read: tables, hints of the detector, and how its confidences were measured."""
    inputs = dict(ingested.outputs) | (detected.outputs | hints_from(detected) if detected else {})
    inputs |= background.outputs if background else {}
    return inputs if measured is None else inputs | {"calibration of confidences": sha256_of(measured)}


def _hint_warnings(
    description: Description, ingested: StageRecord, detected: StageRecord | None
) -> list[str]:
    """Say where keypoints were found with other clocks, poses or calibrations than were ingested last."""
    if detected is None or hints_from(detected) == hints_of(
        description, ingested, detected.counts["cameras"]
    ):
        return []
    return [
        "keypoints are those of an earlier ingest: the clocks, poses or calibrations that said where to look"
        " for the actor have changed since; --force detects them anew"
    ]


def _check_fill(fill_s: float | None) -> None:
    if fill_s is not None and not 0 < fill_s <= _LONGEST_FILL_S:
        raise DataError(
            "--smooth",
            f"max_s: {fill_s:g} s is not between 0 and {_LONGEST_FILL_S:g} s",
            "a longer gap is no measurement: leave it open",
            code="bad-value",
        )


def _disturbance_warning(disturbance: PoseDisturbance) -> str:
    draws = "a single draw" if disturbance.trials == 1 else f"trial 0 of {disturbance.trials}"
    return (
        f"the poses were disturbed by {disturbance.text}: the skeleton and the figures without `trials`"
        f" are those of {draws} (seed {disturbance.seed}), not the flight's"
    )


def _note_replaced(run: Run, progress: Progress) -> None:
    """Report the changed settings of a replaced reconstruction."""
    for name, (before, now) in run.replaces.items():
        progress.note(f"replaced the reconstruction made with {name} = {before} (now {now})")


def _following(
    session: WritableSession, description: Description, settings: ReconstructSettings, force: bool
) -> tuple[Following | None, str | None]:
    """Prepare to follow the backgrounds of moving cameras; None, with the reason where `auto` cannot."""
    if not settings.asks_background or (settings.method == "auto" and not cameras_to_follow(description)):
        return None, None
    try:
        span_s = (settings.start_s, settings.end_s)
        return Following(session, every=settings.every, span_s=span_s, force=force), None
    except DataError as error:
        if settings.refine_cameras is not None:
            raise
        return None, f"{Path(error.source).name} {error.problem}"


def _finished(
    following: Following,
    settings: ReconstructSettings,
    workers: int,
    executor: Executor | None,
    progress: Progress,
) -> tuple[StageRecord | None, str | None]:
    """Follow what the detector did not show; None with the reason why `auto` goes without backgrounds."""
    try:
        return following.finish(workers=workers, executor=executor, progress=progress), None
    except DataError as error:
        if settings.refine_cameras is not None:
            raise
        return None, f"{Path(error.source).name} {error.problem}"


def _refuse_nothing(folder: Path, attempt: Attempt, doubts: Sequence[Doubt]) -> None:
    """Refuse a result without any joint; the message gives the counts by status, and the likely mistake."""
    status = attempt.result.status
    if (status == STATUS.index("ok")).any():
        return
    codes, counts = np.unique(status, return_counts=True)
    gates = ", ".join(f"{STATUS[code]} {count}" for code, count in zip(codes, counts, strict=True))
    reasons = [*attempt.association.reasons, *(doubt.what for doubt in doubts[:1] if doubt.remedy)]
    remedies = [doubt.remedy for doubt in doubts[:1] if doubt.remedy]
    raise DataError(
        folder,
        "; ".join([f"no joint could be reconstructed ({gates}; {noise_text(attempt.views)})", *reasons]),
        *(remedies or ["check calibration, clocks and poses, or state another pose noise with --pose-noise"]),
        code="nothing-reconstructed",
    )
