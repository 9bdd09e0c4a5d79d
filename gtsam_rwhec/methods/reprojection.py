"""Calibration by reprojection errors: corners in pixels replace the measured poses of A X = Y B.

A camera sees a target's corner p at the pixel of Y^-1 A X p, with the image's A. ``run`` minimises a published method's
cost, ``compare`` puts all of them and ``rw.refine_corners`` into one table, with one measure for all: the reprojection
errors by the measured A.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np

from gtsam_rwhec.errors import CameraError, FrameError, OptionError, RwhecError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.corner_checks import check_arguments
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.fit_options import CarrierNoise, CornerOptions
from gtsam_rwhec.fitting.observations import (
    Observations,
    check_corners_everywhere,
    observations_of,
    solved_with_chosen_poses,
)
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array, one_transform, to_pose3
from gtsam_rwhec.methods.certified import quiet_solution
from gtsam_rwhec.methods.closed_forms import start_of
from gtsam_rwhec.methods.corner_methods import Corners, cost_at, evangelista_minimum, rp1_minimum
from gtsam_rwhec.methods.iterative_methods import TABB_SOURCE, Parameterisation
from gtsam_rwhec.methods.levenberg_marquardt import Descent
from gtsam_rwhec.methods.method import (
    Method,
    MethodOptions,
    Outcome,
    Poses,
    Properties,
    Takes,
    checked_options,
    checked_start,
)
from gtsam_rwhec.problem.problem import Problem

#: The name of ``rw.refine_corners`` in tables.
OURS = "refine_corners"
#: The published methods.
NAMES = ("evangelista2023", "tabb2017_rp1")
#: A descent from a start (n, 4, 4); the number is its most steps.
Descend = Callable[[Corners, Array, int], Descent[Array]]


@dataclass(frozen=True)
class ReprojectionAnswer:
    """A method's answer."""

    method: str
    #: T_targetcarrier_target and T_sensorcarrier_sensor, metres
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    #: Half the method's own cost, over corner_px^2; for ``refine_corners`` with noise of A, the graph's cost
    cost: float
    #: Half the sum of squared reprojection errors by the measured A, over corner_px^2: the same for all methods.
    #: Infinite where a corner that was seen is behind its camera.
    reprojection_cost: float
    rms_px: float  #: Root mean square length of these errors, pixels
    iterations: int
    converged: bool
    seconds: float  #: Of the descent, without the start
    starts_from: str


@dataclass(frozen=True)
class ReprojectionRow:
    """A method with its answer, or with the error for which it has none."""

    method: str
    answer: ReprojectionAnswer | None = None
    error: RwhecError | None = None


@dataclass(frozen=True)
class ReprojectionTable:
    """All methods' answers, those with an answer first, by the reprojection cost that all share."""

    rows: tuple[ReprojectionRow, ...]

    def __str__(self) -> str:
        """A table with one line a method."""
        lines = [f"{'method':17}{'rms px':>10}{'reprojection cost':>19}{'own cost':>14}{'steps':>7}{'s':>9}  start"]
        for row in self.rows:
            found = row.answer
            if found is None:
                lines.append(f"{row.method:17}{row.error}")
                continue
            steps = f"{found.iterations}" + ("" if found.converged else "+")
            lines.append(
                f"{row.method:17}{found.rms_px:10.4f}{found.reprojection_cost:19.3f}{found.cost:14.3f}{steps:>7}"
                f"{found.seconds:9.3f}  {found.starts_from}"
            )
        return "\n".join(lines)


@one_blas_thread()
def run(
    name: str,
    observations: Observations,
    options: MethodOptions | None = None,
    *,
    parameterisation: Parameterisation = "axis-angle",
    carrier: CarrierNoise | None = None,
) -> ReprojectionAnswer:
    """Minimise a published method's reprojection cost over all X and Y.

    Without a start in the options, the descent starts at a closed form's answer (``linear_methods.start_of``) for the
    images' poses. A flat target has two poses in an image; this answer chooses between them.

    Parameters
    ----------
    name : "evangelista2023" or "tabb2017_rp1"
    parameterisation : "axis-angle", "euler" or "quaternion"
        Of rp1's rotations.
    carrier : CarrierNoise, optional
        Deviations of the robot's poses in Evangelista's graph; left out, its information matrices are the identity.

    Raises
    ------
    CameraError
        When the start puts a corner that was seen behind its camera.
    OptionError
        When the name is unknown, or an argument is of another type.
    UnderdeterminedError
        When the closed form finds that the motions do not determine the poses.
    """
    check_arguments(observations, None)
    options = checked_options(options)
    descent = _descent(name, parameterisation, carrier)
    X, Y, starts_from = _start(observations, options)
    return _answer(name, descent, Corners.of(observations), X, Y, options, starts_from)


@one_blas_thread()
def compare(
    observations: Observations,
    options: MethodOptions | None = None,
    *,
    carrier: CarrierNoise | None = None,
    methods: Iterable[str] = (*NAMES, OURS),
) -> ReprojectionTable:
    """All methods on corners from one start, and ``rw.refine_corners`` with the stated intrinsics.

    Without a start in the options all start at the certified solution of the images' poses.

    Parameters
    ----------
    carrier : CarrierNoise, optional
        The noise of A, for Evangelista's graph and for ours; left out, A is exact for ours.

    Raises
    ------
    OptionError
        When a name is unknown, or an argument is of another type.
    RwhecError
        When there is no start, as ``rw.solve`` does.
    """
    check_arguments(observations, None)
    options = checked_options(options)
    names = tuple(methods)
    descents = {name: _ours(observations, carrier) if name == OURS else _descent(name, "axis-angle", carrier)
                for name in names}  # fmt: skip
    if options.start is None:
        X, Y = certified_start(observations, options)
        starts_from = "the certified solution of the images' poses"
    else:
        X, Y, starts_from = _start(observations, options)
    corners, rows = Corners.of(observations), []
    for name, descent in descents.items():
        try:
            rows.append(ReprojectionRow(name, _answer(name, descent, corners, X, Y, options, starts_from)))
        except RwhecError as error:
            rows.append(ReprojectionRow(name, error=error))
    rows.sort(key=lambda row: np.inf if row.answer is None else row.answer.reprojection_cost)
    return ReprojectionTable(tuple(rows))


def certified_start(observations: Observations, options: MethodOptions) -> tuple[Poses, Poses]:
    """X and Y of the certified solution, which also chooses between the two candidate poses of each image."""
    solution = solved_with_chosen_poses(
        observations, lambda problem: quiet_solution(problem, options), lambda answer: (answer.X, answer.Y)
    )
    return solution.X, solution.Y


def _descent(name: str, parameterisation: Parameterisation, carrier: CarrierNoise | None) -> Descend:
    if name == "tabb2017_rp1":
        return partial(rp1_minimum, parameterisation=parameterisation)
    if name == "evangelista2023":
        return partial(evangelista_minimum, carrier=_deviations(carrier))
    raise OptionError(f"method {brief(name)} is not one of {', '.join((*NAMES, OURS))}")


def _deviations(carrier: CarrierNoise | None) -> tuple[float, float] | None:
    if carrier is None:
        return None
    if carrier.covariances is not None or carrier.about != "targetcarrier":
        raise OptionError(
            f"carrier={brief(carrier)}: the graph's edges take one rotation_rad and one translation_m about the target "
            "carrier; give rw.CarrierNoise(rotation_rad=..., translation_m=...)"
        )
    return carrier.rotation_rad, carrier.translation_m


def _ours(observations: Observations, carrier: CarrierNoise | None) -> Descend:
    def descent(corners: Corners, start: Array, max_iterations: int) -> Descent[Array]:
        told = CornerOptions(
            stated="exact", carrier_noise=carrier or "exact", outliers=False, max_iterations=max_iterations
        )
        refined = refine_corners(observations, *corners.named([*start]), told)
        poses = [*(refined.X[name] for name in corners.targets), *(refined.Y[name] for name in corners.sensors)]
        frames = np.array([pose.matrix() for pose in poses])
        deviations = _deviations(carrier)
        cost = corners.cost(frames)
        if deviations is not None:
            cost = cost_at(corners, frames, refined.point.A, deviations)
        return Descent(frames, cost, refined.iterations, refined.last_step < 0.1)

    return descent


def _answer(
    name: str, descent: Descend, corners: Corners, X: Poses, Y: Poses, options: MethodOptions, starts_from: str
) -> ReprojectionAnswer:
    starts = [(frame, X[frame]) for frame in corners.targets] + [(frame, Y[frame]) for frame in corners.sensors]
    start = np.array([one_transform(pose, f"start of {frame}") for frame, pose in starts])
    if not np.isfinite(corners.cost(start)):
        raise CameraError(
            f"the start ({starts_from}) puts a corner that was seen behind its camera; give a better start by "
            "MethodOptions.start"
        )
    begun = time.perf_counter()
    found = descent(corners, start, options.max_iterations)
    seconds = time.perf_counter() - begun
    poses = [to_pose3(frame[:3, :3], frame[:3, 3]) for frame in found.point]
    cost = corners.cost(found.point)
    return ReprojectionAnswer(
        name,
        *corners.named(poses),
        found.cost,
        cost,
        float(corners.corner_px * np.sqrt(2.0 * cost / corners.number)),
        found.iterations,
        found.converged,
        seconds,
        starts_from,
    )


def _start(observations: Observations, options: MethodOptions) -> tuple[Poses, Poses, str]:
    if options.start is not None:
        X, Y, _ = checked_start(observations.targets, observations.sensors, options.start)
        return X, Y, "the given start"
    X, Y, _, words = solved_with_chosen_poses(
        observations, lambda problem: start_of(problem, options), lambda answer: answer[:2]
    )
    return X, Y, f"{words} of the images' poses"


def check_corners(problem: Problem) -> None:
    """Refuse a problem of poses: FrameError without any corners, CountError where measurements have none."""
    if not problem.boards:
        raise FrameError(
            f"this method minimises reprojection errors, and the problem's {problem.number_of_measurements} "
            "measurements are poses; give corners in pixels, by problem.add_corners, or as rw.Observations to "
            "gtsam_rwhec.methods.reprojection.run or compare"
        )
    check_corners_everywhere(problem)


def by_corners(problem: Problem, options: MethodOptions, name: str) -> Outcome[Poses]:
    """The answer for the corners that a problem holds."""
    answer = run(name, observations_of(problem), options)
    notes = () if answer.converged else (f"not converged after {answer.iterations} steps",)
    return Outcome(
        answer.X,
        answer.Y,
        starts_from=answer.starts_from,
        notes=(f"{answer.rms_px:.3g} px rms by the measured A", *notes),
    )


def _method(name: str, properties: Properties, source: str, assumes: str) -> Method[[Problem, MethodOptions]]:
    return Method(
        name=name,
        function=partial(by_corners, name=name),
        properties=properties,
        source=source,
        assumes=assumes,
        takes=frozenset({Takes.CORNERS}),
        check=check_corners,
    )


EVANGELISTA = _method(
    "evangelista2023",
    Properties("SE(3)", multiple="Xs"),
    "D. Evangelista, E. Olivastri, D. Allegri, E. Menegatti and A. Pretto, A graph-based optimization framework for "
    "hand-eye calibration for multi-camera setups, ICRA 2023",
    "Corners in pixels, equally accurate, of cameras whose intrinsics are known. Deviations of the robot's poses: by "
    "default a metre and two radians for each pixel. A start near the answer.",
)
RP1 = _method(
    "tabb2017_rp1",
    Properties("Euler angles, rotation vectors or quaternions", multiple="Xs or Ys"),
    TABB_SOURCE,
    "Corners in pixels, of cameras whose intrinsics are known. A start near the answer.",
)
