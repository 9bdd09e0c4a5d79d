"""Makes the record of a calibration from the solver's answer: poses in the requested frame, covariance, findings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from rwhec_factors import se3
from scipy.special import chdtrc, chdtri

from gtsam_rwhec.calibration.known_frames import MOST_M, MOST_RAD, VERTICAL_RAD, deviations_of
from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.fitting.block_agreement import Scatter, most_beyond_chance, scatter_about, too_much
from gtsam_rwhec.geometry.odometry_track import OdometryNoise, OdometryTrack
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.odometry_record import Influence, OdometryCalibration, OtherAnswer, Windows
from gtsam_rwhec.odometry.prior_knowledge import Given, KnownPose, upside_down
from gtsam_rwhec.odometry.track_comparison import Clock, inverted_in_words
from gtsam_rwhec.odometry.window_likelihood import OFFSET, SCALE, Linear, eliminated
from gtsam_rwhec.odometry.window_motions import axes_turned
from gtsam_rwhec.odometry.window_solution import REACHES, Answer, Task, refined, seven_each
from gtsam_rwhec.results.log_history import Removed
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeReason, free_directions_of, reason_for, sparse_basis


def calibration_of(
    answer: Answer,
    task: Task,
    tracks: Sequence[OdometryTrack],
    reference: str,
    offsets: Array,
    clocks: Sequence[Clock],
    removed: dict[str, tuple[Removed, ...]],
    origin_ns: int,
) -> OdometryCalibration:
    """The record of the calibration, made from the answer."""
    names, layout, state = task.names, task.layout, answer.fit.state
    sensors = (reference, *(name for name in names if name != reference))
    change, T, order = _in_frame_of(reference, task, state.T)
    scaled = [name for k, name in enumerate(names) if task.scaled[k]]
    scatter = _scatter_of_blocks(answer, task, change, order)
    worst = too_much(scatter)
    ratio = 1.0 if worst is None else worst.ratio
    C, covariance, narrowed = (
        answer.freedom.covariance(times) + times * answer.errors.widening
        for times in (1.0, ratio, ratio * _at_most(scatter))
    )
    covariance, narrowed = change @ covariance @ change.T, change @ narrowed @ change.T
    left = change @ answer.freedom.left
    if left.shape[1]:
        reached = (np.abs(left) > REACHES * np.abs(left).max(axis=0)).any(axis=1)
        for each in (covariance, narrowed):
            each[reached], each[:, reached] = 0.0, 0.0
            each[reached, reached] = np.inf
    free = _free_directions(answer, task)
    certificate = answer.certificate
    others = other_answers(
        answer, task, lambda pose: dict(zip(order, _in_frame_of(reference, task, pose)[1], strict=True))
    )
    if free and certificate.status is Status.CERTIFIED:
        certificate = replace(certificate, status=Status.CERTIFIED_NOT_UNIQUE)
    back = float(offsets[names.index(reference)])
    clock_at = [int(layout.at[k, OFFSET]) for k in range(len(names))]
    sigmas = _clock_sigmas(C, clock_at, names, reference) if layout.open[:, OFFSET].any() else {}
    window, sizes = answer.windows, _residual_sizes(answer, names)
    return OdometryCalibration(
        reference=reference,
        sensors=sensors,
        T_reference_sensor={reference: np.eye(4), **dict(zip(order, T, strict=True))},
        scales={name: float(state.scale[names.index(name)]) for name in scaled},
        time_offsets_s={name: float(offsets[names.index(name)]) - back for name in order},
        time_offset_sigmas_s=sigmas,
        order=order,
        covariance=covariance,
        certificate=certificate,
        free_directions=free,
        windows=Windows(
            seconds=float(np.median(window.end - window.start)),
            count=len(window),
            used={name: int(window.used[k].sum()) for k, name in enumerate(names)},
            start_ns=origin_ns + np.round(window.start * 1e9).astype(np.int64),
            end_ns=origin_ns + np.round(window.end * 1e9).astype(np.int64),
        ),
        noise={name: OdometryNoise(*(float(x) for x in np.sqrt(answer.variances[k]))) for k, name in enumerate(names)},
        noise_was_found=frozenset(name for k, name in enumerate(names) if not task.stated[k]),
        removed=removed,
        residuals=sizes,
        influences=_influences(answer, task, change, order),
        others=others,
        findings=(*_findings(answer, task, tracks, clocks, sigmas, sizes), *_of_blocks(worst)),
        remarks=(*_remarks(task), *answer.errors.in_words(names)),
        narrowed=narrowed,
    )


#: The windows are cut into so many blocks of time, with at least so many windows in each.
BLOCKS, FEWEST_IN_BLOCK = (2, 4, 8), 8


def _scatter_of_blocks(answer: Answer, task: Task, change: Array, order: tuple[str, ...]) -> list[Scatter]:
    """How much blocks of time scatter, for each number of them and for the sensor for which it is most by chance."""
    linear, count = answer.fit.linear, len(answer.windows)
    found: list[Scatter] = []
    inverse, still = answer.freedom.inverse(), np.zeros(task.layout.size)
    for blocks in BLOCKS if not answer.freedom.left.shape[1] else ():
        if count < blocks * FEWEST_IN_BLOCK:
            continue
        parts = []
        for rows in np.array_split(np.arange(count), blocks):
            there = Linear(linear.r[:, rows], linear.J[:, rows], linear.B[:, rows])
            normal = eliminated(there, answer.W[:, rows], task.layout)
            parts.append((normal.H, normal.g))
        found += most_beyond_chance(
            scatter_about(name, change[6 * k : 6 * k + 6], "time", parts, still, inverse)
            for k, name in enumerate(order)
        )
    return found


#: Blocks that scatter less than expected narrow the covariance: to what it is at most, but for this chance.
TOO_NARROW = 0.05


def _at_most(scatter: list[Scatter]) -> float:
    """The largest factor of the covariance that some cut into blocks leaves possible, 1 at most.

    White noise of a pose, as motion capture has it, is taken back in the next window, and no walk.
    """
    possible = (one.ratio * one.freedom / float(chdtri(one.freedom, 1.0 - TOO_NARROW)) for one in scatter)
    return min(1.0, max(possible, default=1.0))


def _of_blocks(worst: Scatter | None) -> tuple[Finding, ...]:
    """The finding that blocks disagree by far; the covariance is already as much larger."""
    if worst is None or not worst.is_by_far:
        return ()
    return (Finding(Ground.CORRELATED, f"{worst}: its errors are no random walk, and last for long"),)


#: A pose contradicts the motions where chance makes such a difference in fewer drives than this.
BY_CHANCE = 1e-3


def contradiction(answer: Answer, task: Task, T: Array, pose: KnownPose) -> str:
    """How a known pose contradicts the motions, which did without it, in words; empty where it does not.

    ``T`` (m, 4, 4) are the motions' poses, in the frame of the first sensor; along what they leave free it may be any.
    """
    rows = replace(task.given, given=Given(poses=(pose,))).rows(replace(answer.fit.state, T=T), task.layout)
    at = [i for i, number in enumerate(rows.numbers) if not number.unit]
    change, _, order = _in_frame_of(task.names[0], task, answer.fit.state.T)
    worst = too_much(_scatter_of_blocks(answer, task, change, order))
    covariance = answer.freedom.covariance(1.0 if worst is None else worst.ratio) + answer.errors.widening
    along, sizes, _ = np.linalg.svd(rows.J[at] @ answer.freedom.left)
    told = along[:, int((sizes > REACHES * sizes.max(initial=0.0)).sum()) :].T
    off, J = told @ rows.r[at], told @ rows.J[at]
    square = float(off @ np.linalg.solve(np.eye(len(off)) + J @ covariance @ J.T, off))
    if not len(off) or chdtrc(len(off), square) > BY_CHANCE:
        return ""
    return f"it is {np.sqrt(square / len(off)):.2g} times as far from where the motions put the two as both claim"


def _in_frame_of(reference: str, task: Task, T: Array) -> tuple[Array, Array, tuple[str, ...]]:
    """The matrix (d, p) from unknowns to the record's tangents and scales; the poses (m - 1, 4, 4); their names.

    With T_r the reference's pose in the frame of sensor 0, a pose is T_r^-1 T_k, and its tangent x_k - Ad(pose^-1) x_r.
    """
    names, layout = task.names, task.layout
    r = names.index(reference)
    order = tuple(name for name in names if name != reference)
    at = [names.index(name) for name in order]
    poses = se3.inverse(T[r][None]) @ T[at]
    scales = [k for k in range(len(names)) if task.scaled[k]]
    change = np.zeros((6 * len(at) + len(scales), layout.size + 1))
    back = se3.adjoint(se3.inverse(poses))
    for row, k in enumerate(at):
        rows = slice(6 * row, 6 * row + 6)
        if k:
            change[rows, layout.at[k, :6]] += np.eye(6)
        if r:
            change[rows, layout.at[r, :6]] -= back[row]
    for row, k in enumerate(scales):
        change[6 * len(at) + row, layout.at[k, SCALE]] = 1.0
    return change[:, :-1], poses, order


def _clock_sigmas(C: Array, at: list[int], names: tuple[str, ...], reference: str) -> dict[str, float]:
    """Standard deviations (s) of the offsets to the reference's clock."""
    padded = np.pad(C, ((0, 1), (0, 1)))
    r = at[names.index(reference)]
    return {
        name: float(np.sqrt(max(padded[k, k] + padded[r, r] - 2.0 * padded[k, r], 0.0)))
        for name, k in zip(names, at, strict=True)
        if name != reference
    }


def _free_directions(answer: Answer, task: Task) -> tuple[FreeDirection, ...]:
    left = answer.freedom.left
    if not left.shape[1]:
        return ()
    names = task.names[1:]
    windows, fit = answer.windows, answer.fit
    variance = 1.0 / float((1.0 / answer.variances[:, 0]).sum())
    turned, squares, _ = axes_turned(windows, fit.state.motion, variance)
    residual = float(np.sqrt((fit.linear.r[..., :3] ** 2).sum(axis=2)[windows.used].mean()))
    reason = reason_for(min(turned, 2), float(np.sqrt(squares.sum())), residual, len(windows))
    if reason is FreeReason.CONTRADICTION:
        reason = FreeReason.NOISE
    basis = sparse_basis(seven_each(left, task.layout), 1.0)
    return free_directions_of(names, basis, 1.0, dict.fromkeys(names, reason))


def _influences(answer: Answer, task: Task, change: Array, order: tuple[str, ...]) -> tuple[Influence, ...]:
    """The influence of each given number: dx / dg = (information)^-1 row' / sigma, with its whitened row."""
    rows = answer.fit.rows
    result = []
    inverse, C = answer.freedom.inverse(), answer.freedom.covariance()
    for r, row, number in zip(rows.r, rows.J, rows.numbers, strict=True):
        if not (number.what and number.unit):
            continue
        moved = (change @ inverse @ row / number.sigma)[: 6 * len(order)].reshape(-1, 6)
        spare = 1.0 - float(row @ C @ row)
        result.append(
            Influence(
                number.what,
                number.value,
                number.sigma,
                number.unit,
                {name: _twist(twist) for name, twist in zip(order, moved, strict=True)},
                {name: _twist(twist * number.sigma) for name, twist in zip(order, moved, strict=True)},
                off_by=abs(float(r)) / np.sqrt(spare) if spare > 1e-3 else 0.0,
            )
        )
    return tuple(result)


def _twist(x: Array) -> tuple[float, float, float, float, float, float]:
    a, b, c, d, e, f = (float(v) for v in x)
    return a, b, c, d, e, f


#: If residuals of neighbouring windows correlate more than this, errors are not independent between steps.
CORRELATED = 0.3
#: If residuals correlate more than this, and exceed this share of the motions, a track is of another vehicle or is
#: read wrongly. A bias or a wrong scale has smaller residuals.
SAME, SAME_PART = 0.9, 0.2
#: Stated noise is doubted if residuals are larger or smaller by more than this factor.
DOUBTED = 1.5
#: If the refinement knows a time offset to this standard deviation (s), a missing first guess does not matter.
CLOCK_KNOWN_S = 0.01
#: The proof also covers a refined answer within this many standard deviations of the certified one.
FAR = 10.0
#: A pose with a larger standard deviation along or about an axis is reported as poorly known.
LOOSE_M, LOOSE_RAD = 0.2, float(np.radians(2.0))
#: A height is what is poorly known where its deviation is this share of the largest.
MOSTLY = 0.9
#: A sensor is reported if more than this share of the windows is left out of its track.
MANY = 0.1


def _upright(answer: Answer) -> Array | None:
    """The vertical (3,) in the axes of the first sensor, where its z axis is what the vehicle turned about most."""
    axis = axes_turned(answer.windows, answer.fit.state.motion, 1.0)[2][0]
    return axis * np.sign(axis[2]) if abs(axis[2]) > np.cos(VERTICAL_RAD) else None


def poorly_known(name: str, T: Array, covariance: Array, upright: Array | None, first: str) -> Finding:
    """The finding about a poorly known pose T (4, 4), by its covariance (6, 6): of its height, if that is why."""
    rad, m = deviations_of(covariance)
    is_nothing = rad > MOST_RAD or m > MOST_M
    more = "drive longer, with more turns about the axes that it lacks, or give what is known"
    if upright is not None:
        along = upright @ T[:3, :3]
        deviation = float(np.sqrt(max(float(along @ covariance[3:, 3:] @ along), 0.0)))
        if deviation > max(LOOSE_M, MOSTLY * m):
            words = (
                f"the height of {name} over {first} (along the z axis of {first}) is {upright @ T[:3, 3]:.3g} +- "
                f"{deviation:.2g} m (one standard deviation): the vehicle hardly turns about other axes"
            )
            return Finding(Ground.KNOWN_TO_NOTHING if is_nothing else Ground.HEIGHT_WEAK, words)
    words = f"{name} is known only to {m:.2g} m and {np.degrees(rad):.2g} degrees (one standard deviation): {more}"
    return Finding(Ground.KNOWN_TO_NOTHING if is_nothing else Ground.COVARIANCE_DOUBTED, words)


def _residual_sizes(answer: Answer, names: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Root mean square of each sensor's residuals over the expected one, for rotation and translation.

    The fused motion includes the sensor, so the residual against it is smaller than the sensor's noise. The expected
    mean square takes this into account.
    """
    windows, r, B = answer.windows, answer.fit.linear.r, answer.fit.linear.B
    V = np.linalg.inv(answer.W + ~windows.used[:, :, None, None] * np.eye(6))
    fused = np.linalg.inv(answer.fit.normal.D)
    expected = np.einsum("mnii->mni", V - B @ fused @ np.swapaxes(B, 2, 3))
    is_used = windows.used[..., None]
    squares, means = (
        (x * is_used).reshape(*x.shape[:2], 2, 3).sum(axis=(1, 3)) for x in (r**2, np.maximum(expected, 0))
    )
    sizes = np.sqrt(squares / np.maximum(means, 1e-300))
    return {name: (float(turn), float(way)) for name, (turn, way) in zip(names, sizes, strict=True)}


def _findings(
    answer: Answer,
    task: Task,
    tracks: Sequence[OdometryTrack],
    clocks: Sequence[Clock],
    sigmas_s: dict[str, float],
    sizes: dict[str, tuple[float, float]],
) -> Iterator[Finding]:
    """What speaks against the poses: ``sigmas_s`` of time offsets, ``sizes`` of residuals over the expected ones."""

    def doubted(words: str) -> Finding:
        return Finding(Ground.COVARIANCE_DOUBTED, words)

    def contradicted(words: str) -> Finding:
        return Finding(Ground.CONTRADICTED, words)

    yield from map(contradicted, inverted_in_words(tracks))
    for k, name in enumerate(task.names):
        if task.stated[k] and not 1.0 / DOUBTED < max(sizes[name]) < DOUBTED:
            yield doubted(
                f"the residuals of {name} are {max(sizes[name]):.2g} times what its stated noise makes; state its true "
                "noise, or leave it out: it is estimated then"
            )
        shares = _correlations(answer, k)
        if part := _misfit(answer, k, shares):
            yield contradicted(
                f"the motions of {name} do not fit the other sensors': what differs is the same from window to window, "
                f"and {100 * part:.0f} % of the motion itself"
            )
        elif (share := max(shares)) > CORRELATED:
            factor = np.sqrt((1.0 + share) / (1.0 - share))
            yield doubted(
                f"the errors of {name} are alike from window to window (correlation {share:.2f}): they are no random "
                f"walk but drift (a wrong scale or a bias), and standard deviations may be {factor:.1f} times too small"
            )
        lost, there = int(answer.left_out[k].sum()), answer.left_out.shape[1]
        if lost > MANY * there:
            yield doubted(f"{name} contradicts the other sensors in {lost} of {there} windows")
    for track, clock in zip(tracks, clocks, strict=True):
        if clock.unknown and sigmas_s.get(track.sensor, 0.0) > CLOCK_KNOWN_S:
            yield doubted(
                f"the clock of {track.sensor} was not found from its turning, and its offset was searched near "
                f"zero: {clock.unknown}"
            )
    C = answer.freedom.covariance()
    for k, name in enumerate(task.names[1:], 1):
        sigma = np.sqrt(np.maximum(np.diagonal(C)[task.layout.at[k, :6]], 0.0))
        apart = _apart(answer, task, k, sigma)
        if apart and task.given.given.distances_m:
            yield contradicted(f"the given distances contradict the motions: they moved {name} by {apart}")
        elif apart:
            yield doubted(f"the exact likelihood moved {name} by {apart}: the proof is of another answer")
        if sigma[3:].max() > LOOSE_M or sigma[:3].max() > LOOSE_RAD:
            at = task.layout.at[k, :6]
            yield poorly_known(name, answer.fit.state.T[k], C[np.ix_(at, at)], _upright(answer), task.names[0])
    if not answer.fit.converged:
        yield doubted("the refinement stopped before it converged; the poses may be off by more than they say")
    if task.given.has_ground and task.given.given.ground is None:
        other_way = upside_down(task.given.normal, answer.fit.state.T)
        if other_way.sum() >= 0.0 and (other_way > 0.0).any():
            named = ", ".join(name for name, down in zip(task.names, other_way, strict=True) if down > 0.0)
            yield contradicted(
                f"heights count upwards as {task.names[0]} stands, and beside it {named} would hang upside down. If it "
                f"is {task.names[0]} that hangs, all heights have the wrong sign: give the ground, with its up in the "
                f"axes of {task.names[0]}"
            )


def _apart(answer: Answer, task: Task, k: int, sigma: Array) -> str:
    """How far a pose moved, in words; "" if less than ``FAR`` standard deviations along all determined axes."""
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


def _remarks(task: Task) -> tuple[str, ...]:
    """Sentences about the assumptions."""
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


def _misfit(answer: Answer, k: int, shares: Array) -> float:
    """Residuals as a share of the sensor's motion, if they are large and correlate by large ``shares``; else zero."""
    windows, used = answer.windows, answer.windows.used[k]
    r, motion = answer.fit.linear.r[k, used], se3.logmap(windows.M[k, used])
    parts = np.sqrt(_products(r, r) / np.maximum(_products(motion, motion), 1e-300))
    return float(parts[(shares > SAME) & (parts > SAME_PART)].max(initial=0.0))


def _products(x: Array, y: Array) -> Array:
    """Sums (2,) of products of twists (N, 6): of the rotations, and of the translations."""
    sums: Array = (x * y).reshape(-1, 2, 3).sum(axis=(0, 2))
    return sums


def _correlations(answer: Answer, k: int) -> Array:
    """The correlations (2,) of a sensor's residuals with those of the previous window: rotations, translations."""
    windows, r = answer.windows, answer.fit.linear.r[k]
    follows = windows.used[k, 1:] & windows.used[k, :-1] & (np.abs(windows.start[1:] - windows.end[:-1]) < 1e-6)
    if follows.sum() < 20:
        return np.zeros(2)
    before, after = r[:-1][follows], r[1:][follows]
    squares = _products(before, before) * _products(after, after)
    return _products(before, after) / np.sqrt(np.maximum(squares, 1e-300))


#: An answer fits equally well if its cost is at most this much above the best one's: two standard deviations.
ALIKE = 2.0
#: Two answers are the same if no sensor differs by more than this, metres.
SAME_M = 1e-3


def other_answers(answer: Answer, task: Task, named: Callable[[Array], dict[str, Array]]) -> tuple[OtherAnswer, ...]:
    """Refine again from the mirror image of each distance's free shift; keep answers that fit equally well.

    A distance does not change if the sensor's free shift is mirrored: the sensor may be above or below.
    """
    given, free = task.given.given, answer.freedom
    if not given.distances_m or not free.by_data.shape[1]:
        return ()
    found: list[OtherAnswer] = []
    state = answer.fit.state
    determined = free.complement()
    for first, second in given.distances_m:
        j, k = task.given.place[first], task.given.place[second]
        for moving, fixed in ((k, j), (j, k)):
            if moving == 0:
                continue
            axis = _free_shift(answer, task, moving)
            if axis is None:
                continue
            T = state.T.copy()
            apart = T[moving, :3, 3] - T[fixed, :3, 3]
            T[moving, :3, 3] -= 2.0 * axis * float(axis @ apart)
            fit = refined(answer.windows, answer.W, replace(state, T=T), task.layout, task.given, determined)
            moved = float(np.linalg.norm(fit.state.T[:, :3, 3] - state.T[:, :3, 3], axis=1).max())
            above = fit.cost - answer.fit.cost
            if fit.converged and moved > SAME_M and above < ALIKE:
                why = (
                    f"the distance of {first} and {second} has two signs: {task.names[moving]} may be "
                    f"{moved:.3g} m away, on the other side"
                )
                found.append(OtherAnswer(why, named(fit.state.T), above))
                break
    return tuple(found)


def _free_shift(answer: Answer, task: Task, k: int) -> Array | None:
    """The unit direction (3,), in the frame of sensor 0, along which the drive leaves sensor k free to shift."""
    rows = answer.freedom.by_data[task.layout.at[k, 3:6]]
    U, s, _ = np.linalg.svd(answer.fit.state.T[k, :3, :3] @ rows)
    if not len(s) or s[0] < 0.05:
        return None
    return U[:, 0]
