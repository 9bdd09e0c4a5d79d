"""What a person should know of a calibration of odometries, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.clocks import Clock
from gtsam_rwhec.odometry.solved_windows import Answer, Task
from gtsam_rwhec.odometry.tracks import OdometryTrack
from gtsam_rwhec.odometry.up import upside_down

#: Correlation of neighbouring windows' residuals above which errors are not independent from step to step.
CORRELATED = 0.3
#: Correlation above which, with residuals of this part of the motions, a track is not of this vehicle, or is read in a
#: wrong way. A bias or a wrong scale has smaller residuals.
SAME, SAME_PART = 0.9, 0.2
#: Stated noise is doubted when residuals are so many times as large, or as small.
DOUBTED = 1.5
#: A clock that the refinement knows to this, s, needs no first guess.
CLOCK_KNOWN_S = 0.01
#: The refined answer is that of the proof if it is within so many standard deviations of it.
FAR = 10.0
#: A pose whose standard deviation along or about an axis is larger than this is said to be loose.
LOOSE_M, LOOSE_RAD = 0.2, float(np.radians(2.0))
#: More of a track than this left out is said.
MANY = 0.1


def residual_sizes(answer: Answer, names: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Root mean square of each sensor's residuals in their standard deviations, rotation and translation.

    A residual r against the fused motion of all sensors is smaller than the sensor's noise: the mean square of each
    entry is compared with the expected one.
    """
    windows, r, B = answer.windows, answer.fit.linear.r, answer.fit.linear.B
    V = np.linalg.inv(answer.W + ~windows.used[:, :, None, None] * np.eye(6))
    fused = np.linalg.inv(answer.fit.normal.D)
    expected = np.einsum("mnii->mni", V - B @ fused @ np.swapaxes(B, 2, 3))
    sizes = {}
    for k, name in enumerate(names):
        used = windows.used[k]
        square, mean = (r[k, used] ** 2).sum(axis=0), np.maximum(expected[k, used], 0.0).sum(axis=0)
        sizes[name] = tuple(
            float(np.sqrt(square[part].sum() / max(mean[part].sum(), 1e-300))) for part in (slice(0, 3), slice(3, 6))
        )
    return sizes  # type: ignore[return-value]


def findings_of(
    answer: Answer, task: Task, tracks: Sequence[OdometryTrack], clocks: Sequence[Clock], sigmas: dict[str, float]
) -> tuple[str, ...]:
    """The sentences; none where all is well. ``sigmas``: standard deviations of the clocks, s."""
    said: list[str] = []
    sizes = residual_sizes(answer, task.names)
    for k, name in enumerate(task.names):
        if task.stated[k] and not 1.0 / DOUBTED < max(sizes[name]) < DOUBTED:
            said.append(
                f"the residuals of {name} are {max(sizes[name]):.2g} times what its stated noise makes; state its true "
                "noise, or leave it out: it is estimated then"
            )
        share = max(correlations(answer, k))
        if share > CORRELATED and not _misfit(answer, k):
            factor = np.sqrt((1.0 + share) / (1.0 - share))
            said.append(
                f"the errors of {name} are alike from window to window (correlation {share:.2f}): they are no random "
                f"walk but drift (a wrong scale or a bias), and standard deviations may be {factor:.1f} times too small"
            )
        lost = int(answer.left_out[k].sum())
        if lost > MANY * answer.left_out.shape[1]:
            said.append(f"{name} contradicts the other sensors in {lost} of {answer.left_out.shape[1]} windows")
    said += [
        f"the clock of {track.sensor} was not found from its turning, and its offset was searched near "
        f"zero: {clock.unknown}"
        for track, clock in zip(tracks, clocks, strict=True)
        if clock.unknown and sigmas.get(track.sensor, 0.0) > CLOCK_KNOWN_S
    ]
    C = answer.freedom.covariance()
    for k, name in enumerate(task.names[1:], 1):
        sigma = np.sqrt(np.maximum(np.diagonal(C)[task.layout.at[k, :6]], 0.0))
        if not task.given.given.distances_m and (apart := _apart(answer, task, k, sigma)):
            said.append(f"the exact likelihood moved {name} by {apart}: the proof is of another answer")
        if sigma[3:].max() > LOOSE_M or sigma[:3].max() > LOOSE_RAD:
            said.append(
                f"{name} is known only to {sigma[3:].max():.2g} m and {np.degrees(sigma[:3].max()):.2g} degrees (one "
                "standard deviation): drive longer, with more turns about the axes that it lacks, or give what is known"
            )
    if not answer.fit.converged:
        said.append("the refinement stopped before it converged; the poses may be off by more than they say")
    return tuple(said)


def contradictions_of(answer: Answer, task: Task) -> tuple[str, ...]:
    """Tracks that do not fit at all, and what distances move: the certified answer is without them."""
    said = [
        f"the motions of {name} do not fit the other sensors': what differs is the same from window to window, and "
        f"{100 * part:.0f} % of the motion itself"
        for k, name in enumerate(task.names)
        if (part := _misfit(answer, k))
    ]
    if task.given.has_ground and task.given.given.ground is None:
        other_way = upside_down(task.given.normal, answer.fit.state.T)
        if other_way.sum() >= 0.0 and (other_way > 0.0).any():
            named = ", ".join(name for name, down in zip(task.names, other_way, strict=True) if down > 0.0)
            said.append(
                f"heights count upwards as {task.names[0]} stands, and beside it {named} would hang upside down. If it "
                f"is {task.names[0]} that hangs, all heights have the wrong sign: give the ground, with its up in the "
                f"axes of {task.names[0]}"
            )
    if not task.given.given.distances_m:
        return tuple(said)
    C = answer.freedom.covariance()
    for k, name in enumerate(task.names[1:], 1):
        sigma = np.sqrt(np.maximum(np.diagonal(C)[task.layout.at[k, :6]], 0.0))
        if apart := _apart(answer, task, k, sigma):
            said.append(f"the given distances contradict the motions: they moved {name} by {apart}")
    return tuple(said)


def _apart(answer: Answer, task: Task, k: int, sigma: Array) -> str:
    """How far a pose moved, if by more than ``FAR`` deviations along axes that no free direction reaches, or ""."""
    at = task.layout.at[k, :6]
    moved = np.abs(se3.logmap(se3.inverse(answer.certified.T[k][None]) @ answer.fit.state.T[k])[0])
    loose = answer.freedom.by_data[at]
    bound = (np.abs(loose) < 0.02).all(axis=1) if loose.size else np.ones(6, dtype=bool)
    if not (moved > FAR * np.maximum(sigma, 1e-9))[bound].any():
        return ""
    return (
        f"{1e3 * np.linalg.norm(moved[3:]):.3g} mm and {np.degrees(np.linalg.norm(moved[:3])):.2g} degrees from the "
        f"certified answer, more than {FAR:g} of its standard deviations"
    )


def remarks_of(task: Task) -> tuple[str, ...]:
    """What was assumed."""
    said: list[str] = []
    if len(task.names) == 2 and not task.stated.any():
        said.append(
            "the noise of two tracks cannot be told apart: both count as equally noisy. State the noise of one, or add "
            "a third sensor"
        )
    ground = task.given.given.ground
    if task.given.has_ground and ground is None:
        n = task.given.normal
        said.append(
            "heights count along the axis that the vehicle turned about, with up along "
            f"({', '.join(f'{x:.2f}' for x in n)}) of {task.names[0]}; give the ground if up is another way"
        )
    if ground is not None and task.given.normal[2] < -0.5:
        said.append(
            f"the given ground has its up along -z of {task.names[0]}: that sensor hangs upside down. If it does not, "
            "turn the sign of up, since all heights have the wrong sign"
        )
    return tuple(said)


def _misfit(answer: Answer, k: int) -> float:
    """The part of a sensor's motion that its residuals are, where they are large and alike, or zero."""
    windows, r = answer.windows, answer.fit.linear.r[k]
    motion = se3.logmap(windows.M[k])
    used, found = windows.used[k], 0.0
    for part, share in zip((slice(0, 3), slice(3, 6)), correlations(answer, k), strict=True):
        of_motion = np.sqrt((r[used, part] ** 2).sum() / max(float((motion[used, part] ** 2).sum()), 1e-300))
        if share > SAME and of_motion > SAME_PART:
            found = max(found, float(of_motion))
    return found


def correlations(answer: Answer, k: int) -> tuple[float, float]:
    """The correlation of a sensor's residuals with those of the window before, of rotations and of translations."""
    windows, r = answer.windows, answer.fit.linear.r[k]
    follows = windows.used[k, 1:] & windows.used[k, :-1] & (np.abs(windows.start[1:] - windows.end[:-1]) < 1e-6)
    if follows.sum() < 20:
        return 0.0, 0.0
    before, after = r[:-1][follows], r[1:][follows]
    product, squares = (before * after), np.stack([before**2, after**2])
    shares = (
        float(product[:, part].sum() / max(np.sqrt(squares[:, :, part].sum(axis=(1, 2)).prod()), 1e-300))
        for part in (slice(0, 3), slice(3, 6))
    )
    return next(shares), next(shares)
