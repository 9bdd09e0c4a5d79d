"""What errors of a trajectory are made of, beside a random walk: biased rates, maps that bend, scales, clocks.

Each is a few effects c on the residuals of a sensor's windows, r = J d + B m + F c + e with c ~ N(0, tau^2) by kind; d
are the unknowns, m the windows' motions, e the random walk. With d and m eliminated, G is the information of c and b
its gradient; T = diag(tau) gives

    -2 l(tau) = log |I + T G T| - b' T (I + T G T)^-1 T b

(Patterson and Thompson 1971), whose derivative by log tau_i is 2 (1 - E[c_i^2] / tau_i^2), Fisher's identity. The
unknowns take the estimated effects' part, K = H^-1 H_dc, and their covariance K Cov(c) K' on top.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from rwhec_factors import se3
from scipy.optimize import minimize

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.window_likelihood import Eliminated, Layout, Linear
from gtsam_rwhec.odometry.window_motions import WindowMotions


class ErrorKind(Enum):
    """A kind of error, in words."""

    TURNING = "a bias of its turning"
    MOVING = "a bias of its moving"
    BENT = "a map that turns from place to place"
    STRETCHED = "a map that is stretched from place to place"
    SCALE = "a scale that drifts"
    CLOCK = "a clock that runs at another rate"


#: A scale changes at the beginnings of so many blocks of time.
BLOCKS = 8
#: Before the data, an effect has this share of a window's noise, which is next to nothing, and its logarithm this
#: standard deviation: what is there must raise twice the log likelihood by about 6.
EXPECTED, PRIOR = 0.003, 2.0
#: The search also begins at this share.
LARGE = 0.3
#: The logarithms are within this of what is expected.
FARTHEST = 8.0
#: A kind of error is named from this share on.
NAMED = 0.1
#: An effect that moves no window by more than this share of its noise is none.
NOTHING = 1e-9


@dataclass(frozen=True)
class TrajectoryErrors:
    """The effects that were found."""

    motion: Array  #: (m, n, 6): F c, what they do to each window's motion
    share: dict[tuple[int, ErrorKind], float]  #: by sensor and kind: tau, in units of a window's noise
    widening: Array  #: (p, p): their part of the unknowns' covariance
    equations: float  #: that they use up

    @staticmethod
    def none(windows: WindowMotions, layout: Layout) -> TrajectoryErrors:
        """No errors but the random walk."""
        return TrajectoryErrors(np.zeros((*windows.used.shape, 6)), {}, np.zeros((layout.size, layout.size)), 0.0)

    def taken_off(self, windows: WindowMotions) -> WindowMotions:
        """The motions as they would have been measured without them."""
        without = se3.expmap(-self.motion.reshape(-1, 6)).reshape(windows.M.shape)
        return replace(windows, M=windows.M @ without)

    def put_on(self, M: Array) -> Array:
        """Motions M (m, n, 4, 4) as they are measured with these errors."""
        found: Array = M @ se3.expmap(self.motion.reshape(-1, 6)).reshape(M.shape)
        return found

    def in_words(self, names: Sequence[str]) -> tuple[str, ...]:
        """A sentence about each sensor that has some."""
        said = []
        for k, name in enumerate(names):
            kinds = [kind.value for (of, kind), share in self.share.items() if of == k and share > NAMED]
            if kinds:
                said.append(
                    f"the track of {name} errs by more than a random walk, and this is taken off: {'; '.join(kinds)}"
                )
        return tuple(said)

    @staticmethod
    def found(
        windows: WindowMotions,
        linear: Linear,
        W: Array,
        normal: Eliminated,
        layout: Layout,
        inverse: Array,
        rest: Array,
    ) -> TrajectoryErrors:
        """From residuals that have all of them.

        ``inverse`` (p, p) is of the likelihood's second derivative by the unknowns, zero along what is free; ``rest``
        (p,) is the gradient of what is given beside the windows.
        """
        kinds, F = _columns(windows, layout, W)
        WF = [W[k] @ own for k, own in F.items()]
        at = np.cumsum([0, *(own.shape[2] for own in F.values())])
        n, q, p = len(windows), int(at[-1]), layout.size
        by_motion, H_cc, H_pc, b = np.zeros((n, 6, q)), np.zeros((q, q)), np.zeros((p + 1, q)), np.zeros(q)
        for (k, own), weighted, first, last in zip(F.items(), WF, at[:-1], at[1:], strict=True):
            here = slice(first, last)
            by_motion[:, :, here] = np.swapaxes(linear.B[k], 1, 2) @ weighted
            H_cc[here, here] = np.einsum("nia,nib->ab", own, weighted, optimize=True)
            J = linear.J[k] * layout.open[k]
            H_pc[layout.at[k], here] += np.einsum("nia,nib->ab", J, weighted, optimize=True)
            b[here] = np.einsum("nia,ni->a", weighted, linear.r[k])
        fused = np.linalg.solve(normal.D, by_motion)
        H_cc -= np.einsum("nia,nib->ab", by_motion, fused, optimize=True)
        H_pc = H_pc[:-1] - np.einsum("nia,nib->ab", normal.G, fused, optimize=True)
        b -= np.einsum("nia,ni->a", fused, normal.of_motion)
        G = H_cc - H_pc.T @ inverse @ H_pc
        b = b - H_pc.T @ inverse @ (normal.g - rest)
        names = list(dict.fromkeys(kinds))
        of = np.array([names.index(kind) for kind in kinds])
        values, vectors = np.linalg.eigh(0.5 * (G + G.T))  # what the unknowns take up leaves rounding
        G = (vectors * np.maximum(values, 0.0)) @ vectors.T
        tau = most_probable(G, b, of)
        V = np.linalg.inv(np.eye(q) + tau[:, None] * G * tau)
        covariance = tau[:, None] * V * tau
        c = covariance @ b
        motion = np.zeros((*windows.used.shape, 6))
        for (k, own), first, last in zip(F.items(), at[:-1], at[1:], strict=True):
            motion[k] = own @ c[first:last]
        K = inverse @ H_pc
        share = {name: float(tau[of == i][0]) for i, name in enumerate(names)}
        return TrajectoryErrors(motion, share, K @ covariance @ K.T, float(q - np.trace(V)))


def most_probable(G: Array, b: Array, of: np.ndarray) -> Array:
    """The standard deviations (q,) of effects, one for each kind ``of`` (q,) effects."""
    count = int(of.max()) + 1
    expected = np.log(EXPECTED)

    def height(logs: Array) -> tuple[float, Array]:
        tau = np.exp(logs[of])
        root = np.linalg.cholesky(np.eye(len(b)) + tau[:, None] * G * tau)
        inverse = np.linalg.inv(root)
        half = inverse @ (tau * b)
        unit = inverse.T @ half
        squares = unit**2 + (inverse**2).sum(axis=0)
        value = 2.0 * float(np.log(np.diagonal(root)).sum()) - float(half @ half)
        gradient = np.bincount(of, 2.0 * (1.0 - squares), count)
        away = (logs - expected) / PRIOR
        return value + float(away @ away), gradient + 2.0 * away / PRIOR

    bounds = [(expected - FARTHEST, expected + FARTHEST)] * count
    starts = (np.full(count, expected), np.full(count, np.log(LARGE)))
    tried = [minimize(height, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    found: Array = np.exp(min(tried, key=lambda one: float(one.fun)).x[of])
    return found


def _columns(windows: WindowMotions, layout: Layout, W: Array) -> tuple[list[tuple[int, ErrorKind]], dict[int, Array]]:
    """Of each effect its sensor and kind; by sensor the effects' columns F (n, 6, q), in units of a window's noise.

    Of two sensors only the difference is seen: the effects are those of the second.
    """
    kinds, columns = [], {}
    for k in range(windows.sensors) if windows.sensors > 2 else (1,):
        own, kept = [], windows.used[k]
        for kind, F in _effects(windows, layout, k):
            size = np.sqrt(np.einsum("nia,nij,nja->a", F, W[k], F, optimize=True) / max(int(kept.sum()), 1))
            there = size > NOTHING
            own.append(F[:, :, there] / size[there])
            kinds += [(k, kind)] * int(there.sum())
        columns[k] = np.concatenate(own, axis=2)
    return kinds, columns


def _effects(windows: WindowMotions, layout: Layout, k: int) -> Iterator[tuple[ErrorKind, Array]]:
    """The kinds of error of sensor k, and what they do (n, 6, q) to its measured motions (right perturbations)."""
    n, kept = len(windows), windows.used[k]
    M, end = windows.M[k], windows.T_end[k]
    back = se3.adjoint(se3.inverse(M))
    start = end @ se3.inverse(M)
    # A rate b makes Expmap(x) of Expmap(x + length b), where the way is a screw.
    of_rate = windows.length[k, :, None, None] * np.linalg.inv(se3.right_jacobian_inverse(se3.logmap(M)))
    yield ErrorKind.TURNING, of_rate[:, :, :3]
    yield ErrorKind.MOVING, of_rate[:, :, 3:]
    centre = end[kept, :3, 3].mean(axis=0)
    spread = max(float(end[kept, :3, 3].std()), 1e-9)

    def of_map(of_place: Array, rows: slice) -> Array:
        """A pose T of the map that is off by T Expmap(R' e_i f_j(place)): e_end - Ad(M^-1) e_start (n, 6, 3 j)."""
        ends = []
        for T, f in zip((end, start), of_place, strict=True):
            e = np.zeros((n, 6, 3, f.shape[1]))
            e[:, rows] = np.swapaxes(T[:, :3, :3], 1, 2)[..., None] * f[:, None, None, :]
            ends.append(e.reshape(n, 6, -1))
        found: Array = ends[0] - back @ ends[1]
        return found

    places = np.array([(T[:, :3, 3] - centre) / spread for T in (end, start)])
    products = np.array([p[:, [0, 0, 0, 1, 1, 2]] * p[:, [0, 1, 2, 1, 2, 2]] for p in places])
    with_one = np.pad(places, ((0, 0), (0, 0), (0, 1)), constant_values=1.0)
    yield ErrorKind.BENT, of_map(with_one, slice(0, 3))
    yield ErrorKind.STRETCHED, of_map(np.concatenate([places, products], axis=2), slice(3, 6))
    way = np.zeros((n, 6))
    way[:, 3:] = np.einsum("nji,nj->ni", M[:, :3, :3], M[:, :3, 3])
    blocks = np.arange(n)[:, None] * BLOCKS // n >= np.arange(layout.open[k, 6], BLOCKS)
    yield ErrorKind.SCALE, way[:, :, None] * blocks[:, None, :]
    if layout.open[:, 7].any():
        since = windows.start - windows.start.mean()
        yield ErrorKind.CLOCK, (windows.by_offset[k] * since[:, None])[:, :, None]
