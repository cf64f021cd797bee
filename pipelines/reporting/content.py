"""Contents of a page, as the stage loads it from a session, and readers of loose JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from pipelines.geometry.arrays import Float, Int64
from pipelines.session.description import Description
from pipelines.session.records import Occupancy

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ReplanContent:
    """Stored results of a comparison of planners."""

    metrics: dict[str, object]  # replan/metrics.json
    arms: dict[str, pd.DataFrame]  # arm: tables.REPLAN
    actor: pd.DataFrame  # tables.ACTOR at the same times: the reference of the arms' scores
    cost_map: pd.DataFrame | None = None  # tables.COST_MAP
    map: Occupancy | None = None  # the session's last map
    seen: dict[str, pd.DataFrame] = field(default_factory=dict)  # arm: tables.SEEN, where a skeleton is known


@dataclass(frozen=True)
class StudyContent:
    """Results of `mocap study` in a folder."""

    metrics: dict[str, Any]  # its metrics.json
    command: str  # that makes it again
    digest: str  # SHA-256 of that file


@dataclass(frozen=True)
class SessionContent:
    """Contents of one session's page; a part that the session lacks is None or empty."""

    name: str
    session: Description
    skeleton: pd.DataFrame | None  # tables.SKELETON
    metrics: dict[str, object] | None  # reconstruct/metrics.json
    truth: pd.DataFrame | None  # tables.TRUTH
    poses: dict[str, pd.DataFrame]  # camera: tables.POSES
    frames: dict[str, pd.DataFrame]  # camera: tables.FRAMES
    keypoints: dict[str, pd.DataFrame]  # camera: tables.KEYPOINTS, of cameras that have any
    stages: dict[str, dict[str, object]]  # stage: its stage.json
    replan: ReplanContent | None = None
    refined: dict[str, pd.DataFrame] = field(default_factory=dict)  # camera: tables.POSES, where refined
    true_poses: dict[str, pd.DataFrame] = field(default_factory=dict)  # camera: tables.POSES, where known
    hidden: dict[str, float] = field(default_factory=dict)  # camera: share of moments, where a map is
    made_by: dict[str, dict[str, str]] = field(default_factory=dict)  # stage: program or library, and version
    outdated: tuple[str, ...] = ()  # stages whose inputs have changed since
    angles: pd.DataFrame | None = None  # tables.ANGLES, where the reconstruction has them
    joint_errors: pd.DataFrame | None = None  # tables.JOINT_ERRORS, likewise
    studies: tuple[StudyContent, ...] = ()  # that stand beside the flight
    every: int = 1  # times of the skeleton of which one was loaded, with what was recorded about it


FULL_SCALE = 10_000
"""Joints are stored as this part of a picture's side."""


@dataclass(frozen=True)
class Strip:
    """Pictures of one camera."""

    camera: str
    t_ns: Int64  # [N]
    pictures: tuple[str, ...]  # [N] WebP in base64
    joints: Float  # [N, P, K, 2] part of the picture's side from its upper left corner; NaN if missing


def section(mapping: Mapping[str, object], key: str) -> dict[str, object]:
    """Return the mapping under a key; empty when it is absent or something else."""
    value = mapping.get(key)
    return {str(k): v for k, v in value.items()} if isinstance(value, Mapping) else {}


def items(mapping: Mapping[str, object], key: str) -> list[object]:
    """Return the list under a key; empty when it is absent or something else."""
    value = mapping.get(key)
    return list(value) if isinstance(value, list | tuple) else []


def number(mapping: Mapping[str, object], key: str) -> float | None:
    """Return the number under a key; None when it is absent, null or something else."""
    value = mapping.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def text(mapping: Mapping[str, object], key: str) -> str:
    """Return the text under a key; empty when it is absent or something else."""
    value = mapping.get(key)
    return value if isinstance(value, str) else ""


def estimated_clocks(metrics: Mapping[str, object]) -> dict[str, int]:
    """Read the clock offsets, ns, of reconstruct/metrics.json: what to add to the ingested frame times."""
    offsets = section(metrics, "clock_offsets_s")
    return {name: round((number(offsets, name) or 0.0) * 1e9) for name in offsets}


def as_reconstructed(content: SessionContent) -> SessionContent:
    """Return the session with the poses and the clocks that its skeleton was measured with.

    Refined poses replace the logged ones, and frames have the times of the estimated clocks. Only then are
    residuals those of the reconstruction.
    """
    offset_ns = estimated_clocks(content.metrics or {})
    frames = {
        name: table.assign(t_ns=table["t_ns"] + offset_ns.get(name, 0))
        for name, table in content.frames.items()
    }
    return replace(content, poses=content.poses | content.refined, frames=frames)
