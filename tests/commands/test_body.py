"""Bodies through the commands: a simulated person whose shape and surface are known, and the export."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import trimesh

from pipelines.geometry.rig import BONES
from tests.commands.runner import succeeds
from tests.commands.test_simulate import simulated

WALKS = """
schema: 1
name: Body
duration_s: 3
actor: {body: {sex: female, height_m: 1.62}, motion: [walk: {distance_m: 4}]}
world: {ground: {size_m: 30}, map: {resolution_m: 0.5, height_m: 4}}
drones:
  count: 3
  camera: {rate_hz: 10, shutters: synchronised}
keypoints: {scale: 0.5, missed_share: 0, outlier_share: 0, swap_share: 0}
"""


def test_a_simulated_person_gets_her_body(tmp_path: Path) -> None:
    session = tmp_path / "body.session"
    succeeds("ingest", simulated(tmp_path, WALKS, "--no-video"), "-o", session)
    succeeds("reconstruct", session, "--method", "robust")
    figures = json.loads((session / "reconstruct" / "metrics.json").read_text())["body"]["person0"]
    # Three of the standard deviations that are stated.
    assert abs(figures["stature_m"] - 1.62) < 3 * figures["stature_sigma_m"] < 0.08
    # Hands and feet have no landmarks among COCO's 17, and hang as they usually do.
    assert figures["root_mpvpe_mm"] < 60
    assert figures["root_centres_mm"] < 50
    bodies = pd.read_parquet(session / "reconstruct" / "body.parquet")
    true = pd.read_parquet(session / "truth_body.parquet")
    both = bodies.merge(true, on=["t_ns", "person", "bone"], suffixes=("", "_true"))
    assert len(both) == len(bodies) == len(BONES) * bodies["t_ns"].nunique()
    knees = both[both["bone"].isin(["left_shank", "right_shank"])]
    away = knees[["x", "y", "z"]].to_numpy() - knees[["x_true", "y_true", "z_true"]].to_numpy()
    assert np.linalg.norm(away, axis=1).mean() < 0.05

    succeeds("export", session, "--to", "mesh", "-o", tmp_path / "out")
    (path,) = (tmp_path / "out").glob("*.glb")
    assert len(trimesh.load_scene(path).geometry) == 1
