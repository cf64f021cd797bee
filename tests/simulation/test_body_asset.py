from pathlib import Path

import numpy as np

from pipelines.geometry import body_model
from pipelines.geometry.body_model import PARTS

ASSET = Path(body_model.__file__).parent / "data" / "body.npz"


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
