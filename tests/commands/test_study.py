"""Studies: exact data give no error, errors have the size that geometry predicts, and sessions are ranked."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from mocap_cli.main import Mocap
from mocap_cli.study import study_command
from pipelines import study as stage
from pipelines.planning.scene import OtherWalk, load_flight, walked_otherwise
from pipelines.replan import fly_and_measure
from pipelines.session.description import read_description
from pipelines.session.errors import DataError
from pipelines.session.maps import load_maps
from pipelines.simulation.walks import RANGE_M
from pipelines.study import Studied, study
from tests.commands.runner import content
from tests.commands.test_replan import CALM, session_of

TRUSTING = "method=dlt,midpoint,robust"  # auto takes longer than all of them
SMALL = ("seconds=4", "rate_hz=5", "trials=2", "method=dlt,robust")

Cells = dict[tuple[float, int, str, str], dict[str, Any]]


def run(*arguments: str | Path) -> Result:
    """Run the command in this process, in its group."""
    return CliRunner().invoke(Mocap("mocap", commands=[study_command]), ["study", *map(str, arguments)])


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figure of a study, which takes longer than these small studies."""
    monkeypatch.setattr(stage, "draw", lambda *_: None)


def cells_of(studied: Studied) -> Cells:
    cells = studied.metrics["cells"]
    return {(cell["tilt_deg"], cell["robots"], cell["noise"], cell["method"]): cell for cell in cells}


def covariance_trace(cameras: int, tilt_deg: float) -> float:
    """Compute the trace of a point's covariance in units of one ray's variance, which is across the ray."""
    yaw = (np.pi / 2 if cameras == 2 else 2 * np.pi / cameras) * np.arange(cameras)
    tilt = np.radians(tilt_deg)
    ray = np.stack([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.full(cameras, np.sin(tilt))])
    return float(np.trace(np.linalg.inv(cameras * np.eye(3) - ray @ ray.T)))


@pytest.mark.usefixtures("undrawn")
def test_exact_keypoints_and_poses_give_nothing(tmp_path: Path) -> None:
    """Allow rounding errors only: 1e-16 of 30 m, times a thousand for the conditioning of two rays."""
    words = ["tilt_deg=0:60:30", "keypoints=exact", "noise=none", TRUSTING, *SMALL[:3]]
    made = study(words, None, tmp_path / "out")
    assert made.metrics["keypoints"] == "exact"
    cells = cells_of(made)
    assert {cell[0] for cell in cells} == {0, 30, 60}
    for cell in cells.values():
        assert cell["metrics"]["mpjpe_mm"]["mean"] < 1e-6
        assert cell["metrics"]["mpjpe_mm"]["interval"] is None  # no chance, no interval
        assert cell["metrics"]["reconstructed_share"]["mean"] == 1
        assert cell["ratio"] is None  # a ratio of rounding errors means nothing


@pytest.mark.usefixtures("undrawn")
def test_errors_of_poses_have_the_size_and_shape_of_the_geometry(tmp_path: Path) -> None:
    """Expect RMS = s sqrt(trace), s^2 = (range sigma_rot)^2 + sigma_pos^2, for small white pose noise.

    Keypoints are exact. All joints of a frame share its errors, so there are as many independent draws as
    frames and trials: 8 s x 10 Hz x 3 = 240, each with about 2 effective degrees of freedom. The RMS of them
    scatters by 1 / sqrt(2 x 2 x 240) = 3.2 %. The tolerance is three times that, plus 1 % for joints up to
    1 m off the middle of the ring (the mean of (distance / 10 m)^2).
    """
    noise = "white:position_m=0.02,rotation_deg=0.1"
    words = ["tilt_deg=0,45", "robots=2,4", f"noise={noise}", "keypoints=exact", "method=dlt,robust"]
    made = study([*words, "seconds=8", "rate_hz=10", "trials=3"], None, tmp_path / "out")
    ray_m = np.hypot(0.02, RANGE_M * np.radians(0.1))
    assert len(cells_of(made)) == 8
    for (tilt, robots, _, _), cell in cells_of(made).items():
        rms = np.sqrt(cell["metrics"]["e_recon_per_joint_frame_m2"]["mean"])
        assert rms == pytest.approx(ray_m * np.sqrt(covariance_trace(robots, tilt)), rel=0.106)


@pytest.mark.usefixtures("undrawn")
def test_auto_halves_white_errors_where_all_methods_have_a_point(tmp_path: Path) -> None:
    """Expect half the error: white errors are new in every picture, so n pictures reduce them by sqrt(n).

    A step of the walk takes half a second, 8 pictures at 15 Hz. So a third of the error would remain, and a
    half is allowed.
    """
    noise = "white:position_m=0.3,rotation_deg=1"
    words = [
        "robots=3",
        f"noise={noise}",
        *SMALL[:1],
        "rate_hz=15",
        "trials=1",
        "method=midpoint,robust,auto",
    ]
    cells = cells_of(study(words, None, tmp_path / "out"))
    linear, robust, auto = (cells[15, 3, noise, each]["metrics"] for each in ("midpoint", "robust", "auto"))
    assert auto["fell_back"]["mean"] == 0
    assert auto["mpjpe_mm"]["mean"] < 0.5 * robust["mpjpe_mm"]["mean"]
    assert auto["reconstructed_share"]["mean"] > 0.95
    assert linear["common_share"] == robust["common_share"]
    with (tmp_path / "out" / "table.csv").open(newline="") as file:
        assert [float(row["mpjpe_mm"]) for row in csv.DictReader(file)] == pytest.approx(
            [each["mpjpe_mm"]["mean"] for each in (linear, robust, auto)]
        )


def test_workers_do_not_matter_and_a_study_that_is_there_is_not_made_again(tmp_path: Path) -> None:
    made = []
    for workers in ("1", "2"):
        done = run("robots=2,3", "noise=none,low", *SMALL, "--workers", workers, "-o", tmp_path / workers)
        assert done.exit_code == 0, (done.output, done.exception)
        made.append((done.stdout.replace(str(tmp_path / workers), ""), content(tmp_path / workers)))
    assert made[0] == made[1]
    figures = {"figure.svg", "figure.png", "figure.pdf"}
    assert set(made[0][1]) == {"study.json", "metrics.json", "table.csv", *figures}
    again = run("noise=none,low", "robots=2,3", *SMALL, "-o", tmp_path / "2", "-q")
    assert again.stdout == f"unchanged: {tmp_path / '2'}\n"


@pytest.mark.usefixtures("undrawn")
def test_what_an_interrupted_study_finished_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["tilt_deg=0,15,30", "noise=low", *SMALL]
    measured: list[float] = []
    measure = stage._measure_condition

    def counted(*of: Any) -> None:
        measured.append(of[2].tilt_deg)
        if len(measured) == 3:
            raise KeyboardInterrupt
        measure(*of)

    monkeypatch.setattr(stage, "_measure_condition", counted)
    assert run(*words, "-o", tmp_path / "out", "--workers", "1").exit_code == 130
    assert not (tmp_path / "out").exists()
    study(words, None, tmp_path / "out")
    assert measured == [0, 15, 30, 30]
    study(words, None, tmp_path / "whole")
    assert content(tmp_path / "out") == content(tmp_path / "whole")
    # Nothing else is left beside the two.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]


@pytest.mark.parametrize(
    ("word", "code"),
    [
        ("noise=low,awful", None),
        ("noise=pink:position_m=1", None),
        ("noise=low,low", "stated-twice"),
        ("method=magic", "no-such-name"),
        ("method=dlt,dlt", "stated-twice"),
        ("tilt_deg=0,x", "bad-value"),
        ("tilt_deg=nan", "bad-value"),
        ("tilt_deg=89", "bad-value"),
        ("tilt_deg=10:0:5", "bad-value"),
        ("robots=1", "bad-value"),
        ("robots=", "bad-value"),
        ("seconds=1,2", "bad-value"),
        ("seconds=0.1", "bad-value"),
        ("keypoints=guessed", "no-such-name"),
        ("detector=nobody", "no-such-name"),
        ("radius=8", "no-such-name"),
    ],
)
def test_wrong_values_are_refused_before_anything_is_made(
    tmp_path: Path, word: str, code: str | None
) -> None:
    with pytest.raises(DataError) as refused:
        study([word], None, tmp_path / "out")
    assert code in (None, refused.value.code)
    assert not list(tmp_path.iterdir())


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text("{}")
    with pytest.raises(DataError) as refused:
        study(["tilt_deg=0", *SMALL], None, tmp_path)
    assert refused.value.code == "exists"
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]
    assert run("scenario.yaml", "-o", tmp_path / "out").exit_code == 2
    assert run("tilt_deg=0", "a.yaml", "b.yaml", "-o", tmp_path / "out").exit_code == 2


# --- sessions ------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    noisy = CALM + "  pose_noise: {white: {position_m: 0.02, rotation_deg: 0.5}}\n"
    return session_of(tmp_path_factory.mktemp("calm"), noisy)


def test_an_interrupted_study_of_a_session_goes_on_and_ranks_what_is_known(
    calm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of attitude grow with range, and three views are better than two; a way has its drones."""
    flown: list[str] = []

    def flying(*arguments: object) -> None:
        if len(flown) == 3:
            raise KeyboardInterrupt
        fly_and_measure(*arguments)  # type: ignore[arg-type]
        flown.append(str(arguments[-1]))

    monkeypatch.setattr(stage, "fly_and_measure", flying)
    grid = ("range_m=8,12", "robots=2,3", "trials=4", calm, "-o", tmp_path / "out")
    assert run(*grid).exit_code == 130
    assert not (tmp_path / "out").exists()
    flown[:] = [""]  # three more are allowed: one is left
    done = run(*grid, "--json")
    assert done.exit_code == 0, done.stderr
    assert len(flown) == 2
    metrics = json.loads(done.stdout)
    cells = {(cell["range_m"], cell["robots"]): cell for cell in metrics["cells"]}
    assert list(cells) == [(8, 2), (8, 3), (12, 2), (12, 3)]
    error = {name: cell["capped_mm"] for name, cell in cells.items()}
    assert error[8, 3] < min(error[8, 2], error[12, 3])
    assert error[12, 2] > max(error[8, 2], error[12, 3])
    assert [name for name, cell in cells.items() if cell["best"]] == [(8, 3)]
    assert cells[8, 3]["tradeoff"]
    assert cells[8, 3]["path_m"] > 1.2 * cells[8, 2]["path_m"]
    with (tmp_path / "out" / "table.csv").open(encoding="utf-8") as file:
        assert [float(row["capped_mm"]) for row in csv.DictReader(file)] == list(error.values())
    again = run(*grid)
    assert "unchanged" in again.output
    assert again.output.splitlines()[-1].startswith("next: mocap ")
    assert "trade-off" in again.output
    assert max(map(len, again.output.split("\nleast error")[0].splitlines())) <= 100


def test_a_verdict_says_in_how_many_other_walks_it_holds(calm: Path, tmp_path: Path) -> None:
    """Of two drones from 8 m and from 40 m, the near ones measure better whoever walks how."""
    grid = ("range_m=8,40", "actor=3", "trials=4", calm)
    done = run(*grid, "-o", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.stderr
    metrics = json.loads(done.stdout)
    (best,) = metrics["best"]
    assert (metrics["walks"], len(metrics["cells"]), best["cell"]) == (3, 2, 0)
    assert best["walks"][1] == {"better": 3, "worse": 0, "walks": 3}
    assert "3 of 3" in metrics["verdict"]
    near = metrics["cells"][0]
    assert all(near[f"{name}_low"] < near[name] < near[f"{name}_high"] for name in ("mpjpe_mm", "pck150"))
    with (tmp_path / "out" / "table.csv").open(encoding="utf-8") as file:
        paths = {row["actor"]: row["path_m"] for row in csv.DictReader(file) if float(row["range_m"]) == 8}
    assert len(set(paths.values())) == 3


def test_a_walk_is_varied_as_stated(calm: Path) -> None:
    flight = load_flight(calm, read_description(calm), None, pose_noise=None)
    walk = OtherWalk(speed=0.5, delay_s=2.0, turn_deg=90.0)
    other = walked_otherwise(flight, walk, load_maps(calm))
    seconds = [float(np.ptp(each.actor_t_ns)) / 1e9 for each in (flight, other)]
    assert seconds[1] == pytest.approx(2 * seconds[0] + 2.0, abs=0.2)
    assert other.skeleton is not None
    hips = other.skeleton.position[:, 0].mean(axis=1)
    start, middle, end = hips[0], hips[len(hips) // 2], hips[-1]
    away = [np.arctan2(*(b - a)[1::-1]) for a, b in ((start, middle), (middle, end))]
    assert np.degrees(away[1] - away[0]) == pytest.approx(90.0, abs=5.0)  # the truth sways
    stands = slice(len(hips) // 2 - 20, len(hips) // 2 + 20)
    assert np.ptp(hips[stands], axis=0) == pytest.approx(np.zeros(3), abs=1e-9)


def test_wrong_values_over_a_session_are_refused(calm: Path, tmp_path: Path) -> None:
    many = f"range_m={','.join(str(k) for k in range(1, 252))}"
    for words in (["arm=flown"], [many, "robots=2,3"], ["range_m=8,x"], ["w_nothing=3"], ["actor=lazy:1"]):
        with pytest.raises(DataError):
            study(words, calm, tmp_path / "out")
    assert not list(tmp_path.iterdir())
