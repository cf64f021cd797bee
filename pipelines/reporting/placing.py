"""Poses of the cameras of a session: refined if a reconstruction did that, else as logged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pipelines.geometry.arrays import Float
from pipelines.reporting.content import SessionContent, number, section
from pipelines.reporting.summary import Summary
from pipelines.session.camera_poses import poses_at
from pipelines.session.records import Int64
from pipelines.session.tables import trajectory_from


def estimated_clocks(metrics: Mapping[str, object]) -> dict[str, int]:
    """Read the estimated clock offsets, ns: the amounts to add to the cameras' ingested frame times.

    Args:
        metrics: reconstruct/metrics.json.
    """
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


def camera_positions(content: SessionContent, summary: Summary, t_ns: Int64) -> Float:
    """Interpolate positions [C, T, 3] m of the cameras that have poses; NaN at times without one."""
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
