"""Where the cameras of a session were: as refined where a reconstruction did, else as logged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipelines.reporting.content import SessionContent, number, section
from pipelines.reporting.summary import Summary
from pipelines.session.camera_poses import poses_at
from pipelines.session.records import Float, Int64
from pipelines.session.tabular import trajectory_from


def estimated_clocks(metrics: Mapping[str, object]) -> dict[str, int]:
    """How much later than ingested the frames of a camera are, ns, by what a reconstruction estimated.

    Args:
        metrics: reconstruct/metrics.json.
    """
    offsets = section(metrics, "clock_offsets_s")
    return {name: round((number(offsets, name) or 0.0) * 1e9) for name in offsets}


def as_reconstructed(content: SessionContent) -> SessionContent:
    """The session with the poses and the clocks that its skeleton was measured with.

    Refined poses take the place of the logged ones, and frames come at the times of the clocks that were
    estimated: only so are residuals those of the reconstruction.
    """
    offset_ns = estimated_clocks(content.metrics or {})
    frames = {
        name: table.assign(t_ns=table["t_ns"] + offset_ns.get(name, 0))
        for name, table in content.frames.items()
    }
    return replace(content, poses=content.poses | content.refined, frames=frames)


def camera_positions(content: SessionContent, summary: Summary, t_ns: Int64) -> Float:
    """[C, T, 3] m of the cameras that have poses; NaN at times without one."""
    between = summary.description.pose_interpolation
    poses = content.poses | content.refined
    positions = []
    for camera in summary.cameras:
        if camera.name not in poses:
            continue
        track = trajectory_from(poses[camera.name])
        position, _ = poses_at(track, t_ns, between, static=camera.entry.poses.static)
        positions.append(position)
    return np.stack(positions) if positions else np.full((1, len(t_ns), 3), np.nan)
