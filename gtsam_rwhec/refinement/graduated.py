"""Outlier rejection without a good start: graduated truncated least squares around the certified solver.

    minimise  sum_i min(d_i^2, c^2),    d_i^2 = kappa |R_A R_X - R_Y R_B|_F^2 + |alpha (...) - R_Y t_B|^2 / sigma^2

(Yang, Antonante, Tzoumas, Carlone: Graduated non-convexity for robust spatial perception, 2020, Section III. At the
truth d^2 has a chi-square distribution with 6 degrees of freedom; c^2 is a quantile of it.) For given weights the
problem is again a calibration problem, whose optimum comes from moments of the re-weighted measurements and from starts
that know nothing of the last one. So the scheme does not depend on a start: the scale of the fit to all measurements
may be negative. Fits on the way are not certified; what is kept at the end is solved once, with its certificate.
Graduation is a heuristic: afterwards the measurements of each frame with outliers vote on its pose (``voting``).

If the noise is unknown, d^2 has no unit at first. Least trimmed squares, which keep the better half of each pair, give
the first noise; the inliers give the next. If more than half of the measurements are outliers, they decide this noise,
and the estimate is wrong without a sign of it.

The threshold of graduation would leave out good measurements too, three of a thousand or more. So at the end all are
judged anew, each by a test that keeps all N good ones with 95 % (``admission``): where there are no outliers, nothing
is left out, and the rejection costs nothing. Where the fit to all measurements passes this test there is nothing to do.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import CountError, OutlierError, OutliersWarning, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import reweighted
from gtsam_rwhec.problem.variance_factors import VarianceFactors
from gtsam_rwhec.refinement.truncated_least_squares import Iteration, NoiseScale, TruncatedLeastSquares, inlier_count
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution

#: A warning names a frame or pair when the share of its measurements that agree is below this.
SUSPECT = 0.5
#: No sensor has a larger standard deviation about an axis, rad. A larger estimate comes from outliers.
GROSS_RAD = 0.35
#: A warning names at most this many frames and pairs.
NAMED = 5


@dataclass(frozen=True)
class Graduated:
    """A calibration from the measurements that agree with it."""

    #: The certified solution of the inliers, under the variance factors.
    solution: Solution
    #: In the order of ``problem.measurements``.
    inliers: dict[Pair, np.ndarray]
    #: Factors of the noise as given; 1 unless estimated.
    variance_factors: VarianceFactors
    #: c^2 at the end, a quantile of chi-square: the largest squared residual of an inlier where noise is given.
    threshold: float
    #: 1/2 sum min(d^2, c^2).
    truncated_cost: float
    #: Frames of which no measurement agrees; the solution lacks them.
    left_out: tuple[str, ...]
    #: Frames of which less than half of the measurements agree: the number that agrees, and the number of all.
    suspect: dict[str, tuple[int, int]]
    #: The same for pairs of which neither frame is suspect as a whole.
    suspect_pairs: dict[Pair, tuple[int, int]]
    #: The re-weighted fits, of all starts together; empty where the first fit shows that there is no outlier.
    history: tuple[Iteration, ...]
    #: Whether outliers were looked for. With noise that is not known, a few measurements cannot tell them from noise:
    #: then all count as inliers.
    searched: bool = True


@one_blas_thread()
def graduated(
    problem: Problem, *, confidence: float = 0.997, noise_scale: NoiseScale = "given", progress: Progress | None = None
) -> Graduated:
    """Reject outliers and calibrate from the inliers.

    Parameters
    ----------
    problem : Problem
        A problem that kept its raw measurements.
    confidence : float
        Probability that a good measurement is kept during graduation: c^2 is this quantile of chi-square with 6
        degrees of freedom. At the end each of N is kept with this probability or 1 - 0.05 / N, whichever is larger.
    noise_scale : "given" or "estimate"
        Take sigma and kappa (or covariances) as given; or multiply them by variance factors, one for rotations and one
        for translations, which are estimated from the inliers.
    progress : callable, optional
        Is called with each stage, its step, and the number of measurements that agree.

    Raises
    ------
    MeasurementsNotKeptError
        If the problem was made with ``keep_measurements=False``.
    OutlierError
        If too few measurements agree with each other for an answer, or give a scale that is not positive.

    Warns
    -----
    OutliersWarning
        If less than half of a frame's measurements agree, or less than half of all measurements (then sigma and kappa
        may be too small). One bad tag among many does not stop the calibration: its own pose rests on the measurements
        that agree, and the other poses do not use the rejected ones.
    """
    tell = progress or silent
    work = TruncatedLeastSquares(problem, confidence, tell)
    try:
        fit, keep = work.run(noise_scale)
        tell("certifying the inliers' solution")
        weights = work.measured.by_pair(keep.astype(np.float64))
        solution = solve(reweighted(problem, weights, work.factors), progress=tell)
    except ScaleError as error:
        raise OutlierError(
            f"the {problem.number_of_measurements} measurements have no answer with a positive scale in which most of "
            f"them agree ({error}). Check that A and B are not exchanged or inverted, and the names of targets"
        ) from error
    except (UnderdeterminedError, CountError) as error:
        raise OutlierError(
            f"too few of the {problem.number_of_measurements} measurements agree for an answer ({error}). With "
            f"confidence={confidence} a measurement agrees if it is within {np.sqrt(work.threshold):.3g} standard "
            "deviations. If sigma and kappa may be too small, take noise='estimate'; else check that B = "
            "T_sensor_target, that A and B are of the same instant, and the names of targets"
        ) from error
    inliers = work.measured.by_pair(keep)
    counts = {name: inlier_count(name, inliers) for name in problem.targets + problem.sensors}
    left_out = tuple(name for name, (good, _) in counts.items() if good == 0)
    suspect = {name: (good, total) for name, (good, total) in counts.items() if good < SUSPECT * total}
    suspect_pairs = {
        pair: (int(mask.sum()), len(mask))
        for pair, mask in inliers.items()
        if mask.sum() < SUSPECT * len(mask) and not any(name in suspect for name in pair)
    }
    if not work.searches:
        warnings.warn(
            f"{problem.number_of_measurements} measurements are too few to tell outliers from noise that is not known: "
            "all of them count. Measure more, or give sigma and kappa (noise='given')",
            OutliersWarning,
            stacklevel=2,
        )
    _warn(keep, suspect, suspect_pairs, left_out, work.threshold, noise_scale)
    rotation_rad = float(np.sqrt(0.5 * work.factors.rotation / np.median(work.measured.kappa)))
    if noise_scale == "estimate" and work.searches and rotation_rad > GROSS_RAD:
        warnings.warn(
            f"the estimated noise, {np.degrees(rotation_rad):.0f} degrees an axis, is too large for a sensor: more "
            "than half of the measurements may be outliers. Give sigma and kappa and take noise='given', which "
            "withstands more outliers",
            OutliersWarning,
            stacklevel=3,
        )
    return Graduated(
        solution=solution,
        inliers=inliers,
        variance_factors=work.factors,
        threshold=work.threshold,
        truncated_cost=0.5 * work.truncated(work.distances(fit)),
        left_out=left_out,
        suspect=suspect,
        suspect_pairs=suspect_pairs,
        history=tuple(work.history),
        searched=work.searches,
    )


def _warn(
    keep: np.ndarray,
    suspect: dict[str, tuple[int, int]],
    suspect_pairs: dict[Pair, tuple[int, int]],
    left_out: tuple[str, ...],
    threshold: float,
    noise_scale: NoiseScale,
) -> None:
    """Warn if less than half of the measurements agree: of all, or of some frames and pairs."""
    named = [
        f"{name} ({good} of {total}{': left out' if name in left_out else ''})"
        for name, (good, total) in sorted(suspect.items(), key=lambda item: item[1][0] / item[1][1])
    ]
    named += [f"{pair} ({good} of {total})" for pair, (good, total) in suspect_pairs.items()]
    if keep.sum() < SUSPECT * len(keep):
        message = (
            f"only {int(keep.sum())} of {len(keep)} measurements agree to within {np.sqrt(threshold):.3g} standard "
            "deviations; "
        )
        if noise_scale == "given":
            message += "if sigma and kappa may be too small, take noise='estimate'; else check the names of frames"
        else:
            message += "check the frame convention, the stamps, and the names of targets"
    elif named:
        more = f" and {len(named) - NAMED} more" if len(named) > NAMED else ""
        message = (
            f"less than half of the measurements agree with the answer for {', '.join(named[:NAMED])}{more}. Check "
            "whether the frame has moved, or has another frame's name. The poses rest on the measurements that agree"
        )
    else:
        return
    warnings.warn(message, OutliersWarning, stacklevel=4)
