"""Export to OpenSim itself: a model scaled to the person, and the angles of its inverse kinematics.

The model, its markers for each skeleton and their weights are those of Pose2Sim 0.10.49 (BSD-3-Clause; Pagnon
et al. 2022, "Pose2Sim: an open-source Python package for multiview markerless kinematics", JOSS 7:4362),
fetched like the files of a detector. OpenSim (Seth et al. 2018) scales and solves; it is imported when it is
used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.formats.common.exporting import file_names_of_people, people_of, safe_file_name
from pipelines.formats.common.rows import format_seconds
from pipelines.formats.skeletons.joint_files import marker_name, to_y_up
from pipelines.geometry.arrays import Bool, Float, Int64
from pipelines.geometry.joint_angles import ANGLES
from pipelines.session.errors import DataError
from pipelines.session.model_files import ModelFile, PackagedModels, Wheel
from pipelines.session.people import SKELETONS
from pipelines.session.records import JointMotion, Recording
from pipelines.session.registries import need

if TYPE_CHECKING:
    import pandas as pd

_SETUP = "Pose2Sim/OpenSim_Setup/"
_LICENCE = "pose2sim-0.10.49.dist-info/licenses/LICENSE"
_MODEL = "Model_Pose2Sim_simple.osim"
_SET_OF = {
    "blazepose33": ("BlazePose", "Blazepose"),
    "body25": ("Body25", "Body25"),
    "body25b": ("Body25b", "Body25b"),
    "coco17": ("Coco17", "Coco17"),
    "halpe26": ("Halpe26", "Halpe26"),
}
"""Pose2Sim's names of the marker set, and of the settings, of our skeletons."""

# SHA-256, size in bytes and name of each file; all but the licence lie in the folder of the set-up.
_FILES = """
7f8a9ede713463b96d261a39c3ec404748c8e4f528c795e5f8cb18898ed944cf 1521 LICENSE
0b25e3efb09f1a6e8c35dbc9a90afe7248895cc74263e3f4f0dbd29519034707 270672 Model_Pose2Sim_simple.osim
0de8eb64eaa25683caa4d6a9ddf1430009e56233faa4faad91e65b49cf2578a0 15482 Markers_BlazePose.xml
1ea233cbb29ff8dc32e7ffe7d56c631dc291386e0cd65c9ecf46294b959cfc37 14393 Markers_Body25.xml
23f28b33dcb7fd0ad1fd1b28ceef7256eb84a3dc0599be591384773431e92acb 14357 Markers_Body25b.xml
81c2aa3fbf9b717de4d3612d8e0f910e0822086fba6e340075c694f809fbb96e 9619 Markers_Coco17.xml
8261886fcc028f60736a80e3aad80c81a83cb30c234823b46b9ae395363df3e2 14805 Markers_Halpe26.xml
a2ef85eca690d04697d3f328fda9c1cb9d978c750080de458d97d8a15b682e85 24135 Scaling_Setup_Pose2Sim_Blazepose.xml
8f3d332a06e132180e622dad9521518c23d064a643cf9c1ebdb1d6376455f357 30498 Scaling_Setup_Pose2Sim_Body25.xml
315ef2e64b2b6afea0701120d562c2e39f7d83e198acbd5d5dab2de1f619a8fe 30754 Scaling_Setup_Pose2Sim_Body25b.xml
999338029c24d7b22d76e9265e2a04e5a7f7a9849ba534da53cdae62ce114075 26122 Scaling_Setup_Pose2Sim_Coco17.xml
cdabbae2e8346ffd942b30bd588e0e0f8341c8d4d9a55f8bb9b70e1c5c3fb2de 31481 Scaling_Setup_Pose2Sim_Halpe26.xml
2ca03a9c9add43e83eda3f62cd6f749e06d271f9e6351a343e6f3cc94e3ac314 10952 IK_Setup_Pose2Sim_Blazepose.xml
3434fc69f0e874fdad50f69ae54ca43933f9b46196f73bac58f9e1cb542b0f1a 9734 IK_Setup_Pose2Sim_Body25.xml
a3621365a4d030fde68c2ff7fb02c955871919f4971a76877f570f016b9513ee 9754 IK_Setup_Pose2Sim_Body25b.xml
b8f0ac9155cc38d4726ce562cef1c635405e73f23e6f8994a6a7c0ef0410d31c 7661 IK_Setup_Pose2Sim_Coco17.xml
8dda7dce47fbde0c268cd1052213a0013b1240873d9e334dbf0a8515b3ed3769 9939 IK_Setup_Pose2Sim_Halpe26.xml
"""

MODELS = PackagedModels(
    detector="osim",
    package=Wheel("pose2sim", "0.10.49", tags=("3.11", "cp311", "manylinux_2_28_x86_64")),
    files=tuple(
        ModelFile(_LICENCE if name == "LICENSE" else f"{_SETUP}{name}", int(size), sha256)
        for sha256, size, name in map(str.split, _FILES.strip().splitlines())
    ),
)

# Fewer markers in a frame leave limbs of the model where they were.
_LEAST_MARKERS = 8
_WEIGHTS = (
    0.01,
    100.0,
)  # of a marker by its covariance, against the median marker: no marker is all or nothing
# Pose2Sim solves to this accuracy, too.
_ACCURACY = 1e-5
_ARMS = tuple(f"{name}_{side}" for side in "rl" for name in ("arm_flex", "arm_add", "arm_rot", "elbow_flex"))
# Elbows begin bent by this angle (rad), because a straight one cannot choose its side.
_FIRST_BEND = 0.6
# More bend (rad) of one elbow must not make up for a straight other one.
_BENT_ENOUGH = 1.0


@dataclass(frozen=True)
class Kinematics:
    """Result of inverse kinematics: C coordinates of the model at T times."""

    t_ns: Int64  # [T] times with enough markers
    coordinates: tuple[str, ...]
    value: Float  # [T, C] deg or m
    error_m: Float  # [T, M] distance of each marker from the model's, NaN where it was not measured


class OpenSimExport:
    """Writer of `<name>.osim`, `<name>_ik.mot` and `<name>_ik_marker_errors.sto` (`_<person>` of several).

    Each body of the model is scaled by the median lengths of the person's bones, both sides alike. Mass and
    its distribution stay the model's: nothing measures them. A marker weighs at every time as in Pose2Sim's
    settings, times the inverse of its variance over that of the median marker.
    """

    name = "osim"
    title = "scaled model and inverse kinematics by OpenSim (extra opensim)"
    choices: Mapping[str, tuple[str, ...]] = {"unit": ("m",), "axes": ("y-up",), "time": ("zero", "epoch")}

    def models(self) -> dict[str, Path | None]:
        """List the files of Pose2Sim's model; see `registries.FetchesModels`."""
        return MODELS.present()

    def fetch(self, source: Path | None = None) -> None:
        """Get missing files of Pose2Sim's model; see `registries.FetchesModels`."""
        MODELS.fetch(source)

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write every person with at least one known joint."""
        motion, files = people_of(recording, folder, ".osim")
        library = _opensim()
        markers, settings = _set_of(motion)
        paths = MODELS.verified()
        written = []
        for person, path in files.items():
            model = library.Model(str(paths[_MODEL]))
            model.set_MarkerSet(library.MarkerSet(str(paths[f"Markers_{markers}.xml"])))
            scaling = library.ScaleTool(str(paths[f"Scaling_Setup_Pose2Sim_{settings}.xml"]))
            unscaled = scale_model(library, model, scaling, motion, person)
            if unscaled:
                recording.progress.note(
                    f"osim: {', '.join(unscaled)} could not be measured, and keep their size"
                )
            model.setName(path.stem)
            model.printToXML(str(path))
            # Objects of OpenSim are kept by name: their parts do not keep them alive.
            tool = library.InverseKinematicsTool(str(paths[f"IK_Setup_Pose2Sim_{settings}.xml"]), False)
            tasks = tool.getIKTaskSet()
            weights = {tasks.get(k).getName(): tasks.get(k).getWeight() for k in range(tasks.getSize())}
            found = solve(library, model, weights, motion, person)
            if not len(found.t_ns):
                raise DataError(recording.name, "has too few joints for OpenSim", "look at the report")
            if left := len(motion.t_ns) - len(found.t_ns):
                recording.progress.note(
                    f"osim: {left} times have fewer than {_LEAST_MARKERS} markers; left out"
                )
            written += [path, *_written(path, found, recording.zero_ns)]
            rms = 1e3 * float(np.sqrt(np.nanmean(found.error_m**2)))
            recording.progress.note(f"osim: markers of {path.stem} are {rms:.1f} mm (RMS) off the model's")
        return sorted(written)


def _opensim() -> Any:
    """Import OpenSim; keep it from writing opensim.log into the working folder, and from printing."""
    library = need("opensim", "opensim")
    library.Logger.removeFileSink()
    library.Logger.setLevelString("error")
    return library


def _set_of(motion: JointMotion) -> tuple[str, str]:
    """Return Pose2Sim's names for the skeleton that has these joints."""
    for name, names in _SET_OF.items():
        if set(SKELETONS[name].joints) == set(motion.joints):
            return names
    problem = f"has no markers for a skeleton of {len(motion.joints)} joints"
    raise DataError("osim", problem, f"there are {', '.join(_SET_OF)}")


def scale_model(library: Any, model: Any, scaling: Any, motion: JointMotion, person: int) -> list[str]:
    """Scale the bodies of a model in place; return the measurements that the person does not show."""
    state = model.initSystem()
    names = [marker_name(joint) for joint in motion.joints]
    of_model = model.getMarkerSet()
    scales, missing = library.ScaleSet(), []
    measurements = scaling.getModelScaler().getMeasurementSet()
    for index in range(measurements.getSize()):
        measurement = measurements.get(index)
        bodies = measurement.getBodyScaleSet()
        ratios = []
        for k in range(measurement.getNumMarkerPairs()):
            pair = [measurement.getMarkerPair(k).getMarkerName(end) for end in range(2)]
            if not set(pair).issubset(names):
                continue
            ends = [motion.position[:, person, names.index(name)] for name in pair]
            places = [of_model.get(name).getLocationInGround(state).to_numpy() for name in pair]
            length = np.linalg.norm(ends[1] - ends[0], axis=-1)
            if np.isfinite(length).any():
                ratios.append(float(np.nanmedian(length) / np.linalg.norm(places[1] - places[0])))
        if not measurement.getApply() or not bodies.getSize():
            continue
        if not ratios:
            missing.append(measurement.getName())
            continue
        for k in range(bodies.getSize()):
            scale = library.Scale()
            scale.setSegmentName(bodies.get(k).getName())
            scale.setScaleFactors(library.Vec3(float(np.mean(ratios))))
            scale.setApply(True)
            scales.cloneAndAppend(scale)
    model.scale(state, scales, True, model.getTotalMass(state))
    return missing


def solve(
    library: Any, model: Any, weights: dict[str, float], motion: JointMotion, person: int
) -> Kinematics:
    """Run inverse kinematics over the times with enough markers; what has no weight does not take part."""
    named = [(k, marker_name(joint)) for k, joint in enumerate(motion.joints)]
    seen: Bool = np.asarray(np.isfinite(motion.position[:, person]).all(axis=-1).any(axis=0))
    of_model = model.getMarkerSet()
    used = [
        (k, name) for k, name in named if seen[k] and weights.get(name, 0) > 0 and of_model.contains(name)
    ]
    columns = [k for k, _ in used]
    names = [name for _, name in used]
    position = to_y_up(motion.position[:, person, columns])
    known: Bool = np.asarray(np.isfinite(position).all(axis=-1))
    kept = np.flatnonzero(known.sum(axis=1) >= min(_LEAST_MARKERS, max(len(names), 1)))
    weight = np.array([weights[name] for name in names]) * _by_covariance(motion, person, columns)
    if not len(kept):
        return Kinematics(motion.t_ns[:0], (), np.empty((0, 0)), np.empty((0, len(names))))

    since_s = (motion.t_ns[kept] - motion.t_ns[kept[0]]) / 1e9
    table = library.TimeSeriesTableVec3()
    table.setColumnLabels(names)
    for t_s, row in zip(since_s.tolist(), position[kept].tolist(), strict=True):
        table.appendRow(t_s, library.RowVectorVec3([library.Vec3(*place) for place in row]))
    table.addTableMetaDataString("Units", "m")
    stated = library.SetMarkerWeights()
    for name in names:
        stated.cloneAndAppend(library.MarkerWeight(name, 1.0))
    state = model.initSystem()
    coordinates = [model.getCoordinateSet().get(k) for k in range(model.getCoordinateSet().getSize())]
    rests = [
        _at_rest(library, c, weights[c.getName()]) for c in coordinates if weights.get(c.getName(), 0) > 0
    ]
    reference, resting = library.MarkersReference(table, stated), library.SimTKArrayCoordinateReference()
    for rest in rests:
        resting.push_back(rest)
    solver = library.InverseKinematicsSolver(model, reference, resting)
    solver.setAccuracy(_ACCURACY)
    turns = np.array([c.getMotionType() == library.Coordinate.Rotational for c in coordinates])
    first = _most_bent(motion, person, kept)
    values, errors = np.empty((len(kept), len(coordinates))), np.full((len(kept), len(names)), np.nan)
    for rows in (range(first, len(kept)), range(first - 1, -1, -1)):
        state.setTime(float(since_s[first]))
        _assemble(solver, state, coordinates, names)
        for row in rows:
            state.setTime(float(since_s[row]))
            for name, value in zip(names, weight[kept[row]].tolist(), strict=True):
                solver.updateMarkerWeight(name, value)
            solver.track(state)
            values[row] = [coordinate.getValue(state) for coordinate in coordinates]
            for column in np.flatnonzero(known[kept[row]]).tolist():
                errors[row, column] = solver.computeCurrentMarkerError(names[column])
    values[:, turns] = np.degrees(values[:, turns])
    return Kinematics(motion.t_ns[kept], tuple(c.getName() for c in coordinates), values, errors)


def _assemble(solver: Any, state: Any, coordinates: Sequence[Any], names: Sequence[str]) -> None:
    """Place the model in its pose at the state's time; of four ways to turn the arms the best is taken."""
    by_name = {coordinate.getName(): coordinate for coordinate in coordinates}
    for coordinate in coordinates:
        coordinate.setValue(state, coordinate.getDefaultValue(), False)
    solver.assemble(state)
    if not set(_ARMS).issubset(by_name):
        return
    placed = {name: coordinate.getValue(state) for name, coordinate in by_name.items()}
    found: list[tuple[float, list[float]]] = []
    for turns in product((0.0, np.pi), repeat=2):
        angles = [value for turn in turns for value in (0.0, 0.0, turn, _FIRST_BEND)]
        for name, value in {**placed, **dict(zip(_ARMS, angles, strict=True))}.items():
            by_name[name].setValue(state, value, False)
        solver.assemble(state)
        error = sum(solver.computeCurrentMarkerError(name) ** 2 for name in names)
        found.append((error, [by_name[name].getValue(state) for name in by_name]))
    for name, value in zip(by_name, min(found)[1], strict=True):
        by_name[name].setValue(state, value, False)
    solver.assemble(state)


def _most_bent(motion: JointMotion, person: int, kept: Int64) -> int:
    """Return the row of `kept` at which both elbows are bent most; 0 without arms."""
    bend = np.zeros(len(kept))
    for side in ("left", "right"):
        arm = [f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist")]
        if not set(arm).issubset(motion.joints):
            return 0
        ends = motion.position[kept, person][:, [motion.joints.index(joint) for joint in arm]]
        upper, fore = ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 1]
        across = np.linalg.norm(np.cross(upper, fore), axis=1)
        found = np.arctan2(across, (upper * fore).sum(axis=1))
        bend += np.minimum(np.nan_to_num(found), _BENT_ENOUGH)
    return int(np.argmax(bend))


def _at_rest(library: Any, coordinate: Any, weight: float) -> Any:
    """Return the wish that a coordinate keeps its default value."""
    reference = library.CoordinateReference(
        coordinate.getName(), library.Constant(coordinate.getDefaultValue())
    )
    reference.setWeight(weight)
    return reference


def _by_covariance(motion: JointMotion, person: int, columns: Sequence[int]) -> Float:
    """Return weights [T, M]: the median variance over that of each marker; 1 without covariances."""
    shape = (len(motion.t_ns), len(columns))
    if motion.covariance is None:
        return np.ones(shape)
    variance = motion.covariance[:, person][:, list(columns)][..., [0, 3, 5]].sum(axis=-1)
    known: Bool = np.asarray(np.isfinite(variance) & (variance > 0))
    if not known.any():
        return np.ones(shape)
    ratio = np.median(variance[known]) / np.where(known, variance, np.inf)
    return np.where(known, np.clip(ratio, *_WEIGHTS), 1.0)


def _written(model: Path, found: Kinematics, zero_ns: int) -> list[Path]:
    """Write the motion and the markers' errors beside a model."""
    motion = model.with_name(f"{model.stem}_ik.mot")
    errors = model.with_name(f"{model.stem}_ik_marker_errors.sto")
    t_ns = found.t_ns - zero_ns
    write_storage(motion, t_ns, found.coordinates, found.value, degrees=True)
    squared = found.error_m**2
    figures = [
        np.nansum(squared, axis=1),
        np.sqrt(np.nanmean(squared, axis=1)),
        np.nanmax(found.error_m, axis=1),
    ]
    labels = ("total_squared_error", "marker_error_RMS", "marker_error_max")  # OpenSim's own
    write_storage(errors, t_ns, labels, np.stack(figures, axis=1), degrees=False)
    return [motion, errors]


EXPORT = OpenSimExport()


# Six decimals of a degree and of a metre are below any measurement error.
_DECIMALS = 6


class AnglesExport:
    """Writer of `<name>_angles.csv` (the session's table) and `<name>_angles.sto` (`_<person>` of several).

    A STO has the angles in degrees and after them their standard deviations (`<angle>_sigma`). Its seconds
    count from `recording.zero_ns`; the CSV keeps `t_ns`. OpenSim stops reading at a NaN: times at which an
    angle is not known are left out of the STO, and before that angles that are rarely known.
    """

    name = "angles"
    title = "joint angles with standard deviations, as CSV and for OpenSim (STO)"
    choices: Mapping[str, tuple[str, ...]] = {"unit": ("deg",), "axes": ("none",), "time": ("zero", "epoch")}

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write both files; a person without any angle gets no STO."""
        table = recording.angles()
        if table is None or not len(table) or table["value_deg"].isna().all():
            raise DataError(
                recording.name, "holds no joint angles to export", "run `mocap reconstruct` first"
            )
        name = safe_file_name(recording.name)
        paths = [folder / f"{name}_angles.csv"]
        table.to_csv(paths[0], index=False, lineterminator="\n")
        t_ns, value, sigma = _dense(table)
        known = np.flatnonzero(np.isfinite(value).any(axis=(0, 2))).tolist()
        named = file_names_of_people(recording, value.shape[1])
        for person in known:
            which = f"_{named[person]}" if value.shape[1] > 1 else ""
            paths.append(folder / f"{name}_angles{which}.sto")
            left_out = write_sto(paths[-1], t_ns - recording.zero_ns, value[:, person], sigma[:, person])
            if left_out:
                recording.progress.note(f"angles: {paths[-1].name} leaves out {left_out}, not known")
        return sorted(paths)


def _dense(table: pd.DataFrame) -> tuple[Int64, Float, Float]:
    """Return times [T], and values and standard deviations [T, P, A], of rows in the order of the session."""
    people = int(table["person"].max()) + 1
    shape = (-1, people, len(ANGLES))
    t_ns = table["t_ns"].to_numpy(np.int64).reshape(shape)[:, 0, 0]
    value, sigma = (table[name].to_numpy(np.float64).reshape(shape) for name in ("value_deg", "sigma_deg"))
    return t_ns, value, sigma


def write_sto(path: Path, t_ns: Int64, value_deg: Float, sigma_deg: Float) -> str:
    """Write angles and standard deviations [T, A] deg in the order of `ANGLES`; say what is left out."""
    kept = np.flatnonzero(np.isfinite(value_deg).any(axis=0))
    whole: Bool = np.asarray(np.isfinite(value_deg[:, kept]).all(axis=1))
    while len(kept) > 1 and 2 * np.count_nonzero(whole) < len(t_ns):
        kept = np.delete(kept, np.isfinite(value_deg[:, kept]).sum(axis=0).argmin())
        whole = np.asarray(np.isfinite(value_deg[:, kept]).all(axis=1))
    value, sigma = value_deg[np.ix_(whole, kept)], sigma_deg[np.ix_(whole, kept)]
    known = np.flatnonzero(np.isfinite(sigma).all(axis=0))
    names = [list(ANGLES)[k] for k in kept]
    columns = [*names, *(f"{names[k]}_sigma" for k in known)]
    write_storage(path, t_ns[whole], columns, np.hstack([value, sigma[:, known]]), degrees=True)
    lost = {"times": int(np.count_nonzero(~whole)), "angles": len(ANGLES) - len(kept)}
    return ", ".join(f"{count} {what}" for what, count in lost.items() if count)


def write_storage(path: Path, t_ns: Int64, columns: Sequence[str], values: Float, *, degrees: bool) -> None:
    """Write OpenSim's storage (STO, MOT): quantities [T, C] by the names of their columns."""
    lines = [
        path.stem,
        "version=1",
        f"nRows={len(t_ns)}",
        f"nColumns={len(columns) + 1}",
        f"inDegrees={'yes' if degrees else 'no'}",
        "endheader",
        "\t".join(["time", *columns]),
    ]
    for stamp, row in zip(format_seconds(t_ns), values, strict=True):
        lines.append("\t".join([stamp, *(f"{number:.{_DECIMALS}f}" for number in row.tolist())]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


ANGLES_EXPORT = AnglesExport()
