"""The cell of a plan: from a calibration, from measurements, or from a rough rig: guesses, or only what is there."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from rwhec_factors import se3
from scipy.special import chdtri

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.capture.plan_cell import Cell, Kit, View, in_front
from gtsam_rwhec.capture.plan_information import measured_information, predicted
from gtsam_rwhec.capture.plan_options import PlanOptions
from gtsam_rwhec.capture.plan_ranking import free_frames
from gtsam_rwhec.errors import FrameError, OptionError, RwhecWarning
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.fitting.fit_options import About, CarrierNoise, Stated
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.stated_intrinsics import prior_of
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.poses import Array, one_transform
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.changed_frames import constant_covariance
from gtsam_rwhec.results.linear_model import noise_of_A
from gtsam_rwhec.results.result_file import Result
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.sensor_intrinsics import stated_camera
from gtsam_rwhec.solver.solution import solve

#: Where nobody guessed a frame, and no measurement tells it, it may be so far off: rad and m.
UNKNOWN_RAD, UNKNOWN_M = np.radians(60.0), 0.15
#: The noise of an arm's pose, where nobody states it and no calibration found it: rad and m.
ARM_RAD, ARM_M = np.radians(0.02), 1e-4
#: The noise of a measured pose without corners, where nobody states it: rad and m.
POSE_RAD, POSE_M = np.radians(0.3), 3e-3
#: Residuals are larger than the noise allows where chance gives as large ones with less than this probability.
CHANCE = 0.01


def cell_of(
    source: Problem | Calibration | Result | None,
    options: PlanOptions,
    rig: Rig | None,
    cameras: Mapping[str, Camera],
    boards: Mapping[str, Array],
) -> Cell:
    """The cell of what was measured, or of a rough rig alone; errors as `plan`."""
    problem = source if isinstance(source, Problem) else source.problem if isinstance(source, Calibration) else None
    kit = _kit(problem, options, rig, cameras, boards)
    if isinstance(source, Calibration) and source.refined is not None:
        model = source.noise.model
        constant = () if model is None else model.constant_deviations
        return _of_refined(source.refined, constant, kit, source.noise_of_A, source.problem)
    if isinstance(source, Result):
        if source.refined is None:
            raise OptionError("the result has no covariances, so nothing tells what is to be measured; calibrate again")
        constant = () if source.calibration is None else source.calibration.constant_errors
        return _of_refined(source.refined, constant, kit, None, None)
    return _of_problem(problem or Problem(), kit, options)


def _kit(
    problem: Problem | None,
    options: PlanOptions,
    rig: Rig | None,
    cameras: Mapping[str, Camera],
    boards: Mapping[str, Array],
) -> Kit:
    about: About = "sensorcarrier" if options.moves == "sensors" else "targetcarrier"
    noise, px = options.carrier_noise or CarrierNoise(ARM_RAD, ARM_M, about=about), options.corner_px
    carriers: tuple[str | None, str | None] = (None, None)
    stated: dict[str, Stated] = {}
    if problem is not None:
        carriers = problem.sensor_carrier, problem.target_carrier
        cameras, boards, px = {**cameras, **problem.cameras}, {**boards, **problem.boards}, problem.corner_px or px
    if rig is not None:
        carriers = rig.carriers.sensors, rig.carriers.targets
        for name, sensor in rig.sensors.items():
            own = sensor.intrinsics
            own = rig.sensors[own.shared].intrinsics if own is not None and own.shared is not None else own
            stated[name] = rig.stated_of(name)
            if name not in cameras and own is not None and own.estimate is None and own.topic is None:
                cameras = {**cameras, name: stated_camera(rig, name, own)}
        boards = {**{one.name: one.corners() for one in rig.target_list}, **boards}
        px = rig.corner_px or px
        if rig.carriers.noise is not None and options.carrier_noise is None:
            of = rig.carriers.noise
            noise = CarrierNoise(np.radians(of.rotation_deg), 1e-3 * of.translation_mm, about=about)
    names = carriers[0] or "sensorcarrier", carriers[1] or "targetcarrier"
    stated = {name: stated.get(name, options.stated) for name in cameras}
    return Kit(dict(cameras), {name: np.asarray(of) for name, of in boards.items()}, names, stated, noise, px)


def _slots(sizes: Mapping[str, int]) -> tuple[dict[str, slice], int]:
    ends = np.cumsum([0, *sizes.values()]).tolist()
    return {name: slice(*ends[i : i + 2]) for i, name in enumerate(sizes)}, ends[-1]


def _roughness(slots: Mapping[str, slice], dimension: int, deviations: Mapping[str, tuple[float, float]]) -> Array:
    """The information of guesses: of frames, rad and m."""
    rough = np.zeros(dimension)
    for name, at in slots.items():
        if ":" not in name and name != "scale":
            rough[at] = 1.0 / np.repeat(deviations.get(name, (UNKNOWN_RAD, UNKNOWN_M)), 3) ** 2
    return rough


def _of_refined(
    refined: RefinedPoses,
    constant: tuple[tuple[float, ...], ...],
    kit: Kit,
    carrier_noise: CarrierNoise | None,
    problem: Problem | None,
) -> Cell:
    """A refined calibration: its covariance is that of what is known, less the constant errors of A."""
    kinds = UnknownKind.FRAME, UnknownKind.SCALE, UnknownKind.INTRINSICS
    unknowns = [one for one in refined.unknowns if one.kind in kinds]
    slots, dimension = _slots(
        {str(one): refined.joint.slots[one].stop - refined.joint.slots[one].start for one in unknowns}
    )
    rows = refined.joint.rows(tuple(unknowns))
    floor = constant_covariance(refined, constant)[np.ix_(rows, rows)]
    known = refined.information(*unknowns)
    if not refined.free_directions:
        rest = refined.covariance(*unknowns) - floor
        unit = np.sqrt(np.maximum(np.diagonal(rest), 0.0))
        if (unit > 0.0).all() and np.linalg.eigvalsh(rest / unit[:, None] / unit)[0] > 0.0:
            known = np.linalg.inv(rest / unit[:, None] / unit) / unit[:, None] / unit
        else:
            floor = np.zeros_like(floor)
    blind = sorted({pair.sensor for pair in refined.noise if pair.sensor not in kit.cameras})
    if blind and problem is None:
        raise OptionError(
            f"{', '.join(blind)}: no intrinsics are known, and without them only measurements say where a sensor "
            "looks. Give the problem of the calibration beside it, or intrinsics"
        )
    by_corners = refined.reprojection
    if by_corners is not None:
        kit = replace(kit, corner_px=by_corners.corner_px)
        kit.cameras.update({name: one.camera for name, one in refined.intrinsics.items()})
        if carrier_noise is None and by_corners.carrier_poses != "exact":
            carrier_noise = CarrierNoise(
                by_corners.carrier_rotation_rad or 1e-9,
                by_corners.carrier_translation_m or 1e-9,
                about=kit.carrier_noise.about,
            )
    noise: dict[Pair, Array] = {}
    for pair, found in refined.noise.items():
        size = np.array([found.rotation_rad, found.translation_m])
        if pair.sensor in kit.cameras and pair.target in kit.boards:
            size = np.ones(2)
            if by_corners is None and problem is not None and pair in problem.pairs:
                size = np.array([found.rotation_rad, found.translation_m]) / _usual_noise(problem, pair)
        noise[pair] = size
    of_target = refined.scale if isinstance(refined.scale, dict) else dict.fromkeys(refined.X, float(refined.scale))
    cell = Cell(
        {name: pose.matrix() for name, pose in refined.X.items()},
        {name: pose.matrix() for name, pose in refined.Y.items()},
        dict(of_target),
        kit, slots, dimension, noise, carrier_noise, known, _roughness(slots, dimension, {}), floor,
        refined.degrees_of_freedom,
        _poses(problem),
        _views(problem, kit),
        is_rough=False,
    )  # fmt: skip
    return cell if problem is None or refined.free_directions else replace(cell, share=_share(cell, problem))


def _share(cell: Cell, problem: Problem) -> float:
    """The share of its information for which a measurement counted, at most 1: errors that measurements share, and what
    else the answer does not know, make it less."""
    alone = measured_information(cell, problem)
    frames = np.concatenate([np.arange(at.start, at.stop) for name, at in cell.slots.items() if ":" not in name])
    # Intrinsics as the answer has them: what they are worth is no matter of the poses.
    answer = cell.known[np.ix_(frames, frames)]
    values = np.linalg.eigvals(np.linalg.solve(alone[np.ix_(frames, frames)] + np.diag(cell.rough[frames]), answer))
    return float(min(1.0, np.exp(np.mean(np.log(np.maximum(values.real, 1e-12))))))


def _usual_noise(problem: Problem, pair: Pair) -> Array:
    """The standard deviations (2,) of a usual measurement, rad and m."""
    variances = np.einsum("nii->ni", problem.measurements(*pair).covariance_of_B()).reshape(-1, 2, 3).mean(axis=2)
    return np.asarray(np.sqrt(np.median(variances, axis=0)))


def _poses(problem: Problem | None) -> Array:
    """A of all measurements."""
    if problem is None:
        return np.zeros((0, 4, 4))
    found = [problem.measurements(*pair).A for pair in problem.pairs if not pair.is_motion]
    return np.concatenate([np.zeros((0, 4, 4)), *found])


def _views(problem: Problem | None, kit: Kit) -> dict[str, View]:
    """Where sensors without intrinsics saw their targets."""
    seen: dict[str, list[Array]] = {}
    if problem is None:
        return {}
    for pair in problem.pairs:
        if not pair.is_motion and pair.sensor not in kit.cameras:
            seen.setdefault(pair.sensor, []).append(problem.measurements(*pair).B[:, :3, 3])
    views = {}
    for name, parts in seen.items():
        points = np.concatenate(parts)
        distances = np.linalg.norm(points, axis=1)
        rays = points / distances[:, None]
        axis = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
        angle = float(np.arccos(np.clip(rays @ axis, -1.0, 1.0)).max())
        views[name] = View(axis, (float(distances.min()), float(distances.max())), max(angle, 0.05))
    return views


def _of_problem(problem: Problem, kit: Kit, options: PlanOptions) -> Cell:
    """The certified answer of measurements and guesses, with the noise as stated; or the guesses alone."""
    problem.require_raw_measurements("a plan")
    guesses = {name: one_transform(T, f"the guess of {name}") for name, T in options.guesses.items()}
    sensors = tuple(dict.fromkeys([*problem.sensors, *kit.cameras]))
    strangers = [name for name in guesses if name not in {*sensors, *problem.targets, *kit.boards}]
    if strangers:
        raise FrameError(f"there is a guess of {shown(strangers[0])}, which is no sensor and no target of this cell")
    seen = [pair for pair in problem.pairs if not pair.is_motion]
    Y = {name: guesses.get(name, np.eye(4)) for name in sensors}
    deviations = {name: (np.radians(options.guess_deg), options.guess_m) for name in guesses}
    X = {name: guesses[name] for name in dict.fromkeys([*problem.targets, *kit.boards]) if name in guesses}
    scale = dict.fromkeys([*problem.targets, *kit.boards], 1.0)
    if seen:
        stated = copy.copy(problem)
        stated.priors = {name: list(of) for name, of in problem.priors.items()}
        if problem.is_relative:
            rows = {pair: problem.measurements(*pair) for pair in problem.pairs}
            weak = {"sigma": POSE_M, "kappa": 0.5 / POSE_RAD**2}
            stated = stated.with_measurements(
                {p: replace(m, **{k: np.full(len(m.A), v) for k, v in weak.items()}) for p, m in rows.items()}
            )
        for name in (*problem.sensors, *(name for name in problem.targets if name in guesses)):
            if name not in problem.fixed:
                rad, m = deviations.get(name, (UNKNOWN_RAD, UNKNOWN_M))
                stated.add_prior(name, Y[name] if name in Y else X[name], m, 0.5 / rad**2)
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):
            solution = solve(stated)
        X |= {name: pose.matrix() for name, pose in solution.X.items()}
        Y |= {name: pose.matrix() for name, pose in solution.Y.items()}
        found = solution.scale
        scale |= found if isinstance(found, dict) else dict.fromkeys(scale, float(found))
        problem = stated
    is_nominal = False
    if not X and kit.boards and sensors and sensors[0] in kit.cameras:
        name, is_nominal = next(iter(kit.boards)), True
        given = options.present
        present = np.eye(4) if given is None else one_transform(given, "PlanOptions.present")
        X = {name: se3.inverse(present) @ Y[sensors[0]] @ in_front(kit.cameras[sensors[0]], kit.boards[name])}
    sizes = {name: 6 for name in (*X, *Y) if name not in problem.fixed}
    if problem.scale != "known":
        sizes |= dict.fromkeys(
            ["scale"] if problem.scale == "shared" else [f"scale:{n}" for n in X if n not in problem.fixed_scales], 1
        )
    sizes |= {f"intrinsics:{name}": len(kit.cameras[name].parameters) for name in Y if name in kit.cameras}
    slots, dimension = _slots(sizes)
    known, rough = np.zeros((dimension, dimension)), _roughness(slots, dimension, deviations)
    for name, at in slots.items():
        kind, _, owner = name.partition(":")
        if kind == "intrinsics":
            known[at, at] = prior_of(kit.cameras[owner], kit.stated[owner]).precision
        elif kind == "scale":
            rough[at] = 1.0
    noise = {}
    for pair in seen:
        has_corners = pair.sensor in kit.cameras and pair.target in kit.boards
        noise[pair] = np.ones(2) if has_corners else _usual_noise(problem, pair)
    cell = Cell(
        X, Y, scale, kit, slots, dimension, noise, kit.carrier_noise, known, rough,
        np.zeros((dimension, dimension)), np.inf, _poses(problem), _views(problem, kit), is_rough=False,
    )  # fmt: skip
    if seen:
        cell = replace(cell, share=1.0 / _excess(cell, problem))
        cell = replace(cell, known=known + measured_information(cell, problem))
    free = free_frames(cell, cell.covariance)
    is_rough = is_nominal or any(name in free and name not in guesses for name in sensors)
    return replace(cell, is_rough=is_rough)


def _excess(cell: Cell, problem: Problem) -> float:
    """By how much the residuals' squares exceed those that the noise allows, at least 1."""
    total, spare = 0.0, -6 * len({*cell.X, *cell.Y} & cell.slots.keys())
    for pair in problem.pairs:
        if not pair.is_motion:
            raw, scale = problem.measurements(*pair), cell.scale[pair.target]
            P = predicted(cell, pair, raw.A)
            P[:, :3, 3] *= scale
            residual = se3.logmap(se3.inverse(P) @ raw.B)
            noise = raw.covariance_of_B() + noise_of_A(cell.carrier_noise, raw.A, cell.X[pair.target], scale)
            total += float(np.einsum("ni,nij,nj->", residual, np.linalg.inv(noise), residual))
            spare += residual.size
    return max(1.0, total / float(chdtri(spare, CHANCE))) if spare > 0 else 1.0
