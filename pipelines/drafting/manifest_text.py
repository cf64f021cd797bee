"""Text of a drafted flight.yaml: what was found, with comments on what only the user can know."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from pipelines.drafting.camera_text import CameraText, Remarks, flowing, spanned, stated, told
from pipelines.drafting.found import Found, Joints, Recording, Span
from pipelines.drafting.matching import Draft
from pipelines.drafting.yaml_text import commented, entry, one_line, scalar
from pipelines.session.manifest import SCHEMA

_HEAD = """\
# A flight for `mocap ingest`, drafted by `mocap init` from what the files say.
# What is marked "assumed" or "missing" they do not say: only you can know it."""
_NO_CAMERA = """
# cameras:  # missing: one for each drone, with its video or keypoints, poses and intrinsics
#   drone1:
#     video: drone1.mp4
#     pose: {tum: drone1.tum}
#     intrinsics: drone1.yaml"""
_ABOUT_LOGS = """\
  # With stamps: receive the time of receipt counts. Where a clock or an origin is another:
  #   clock: {offset_s: 0, drift_ppm: 0}, world_from_log: {translation: [0, 0, 0], yaw_deg: 0}"""
_NAMES_TOLD = 5


@dataclass(frozen=True)
class ManifestText:
    """The manifest, with short versions of its comments."""

    text: str
    missing: list[str]  # the flight cannot be ingested without it
    assumed: list[str]  # the flight can be ingested, but results depend on it


def write_manifest(draft: Draft, name: str, relative: Callable[[Path], str]) -> ManifestText:
    """Write the whole manifest of a draft.

    Args:
        draft: the flight with its cameras and sources.
        name: of the flight.
        relative: converts a path to the form in the manifest.
    """
    remarks = Remarks()
    lines = [
        _HEAD,
        entry("schema", SCHEMA),
        entry("name", name),
        entry("world", {"frame": "enu"}, "assumed: the poses have z up (x east, y north); or ned"),
        *_origin(draft),
        *_logs(draft, relative, remarks),
        *_cameras(draft, relative, remarks),
        *_actor(draft, relative, remarks),
        *_map(draft, relative),
        *_truth(draft, relative),
        *_unused(draft, relative),
    ]
    return ManifestText("\n".join(lines) + "\n", _in_short(remarks.missing), _in_short(remarks.assumed))


def _in_short(remarks: Mapping[str, list[str]]) -> list[str]:
    """Write one line for each remark, with the cameras that it concerns."""
    lines = []
    for what, names in remarks.items():
        shown = ", ".join(names[:_NAMES_TOLD]) + (", ..." if len(names) > _NAMES_TOLD else "")
        lines.append(f"{shown}: {what}" if shown else what)
    return lines


def _origin(draft: Draft) -> list[str]:
    """Write a comment on the world's origin, for positions on Earth."""
    if not any(camera.poses and camera.poses.taken.by_gps for camera in draft.cameras):
        return []
    return ["#   origin: {latitude_deg: 0, longitude_deg: 0, altitude_m: 0}  # else the first position's"]


def _logs(draft: Draft, relative: Callable[[Path], str], remarks: Remarks) -> list[str]:
    """Write every log that the rest of the manifest names."""
    if not draft.logs:
        return []
    lines = ["", "logs:"]
    for name, log in draft.logs.items():
        paths = [relative(path) for path in log.parts]
        settings = {"path": paths[0] if len(paths) == 1 else paths, "stamps": "header"}
        spans = [topic.span for topic in log.topics if topic.count]
        whole = Span(min(s.first_ns for s in spans), max(s.last_ns for s in spans))
        lines.append("  " + entry(name, settings, f"{log.title}, {spanned(whole)}"))
    taken = [camera.poses.taken.settings for camera in draft.cameras if camera.poses]
    if len({str(settings["log"]) for settings in taken if "log" in settings}) > 1:
        remarks.assumed["logs: one clock and one origin for all; else say clock and world_from_log"] = []
    return [*lines, _ABOUT_LOGS]


def _cameras(draft: Draft, relative: Callable[[Path], str], remarks: Remarks) -> list[str]:
    if not draft.cameras:
        remarks.missing["cameras: nothing was found that has pictures, keypoints or poses of a drone"] = []
        return [_NO_CAMERA]
    lines = ["", "cameras:"]
    for camera in draft.cameras:
        lines.append(f"  {scalar(camera.name)}:")
        lines += [f"    {line}" for line in CameraText(camera, draft, relative, remarks).lines()]
    return lines


def _actor(draft: Draft, relative: Callable[[Path], str], remarks: Remarks) -> list[str]:
    """Write the source of the person's logged positions."""
    if not draft.actors:
        return []
    taken, *others = draft.actors
    remarks.assumed["actor: point hip, which point of the person the log follows"] = []
    remark = f"{told(taken)}; assumed: point, one of hip, head, feet, centre"
    lines = ["", entry("actor", stated({**taken.settings, "point": "hip"}, relative), remark)]
    return lines + [f"# or actor: {flowing(other.settings, relative)}" for other in others]


def _map(draft: Draft, relative: Callable[[Path], str]) -> list[str]:
    """Write the maps: the first one, and the others as comments."""
    lines = [entry("map", relative(found.path), found.title) for found in draft.maps]
    return ["", *lines[:1], *(f"# or {line}" for line in lines[1:])] if lines else []


def _truth(draft: Draft, relative: Callable[[Path], str]) -> list[str]:
    """Write the truth; joints only if they overlap with poses in time, because ingest refuses others."""
    known: dict[str, object] = {}
    lines: list[str] = []
    spans = [camera.poses.taken.span for camera in draft.cameras if camera.poses]
    logged = [span for span in spans if span]
    for joints in draft.true_joints:
        meets = not logged or any(joints.span.overlap_ns(span) >= 0 for span in logged)
        if meets and "joints" not in known:
            known["joints"] = relative(joints.path)
            continue
        why = "" if meets else ", when there are no poses"
        lines.append(
            commented(
                f"# or truth: {{joints: {scalar(relative(joints.path))}}}",
                f"{joints.title}, {spanned(joints.span)}{why}",
            )
        )
    poses = {c.name: next(iter(c.true_poses.taken.settings.values())) for c in draft.cameras if c.true_poses}
    if poses:
        known["poses"] = poses
    if known:
        remark = "metres, z up; where it is not so: joints: {path, unit, axes}" if "joints" in known else ""
        lines.insert(0, entry("truth", stated(known, relative), remark))
    return ["", *lines] if lines else []


def _unused(draft: Draft, relative: Callable[[Path], str]) -> list[str]:
    """Write comments on files that were recognised but are not used."""
    if not draft.unused:
        return []
    lines = ["", "# Recognised, but not used:"]
    for found in draft.unused:
        hint = "; if known to be true: truth: {joints: FILE}" if isinstance(found, Joints) else ""
        lines.append(f"#   {scalar(relative(found.path))}  ({one_line(found.title)}{hint or _held(found)})")
    return lines


def _held(found: Found) -> str:
    """List the topics of an unused log, which the user could still name."""
    topics = [topic.name for topic in found.topics if topic.count] if isinstance(found, Recording) else []
    return f" with {one_line(', '.join(topics[:_NAMES_TOLD]))}" if topics else ""
