"""Export to Rerun: a recording for its viewer. Needs rerun-sdk.

Entities: `world` (z up, metres) with `map`, `<person>/skeleton`, `<person>/uncertainty` (95 % ellipsoids),
`cameras/<camera>` (its pose over time, with a pinhole and pictures in `image`) and `paths/<camera>`; the
series `angles/<person>/<angle>` in degrees, `sigma/<person>/<joint>` in m; `doubts`, as warnings at the
beginning. Missing joints are left out. The timeline `time` is a date, or seconds if the flight has no date.
Recordings of the same session differ in their bytes (rerun numbers its chunks at random).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.formats.common.exporting import (
    ellipsoids_95,
    file_names_of_people,
    note_no_skeleton,
    safe_file_name,
    shown_surface,
    thinned,
)
from pipelines.formats.videos.video_writing import H264Stream
from pipelines.geometry.arrays import Float, Int64, Intrinsics
from pipelines.geometry.cameras import camera_matrix, rescaled
from pipelines.session.errors import DataError
from pipelines.session.people import bones_of, side_of, with_derived
from pipelines.session.records import JointMotion, Recording, Trajectory
from pipelines.session.registries import need

# A path of this rate looks smooth.
_PATH_HZ = 10.0
_JOINT_M, _PICTURE_PLANE_M = 0.025, 1.0
_COLOURS = {"left": (89, 183, 245), "right": (255, 157, 92), "": (223, 226, 229)}
_STONE = (150, 146, 140)
# Stamps before 1973 count from the start of a log and not from the epoch.
_LAST_WITHOUT_DATE_NS = 10**9 * 10**8


class RerunExport:
    """Writer of `<name>.rrd`: skeleton, uncertainty, series, cameras, pictures with the skeleton, and map."""

    name = "rerun"
    title = "a recording to look at in Rerun: skeleton, cameras, map, pictures (extra rerun)"

    def write(self, recording: Recording, folder: Path) -> list[Path]:
        """Write all parts of the recording."""
        motion, tracks = recording.motion, recording.tracks
        if motion is None and not tracks:
            raise DataError(recording.name, "holds neither joints nor camera poses", "reconstruct it first")
        note_no_skeleton(recording, self.name)
        rr = need("rerun", "rerun")
        name = safe_file_name(recording.name)
        path = folder / f"{name}.rrd"
        with rr.RecordingStream("mocap", recording_id=name, send_properties=False) as stream:
            stream.save(path, default_blueprint=_blueprint(rr, list(tracks)))
            stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            recording.progress.start("Writing rerun", len(tracks) + 2)
            _log_map(rr, stream, recording)
            recording.progress.advance()
            if motion is not None:
                named = file_names_of_people(recording, motion.position.shape[1])
                _log_people(rr, stream, motion, named)
                _log_sigmas(rr, stream, motion, named)
            _log_angles(rr, stream, recording)
            times = [track.t_ns for track in tracks.values()] + ([motion.t_ns] if motion is not None else [])
            if texts := recording.doubts():
                start_ns = min(int(t_ns[0]) for t_ns in times if len(t_ns))
                logged = rr.TextLog.columns(text=texts, level=["WARN"] * len(texts))
                stream.send_columns("doubts", [_times(rr, np.full(len(texts), start_ns, np.int64))], logged)
            recording.progress.advance()
            for camera, track in tracks.items():
                _log_track(rr, stream, camera, track)
                if camera in recording.lenses:
                    _log_pictures(rr, stream, recording, camera, recording.lenses[camera])
                recording.progress.advance()
            stream.flush()
            stream.disconnect()
        return [path]


def _times(rr: Any, t_ns: Int64) -> Any:
    if len(t_ns) and t_ns[-1] < _LAST_WITHOUT_DATE_NS:
        return rr.TimeColumn("time", duration=t_ns.astype("timedelta64[ns]"))
    return rr.TimeColumn("time", timestamp=t_ns.astype("datetime64[ns]"))


def _log_people(rr: Any, stream: Any, motion: JointMotion, named: Sequence[str]) -> None:
    joints, position = with_derived(motion.joints, motion.position)
    described = rr.ClassDescription(
        info=rr.AnnotationInfo(id=1, label="person"),
        keypoint_annotations=[
            rr.AnnotationInfo(id=k, label=name, color=_colour(name)) for k, name in enumerate(joints)
        ],
        keypoint_connections=[(joints.index(a), joints.index(b)) for a, b in bones_of(joints)],
    )
    stream.log("world", rr.AnnotationContext([described]), static=True)
    for person in range(position.shape[1]):
        body = position[:, person]
        known = np.isfinite(body).all(axis=-1)
        total = int(known.sum())
        stream.send_columns(
            f"world/{named[person]}/skeleton",
            [_times(rr, motion.t_ns)],
            rr.Points3D.columns(
                positions=body[known],
                radii=np.full(total, _JOINT_M),
                class_ids=np.ones(total, np.uint16),
                keypoint_ids=np.nonzero(known)[1].astype(np.uint16),
            ).partition(known.sum(axis=1)),
        )
        if motion.covariance is None:
            continue
        half, turn = ellipsoids_95(motion.covariance[:, person])
        stated = np.isfinite(half).all(axis=-1) & np.isfinite(motion.position[:, person]).all(axis=-1)
        colours = np.array([(*_colour(name), 80) for name in motion.joints], np.uint8)
        stream.send_columns(
            f"world/{named[person]}/uncertainty",
            [_times(rr, motion.t_ns)],
            rr.Ellipsoids3D.columns(
                half_sizes=half[stated],
                centers=motion.position[:, person][stated],
                quaternions=turn[stated],
                colors=colours[np.nonzero(stated)[1]],
            ).partition(stated.sum(axis=1)),
        )


def _log_sigmas(rr: Any, stream: Any, motion: JointMotion, named: Sequence[str]) -> None:
    """Log the standard deviation of each joint where it is there: root mean square of its axes'."""
    if motion.covariance is None:
        return
    sigma = np.sqrt(motion.covariance[..., [0, 3, 5]].mean(axis=-1))  # xx, yy, zz
    sigma[~np.isfinite(motion.position).all(axis=-1)] = np.nan
    for person in range(sigma.shape[1]):
        for joint, name in enumerate(motion.joints):
            _log_series(rr, stream, f"sigma/{named[person]}/{name}", motion.t_ns, sigma[:, person, joint])


def _log_angles(rr: Any, stream: Any, recording: Recording) -> None:
    table = recording.angles()
    if table is None:
        return
    named = file_names_of_people(recording, int(table["person"].max()) + 1 if len(table) else 0)
    for (number, name), rows in table.groupby(["person", "angle"], sort=True):
        person = named[int(str(number))]
        for entity, column in ((name, "value_deg"), (f"{name}/sigma", "sigma_deg")):
            values = rows[column].to_numpy()
            _log_series(rr, stream, f"angles/{person}/{entity}", rows["t_ns"].to_numpy(), values)


def _log_series(rr: Any, stream: Any, entity: str, t_ns: Int64, values: Float) -> None:
    known = np.isfinite(values)
    if known.any():
        stream.send_columns(entity, [_times(rr, t_ns[known])], rr.Scalars.columns(scalars=values[known]))


def _log_track(rr: Any, stream: Any, name: str, track: Trajectory) -> None:
    part = rr.escape_entity_path_part(name)
    stream.send_columns(
        f"world/cameras/{part}",
        [_times(rr, track.t_ns)],
        rr.Transform3D.columns(translation=track.position, quaternion=track.quaternion_xyzw),
    )
    flown = track.position[thinned(track.t_ns, _PATH_HZ)]
    stream.log(f"world/paths/{part}", rr.LineStrips3D([flown], colors=[_STONE]), static=True)


def _log_pictures(rr: Any, stream: Any, recording: Recording, name: str, lens: Intrinsics) -> None:
    entity = f"world/cameras/{rr.escape_entity_path_part(name)}/image"
    film = H264Stream()
    for t_ns, picture in recording.overlays(name):
        if film.size == (0, 0):
            stream.log(entity, rr.VideoStream(codec=rr.VideoCodec.H264), static=True)
        unit, is_key = film.encode(picture)
        stream.send_columns(
            entity,
            [_times(rr, np.array([t_ns], np.int64))],
            rr.VideoStream.columns(sample=[unit], is_keyframe=[is_key]),
        )
    shown = rescaled(lens, *film.size) if film.size[0] else lens
    stream.log(
        entity,
        rr.Pinhole(
            image_from_camera=camera_matrix(shown),
            resolution=(shown.width, shown.height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_PICTURE_PLANE_M,
        ),
        static=True,
    )


def _log_map(rr: Any, stream: Any, recording: Recording) -> None:
    for occupancy in recording.maps():
        surface = shown_surface(recording, occupancy, "rerun")
        points = rr.Points3D(surface.middle, radii=surface.cube_m / 2, colors=[_STONE])
        if occupancy.from_ns:
            if occupancy.from_ns < _LAST_WITHOUT_DATE_NS:
                stream.set_time("time", duration=np.timedelta64(occupancy.from_ns, "ns"))
            else:
                stream.set_time("time", timestamp=np.datetime64(occupancy.from_ns, "ns"))
            stream.log("world/map", points)
            stream.reset_time()
        else:
            stream.log("world/map", points, static=True)


def _blueprint(rr: Any, cameras: list[str]) -> Any:
    """Make a blueprint with the world beside the pictures."""
    views = need("rerun.blueprint", "rerun")
    scene = views.Spatial3DView(origin="/world", name="World")
    pictures = [
        views.Spatial2DView(origin=f"/world/cameras/{rr.escape_entity_path_part(name)}/image", name=name)
        for name in cameras
    ]
    return views.Blueprint(views.Horizontal(scene, views.Grid(*pictures)) if pictures else scene)


def _colour(joint: str) -> tuple[int, int, int]:
    return _COLOURS[side_of(joint)]


EXPORT = RerunExport()
