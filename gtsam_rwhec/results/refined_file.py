"""Writing a refined calibration to a result file and reading it back; the graph is not kept."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement import unknowns
from gtsam_rwhec.refinement.joint_covariance import JointCovariance
from gtsam_rwhec.refinement.refined import Movement, PairNoise, Refined, RefinedPoses
from gtsam_rwhec.results.schema import (
    FORMAT_VERSION,
    REFINED_VERSION,
    Deviations,
    Joint,
    RefinedFields,
    RefinedFrame,
    RefinedPair,
    ResultFile,
    Row,
    Unknown,
)
from gtsam_rwhec.results.solution_file import (
    fields_of,
    in_words,
    pose_from_file,
    pose_to_file,
    read_result,
    result_json,
    scale_from_file,
    scale_to_file,
    write_result,
)
from gtsam_rwhec.results.stage_reports import LogFields


def write_refined(refined: Refined, path: str | Path, log: LogFields | None = None) -> None:
    """Write a refined calibration, with the certified solution that it began at, as JSON.

    Parameters
    ----------
    refined : Refined
    path : str or Path
        The file; replaced if it is there. Its folder must be there.
    log : LogFields, optional
        Where the measurements came from and what became of them.

    Raises
    ------
    FileFormatError
        The file cannot be written (the message says why), or a number is NaN.
    """
    write_result(path, lambda: _fields(refined, log))


def refined_json(refined: Refined, log: LogFields | None = None) -> bytes:
    """What `write_refined` writes."""
    return result_json(lambda: _fields(refined, log), "the result")


def _fields(refined: Refined, log: LogFields | None) -> ResultFile:
    return fields_of(refined.solution).model_copy(
        update={
            "format_version": REFINED_VERSION if log is None else FORMAT_VERSION,
            "refined": _to_file(refined),
            "log": log,
        }
    )


def read_refined(path: str | Path) -> RefinedPoses:
    """Read what ``write_refined`` wrote: poses and covariances are the same doubles as before.

    Raises
    ------
    ResultVersionError, FileFormatError
        As for ``read_solution``; and where the file holds no refined poses.
    """
    return refined_of(read_result(path), path)


def refined_of(result: ResultFile, path: str | Path) -> RefinedPoses:
    """The refined poses among a file's fields; `path` is for messages.

    Raises
    ------
    FileFormatError
        Where there are none.
    """
    fields = result.refined
    if fields is None:
        raise FileFormatError(
            f"{path} holds a solution that was not refined; read it with read_solution, or refine and write that "
            "(gtsam-rwhec calibrate --refine, or rw.write_refined)."
        )
    return RefinedPoses(
        X={pose.child: pose_from_file(pose) for pose in fields.targets},
        Y={pose.child: pose_from_file(pose) for pose in fields.sensors},
        scale=scale_from_file(fields.scale),
        scale_mode=fields.scale.mode,
        time_offsets_s=dict(fields.time_offsets_s),
        noise_source=fields.noise_source,
        noise={Pair(p.target, p.sensor): PairNoise(p.noise_rad, p.noise_m, p.redundancy) for p in fields.pairs},
        cost=fields.cost,
        initial_cost=fields.initial_cost,
        iterations=fields.iterations,
        moved={frame.name: Movement(frame.moved_mm, frame.moved_deg) for frame in fields.frames},
        inlier_counts={Pair(p.target, p.sensor): p.inliers for p in fields.pairs if p.inliers is not None},
        free_directions=in_words(fields.free_directions),
        joint=_joint_from_file(fields.joint),
    )


def _to_file(refined: Refined) -> RefinedFields:
    return RefinedFields(
        targets=tuple(pose_to_file("targetcarrier", name, pose) for name, pose in refined.X.items()),
        sensors=tuple(pose_to_file("sensorcarrier", name, pose) for name, pose in refined.Y.items()),
        scale=scale_to_file(refined.scale_mode, refined.scale),
        time_offsets_s=refined.time_offsets_s,
        noise_source=refined.noise_source,
        residual=refined.options.residual,
        robust=refined.options.robust,
        cost=refined.cost,
        initial_cost=refined.initial_cost,
        iterations=refined.iterations,
        free_directions=tuple(map(str, refined.free_directions)),
        frames=tuple(_frame_to_file(refined, name) for name in refined.moved),
        pairs=tuple(
            RefinedPair(
                target=pair.target,
                sensor=pair.sensor,
                noise_rad=noise.rotation_rad,
                noise_m=noise.translation_m,
                redundancy=noise.redundancy,
                inliers=refined.inlier_counts.get(pair),
            )
            for pair, noise in refined.noise.items()
        ),
        joint=_joint_to_file(refined.joint),
    )


def _frame_to_file(refined: Refined, name: str) -> RefinedFrame:
    degrees, millimetres = refined.standard_deviations(name)
    moved = refined.moved[name]
    return RefinedFrame(
        name=name,
        standard_deviations_deg=cast(Deviations, tuple(degrees.tolist())),
        standard_deviations_mm=cast(Deviations, tuple(millimetres.tolist())),
        covariance=cast(tuple[Row, Row, Row, Row, Row, Row], _null_where_infinite(refined.covariance(name))),
        moved_mm=moved.translation_mm,
        moved_deg=moved.rotation_deg,
    )


def _null_where_infinite(matrix: Array) -> tuple[tuple[float | None, ...], ...]:
    return tuple(tuple(None if np.isinf(value) else value for value in row) for row in matrix.tolist())


def _joint_to_file(joint: JointCovariance) -> Joint:
    symmetric = joint.finite
    return Joint(
        unknowns=tuple(Unknown(name=str(unknown), rows=6 if unknown.dimension == 6 else 1) for unknown in joint.slots),
        units=tuple(joint.unit.tolist()),
        finite=tuple(tuple(row[: i + 1]) for i, row in enumerate(symmetric.tolist())),
        free=tuple(tuple(direction) for direction in joint.free.T.tolist()),
    )


def _joint_from_file(fields: Joint) -> JointCovariance:
    ends = np.cumsum([unknown.rows for unknown in fields.unknowns]).tolist()
    size = len(fields.units)
    finite = np.zeros((size, size))
    finite[np.tril_indices(size)] = [value for row in fields.finite for value in row]
    return JointCovariance(
        slots={
            unknowns.Unknown.of(u.name): slice(end - u.rows, end) for u, end in zip(fields.unknowns, ends, strict=True)
        },
        finite=finite + np.tril(finite, -1).T,
        free=np.array(fields.free).reshape(len(fields.free), size).T,
        unit=np.array(fields.units),
    )
