"""Refinement from corners: GTSAM's optimum, the noise of the corners, and stated values that they contradict."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial

import gtsam
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError, RwhecWarning
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting.corner_checks import (
    check_arguments,
    check_clocks,
    check_corners,
    check_determined,
    check_motion,
    check_names,
    check_options,
    check_rays,
    check_spread,
    farthest,
    few_corners,
    findings_of_images_left_out,
    first_of,
    told_where_it_fails,
)
from gtsam_rwhec.fitting.corner_findings import findings_of
from gtsam_rwhec.fitting.corner_graph import CornerGraph
from gtsam_rwhec.fitting.corner_model import BEHIND, Model, Point
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced, degrees_of_freedom, weights_of
from gtsam_rwhec.fitting.corner_patterns import OF_AN_IMAGE, patterns
from gtsam_rwhec.fitting.corner_residuals import SHAPE, shaped, stacks_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined, RefinedIntrinsics
from gtsam_rwhec.fitting.fit_options import CarrierNoise, CornerOptions, RefineOptions
from gtsam_rwhec.fitting.observations import Observations, first_intrinsics, solved_with_chosen_poses
from gtsam_rwhec.fitting.readmission import agreeing_by_corners
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import refine
from gtsam_rwhec.fitting.reprojection_record import WARPS
from gtsam_rwhec.fitting.stated_intrinsics import CameraPrior, Innovation, free_model, innovation_of, prior_of, wider
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution, solve

#: Rounds of noise, outliers and optimum in turns end when no deviation changes by more than this share.
ROUNDS, SETTLED = 12, 1e-3
#: After so many rounds corners that are out stay out. Two images of one instant that disagree may come and go together.
COMING_BACK = 4
#: Steps end where the cost falls by less than this share; with outliers in the fit, which only tells which corners they
#: are, by less than ``ROUGHLY``.
EXACTLY, ROUGHLY = 1e-9, 1e-2
#: And where it falls by less than this.
LEAST_GAIN = 1e-7
#: Images that their poses left out are taken back by their corners at most so many times, less one.
READMISSIONS = 3
#: Doubted priors are widened at most so many times.
WIDENINGS = 6
#: Deviations at the start: of a corner (pixels) and of the carriers' poses (rad, m).
ROUGH = Noise(0.3, 1e-3, 1e-3)
#: Deviation of a clock's offset before the images are looked at, s: weak, so that a carrier that stands still has one.
OFFSET_S = 1.0


@dataclass(frozen=True, eq=False)
class _Settled:
    """The optimum under the noise that the residuals have."""

    model: Model
    point: Point
    noise: Noise
    graph: CornerGraph
    joint: Array
    slots: Mapping[tuple[str, str], slice]
    freedom_of: Callable[[], Mapping[tuple[str, str], float]]
    iterations: int
    last_step: float


@one_blas_thread()
def refine_corners(
    observations: Observations,
    X: Mapping[str, PoseLike],
    Y: Mapping[str, PoseLike],
    options: CornerOptions | None = None,
    progress: Progress | None = None,
) -> CornersRefined:
    """Refine poses, cameras and boards from corners.

    Parameters
    ----------
    observations : Observations
        Corners, with the cameras' stated intrinsics.
    X, Y : dict of str to pose
        The start, T_targetcarrier_target and T_sensorcarrier_sensor in metres: the certified answer's.

    Raises
    ------
    CameraError
        The start puts a corner that was seen behind its camera, or intrinsics that are held as stated have no ray for
        one.
    CountError
        A time offset is free, and its sensor's images have no velocity of the carriers.
    FrameError
        The start lacks a frame, or options name one that is not there.
    OptionError
        An argument is of another type.
    OutlierError
        The corners are far from where the poses put them.
    PoseError
        A start is not a pose.
    UnderdeterminedError
        The images leave a frame's pose free.
    """
    check_arguments(observations, options)
    check_names(X, observations.targets, letter="X")
    check_names(Y, observations.sensors, letter="Y")
    options, tell = options or CornerOptions(), progress or silent
    check_options(options, observations)
    check_clocks(options, observations)
    model, point, noise, cameras = _stated(observations, X, Y, options)
    priors, first = model.camera_priors, model.camera_of
    check_spread(model.stacks)
    check_rays(model.stacks, options)
    _check_start(model, point)
    settled = _settled(model, point, noise, options, tell)
    tests = _innovations(settled, priors)
    for _ in range(WIDENINGS):
        before = settled.model.camera_priors
        now = {name: wider(before[name], test) for name, test in _innovations(settled, before).items()}
        if all(np.array_equal(now[name].deviation, before[name].deviation) for name in now):
            break
        settled = _settled(
            replace(settled.model, camera_priors=now), settled.point, settled.noise, options, tell, settled.iterations
        )
    point = settled.point
    check_motion(settled.model, point, settled.noise, settled.joint, settled.slots, farthest(settled.model, point))
    rms = _rms(settled)
    refined = CornersRefined(
        X={name: gtsam.Pose3(T) for name, T in point.X.items()},
        Y={name: gtsam.Pose3(T) for name, T in point.Y.items()},
        intrinsics={
            name: RefinedIntrinsics(
                camera.with_parameters(point.cameras[first[name]]),
                _block(settled, ("k", first[name])),
                settled.model.camera_priors[first[name]],
                float((settled.model.camera_priors[first[name]].deviation / priors[first[name]].deviation).max()),
                tests[first[name]],
                rms[name],
                options.lens_of(first[name]),
            )
            for name, camera in cameras.items()
        },
        shapes=point.shapes,
        corners={
            name: shaped(observations.corners[name], point.shapes[name])[0] + point.corners.get(name, 0.0)
            for name in model.targets
        },
        time_offsets_s={name: point.offsets_s[name] for name in settled.model.offset_priors},
        noise=settled.noise,
        joint=settled.joint,
        slots=settled.slots,
        freedom_of=settled.freedom_of,
        left_out={
            pair: stack.known[at] & (weights[at] == 0.0)
            for stack, weights in zip(model.stacks, settled.model.weights, strict=True)
            for pair, at in stack.pairs
        },
        graph=settled.graph,
        point=point,
        iterations=settled.iterations,
        last_step=settled.last_step,
    )
    return replace(refined, findings=findings_of(refined, options))


def _stated(
    observations: Observations, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], options: CornerOptions
) -> tuple[Model, Point, Noise, dict[str, Camera]]:
    """The model as it is stated, the start, rough noise, and the cameras with the lens models that are estimated."""
    first = {name: options.camera_of(name) for name in observations.sensors}
    stated = {name: options.stated_of(first[name]) for name in observations.sensors}
    lens = {name: options.lens_of(first[name]) for name in observations.sensors}
    cameras = {
        name: free_model(observations.cameras[first[name]], stated[name], lens[name]) for name in observations.sensors
    }
    priors = {first[name]: prior_of(camera, stated[name], lens[name]) for name, camera in cameras.items()}
    shapes = {
        name: np.append(options.size_share_of(name), np.full(len(WARPS), options.warp_m_of(name)))
        for name in observations.targets
    }
    # single corners are told of one target at a time
    stacks, A = stacks_of(
        replace(observations, cameras=cameras), lambda name: name if options.corners_m else tuple(shapes[name] > 0.0)
    )
    given = options.carrier_noise
    noise, about = ROUGH, options.about
    if isinstance(given, CarrierNoise):
        noise, about = Noise(ROUGH.corner_px, given.rotation_rad, given.translation_m), given.about
    elif given == "exact":
        noise = Noise(ROUGH.corner_px, 0.0, 0.0)
    model = Model(
        stacks, A, noise.carrier, about, first, priors,
        {name: shape for name, shape in shapes.items() if shape.any()},
        noise.corner_px, tuple(stack.known.astype(float) for stack in stacks),
        dict.fromkeys(options.time_offsets, OFFSET_S),
        dict.fromkeys(observations.targets, options.corners_m) if options.corners_m else {},
        observations.corner_px, {name: options.bias_px_of(name) for name in observations.targets},
    )  # fmt: skip
    point = Point(
        {name: one_transform(X[name], f"start of {name}") for name in observations.targets},
        {name: one_transform(Y[name], f"start of {name}") for name in observations.sensors},
        A,
        {name: prior.start(cameras[name].parameters) for name, prior in priors.items()},
        {name: np.zeros(SHAPE) for name in observations.targets},
        dict.fromkeys(options.time_offsets, 0.0),
        {name: np.zeros_like(observations.corners[name]) for name in observations.targets if options.corners_m},
    )
    return model, point, noise, cameras


def _settled(
    model: Model, point: Point, noise: Noise, options: CornerOptions, tell: Progress, iterations: int = 0
) -> _Settled:
    """Optimum, noise and outliers in turns, until the noise settles."""
    is_first, start = iterations == 0, point
    for number in range(ROUNDS):
        tell(f"refining from corners: round {number + 1} of at most {ROUNDS}")
        has_outliers = options.outliers and number == 0 and is_first
        graph, values, steps = optimum(model, point, options.max_iterations, ROUGHLY if has_outliers else EXACTLY)
        point, iterations = graph.point(values), iterations + steps
        before = noise
        if has_outliers:  # the noise is that of the corners that agree
            model = replace(model, weights=weights_of(model, point, noise, first=True))
        with told_where_it_fails(model, point):
            reduced = Reduced.of(model, point)
            noise = reduced.likeliest(noise, carrier=options.carrier_noise == "estimate")
        if few_corners(model):
            noise = replace(noise, corner_px=max(noise.corner_px, model.stated_px))
        weights = model.weights
        if options.outliers and not has_outliers:
            weights = weights_of(model, point, noise, first=False)
            if number > COMING_BACK:
                weights = tuple(np.minimum(now, before) for now, before in zip(weights, model.weights, strict=True))
        same = not has_outliers and all(np.array_equal(a, b) for a, b in zip(weights, model.weights, strict=True))
        if same and noise.change(before) < SETTLED:
            break
        common = tuple(noise.common_px * patterns(model, stack, point, OF_AN_IMAGE) for stack in model.stacks)
        model = replace(
            model, A_noise=noise.carrier, corner_px=noise.corner_px, weights=weights,
            common=common if noise.common_px else (),
        )  # fmt: skip
    check_corners(model, point)
    with told_where_it_fails(model, point):
        joint, last_step = graph.covariance(values, reduced.slots)
    check_determined(model, start, point, joint, reduced.slots)
    freedom_of = cache(partial(degrees_of_freedom, reduced, noise, carrier=options.carrier_noise == "estimate"))
    return _Settled(model, point, noise, graph, joint, reduced.slots, freedom_of, iterations, last_step)


def optimum(
    model: Model, start: Point, most: int = CornerOptions.max_iterations, tolerance: float = EXACTLY
) -> tuple[CornerGraph, gtsam.Values, int]:
    """The graph of a model, its optimum from a start, and how many steps it took.

    Gauss and Newton's steps; Levenberg and Marquardt's from the start where these fail.
    """
    graph = CornerGraph(model, start)
    values = first = graph.values(start)
    with told_where_it_fails(model, start):
        cost = graph.graph.error(values)
        for number in range(1, most + 1):
            try:
                moved = values.retract(graph.step(values))
            except np.linalg.LinAlgError:
                break
            after = graph.graph.error(moved)
            if not after <= cost * (1.0 + 1e-12):
                break
            values, gain, cost = moved, cost - after, after
            if number == most or gain <= max(tolerance * (cost + gain), LEAST_GAIN):
                return graph, values, number
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(most)
        parameters.setRelativeErrorTol(tolerance)
        parameters.setAbsoluteErrorTol(LEAST_GAIN)
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph.graph, first, parameters)
        return graph, optimiser.optimize(), optimiser.iterations()


def _check_start(model: Model, point: Point) -> None:
    for stack, error in zip(model.stacks, model.errors(point), strict=True):
        behind = np.asarray(~(np.abs(error) < BEHIND).reshape(*stack.known.shape, 2).all(axis=2))
        for (target, sensor), at in stack.pairs:
            if behind[at].any():
                raise CameraError(
                    f"the start puts {behind[at].sum()} of {stack.known[at].sum()} corners of {target} behind "
                    f"{sensor}, which saw them ({first_of(behind[at], stack.pixels[at])}); start at the certified "
                    "answer's poses"
                )


def _block(settled: _Settled, name: tuple[str, str]) -> Array:
    at = settled.slots[name]
    return settled.joint[at, at]


def _innovations(settled: _Settled, priors: Mapping[str, CameraPrior]) -> dict[str, Innovation]:
    return {
        name: innovation_of(settled.point.cameras[name], prior, _block(settled, ("k", name)))
        for name, prior in priors.items()
    }


def _rms(settled: _Settled) -> dict[str, float]:
    """Of the corners that count, along each axis, by sensor."""
    sums: dict[str, Array] = {}
    model = replace(settled.model, common=())
    for stack, error, weights in zip(model.stacks, model.errors(settled.point), model.weights, strict=True):
        of_stack = np.array([(error**2).sum() * model.corner_px**2, 2.0 * weights.sum()])
        sums[stack.sensor] = sums.get(stack.sensor, np.zeros(2)) + of_stack
    return {name: float(np.sqrt(total / max(count, 1.0))) for name, (total, count) in sums.items()}


@dataclass(frozen=True, eq=False)
class CornersCalibrated:
    """A calibration from corners."""

    #: The certified solution from the images' poses.
    solution: Solution
    #: The answer.
    refined: CornersRefined
    #: (V,) each. Images whose pose agrees with the others.
    inliers: dict[Pair, np.ndarray]
    #: What was refined from: the inliers, with first intrinsics in the place of unknown ones.
    observations: Observations

    def __str__(self) -> str:
        """The answer, and how many images it is from, in a few sentences."""
        left_out = sum(int((~mask).sum()) for mask in self.inliers.values())
        proof = "certified" if self.solution.certificate.is_certified else "not certified"
        return f"{self.refined} The start was {proof}; {left_out} images disagree with the others and are left out."

    def __repr__(self) -> str:
        return f"<CornersCalibrated: {self}>"


@one_blas_thread()
def calibrate_corners(
    observations: Observations, options: CornerOptions | None = None, progress: Progress | None = None
) -> CornersCalibrated:
    """Calibrate from corners: certified poses first, then all together.

    Cameras whose intrinsics are "unknown" in the options (`CornerOptions.stated`) are first calibrated by themselves;
    of what observations state for them only the size of images and the lens model count.

    Raises
    ------
    CameraError
        Unknown intrinsics cannot be estimated, or an image has no pose.
    OptionError
        An argument is of another type.
    TargetError
        A target is not flat.
    RwhecError
        As ``solve``, ``refine`` and ``refine_corners`` do.
    """
    check_arguments(observations, options)
    options, tell = options or CornerOptions(), progress or silent
    cameras = dict(observations.cameras)
    for sensor in observations.sensors:
        if options.stated_of(options.camera_of(sensor)) == "unknown":
            tell(f"estimating the intrinsics of {sensor}")
            cameras[sensor] = first_intrinsics(observations, sensor)
    observations = replace(observations, cameras=cameras)
    robust = RefineOptions(noise="estimate", robust="gnc")
    refined = solved_with_chosen_poses(
        observations, lambda problem: _refined(problem, robust, tell), lambda answer: (answer.X, answer.Y)
    )
    inliers = dict(refined.inliers)
    for _ in range(READMISSIONS):
        views = {
            pair: view.selected(good)
            for pair, view in observations.views.items()
            if (good := inliers[Pair(*pair)]).any()
        }
        kept = replace(observations, views=views)
        answer = refine_corners(kept, refined.X, refined.Y, options, tell)
        before, inliers = inliers, agreeing_by_corners(observations, inliers, answer)
        if all(np.array_equal(mask, before[pair]) for pair, mask in inliers.items()):
            break
    lenses = findings_of_images_left_out(observations, before)
    answer = replace(answer, findings=(*answer.findings, *lenses))
    return CornersCalibrated(refined.solution, answer, before, kept)


def _refined(problem: Problem, options: RefineOptions, tell: Progress) -> Refined:
    """Poses of the images, refined: a start. What they warn of, the answer's residuals show."""
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        return refine(problem, solve(problem, progress=tell), options, progress=tell)
