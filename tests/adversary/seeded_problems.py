"""Calibration problems of every degeneracy, each of one seed; nothing of the library makes them.

``seeded(seed)`` draws a problem of any kind, ``seeded(seed, sane=True)`` one as sane users have: a motion that
determines everything, weights that tell the truth, the world's origin within a kilometre.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import seeded_motions as motions
from seeded_motions import MOTIONS, Long, Poses

import gtsam_rwhec as rw

#: Chances of the kinds, in percent: the motions', and two kinds that an issue names with figures.
KINDS = {
    "excited": 18,
    "one axis": 9,
    "nearly one axis": 5,
    "turntable": 6,
    "planar": 10,
    "pure rotation": 7,
    "no rotation": 6,
    "small rotation": 13,
    "half turns": 5,
    "still": 3,
    "two stations": 4,
    "micrometres": 7,
    "micrometres, 1000 km away": 7,
}
#: Seeds that are something else than their kind: chances up to this draw.
QUARTER_TURNS, MIRROR_TWINS, MANY, RELAXED = 0.04, 0.07, 0.074, 0.1
NONNEGATIVE, LOCAL, UNEVEN = 0.115, 0.13, 0.155
COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 14, 20, 40)
COUNT_CHANCES = np.array([3, 6, 16, 16, 14, 12, 12, 10, 6, 3.5, 1.5]) / 100.0


@dataclass(frozen=True)
class Batch:
    """Arguments of one call of ``add`` (of ``add_motion`` where both names are one)."""

    target: str
    sensor: str
    A: np.ndarray
    B: np.ndarray
    sigma: Any
    kappa: Any


@dataclass(frozen=True)
class Case:
    """One problem with what it was made of."""

    seed: int
    kind: str
    is_sane: bool
    scale: str
    batches: tuple[Batch, ...]
    truth: dict[str, np.ndarray]  #: matrices of all frames
    scales: dict[str, float]  #: true scales of targets and of sensors with motions
    fixed: dict[str, np.ndarray]
    priors: tuple[tuple[str, np.ndarray, float | None, float | None], ...]
    fixed_scales: dict[str, float]
    keep_measurements: bool
    as_sum: bool
    is_exact: bool  #: whether every rotation is orthonormal to rounding: the library must take it as it is
    method: str  #: of ``solve``
    has_nonnegative_scale: bool  #: whether ``solve`` gets that option
    traits: tuple[str, ...] = field(default=())

    def problem(self) -> rw.Problem:
        """The problem as a user states it; warnings are for the caller to hear."""
        parts = [rw.Problem(self.scale, keep_measurements=self.keep_measurements)]
        for index, batch in enumerate(self.batches):
            if self.as_sum and index:
                parts.append(rw.Problem(self.scale, keep_measurements=self.keep_measurements))
            if batch.target == batch.sensor:
                parts[-1].add_motion(batch.sensor, batch.A, batch.B, batch.sigma, batch.kappa)
            else:
                parts[-1].add(batch.target, batch.sensor, batch.A, batch.B, batch.sigma, batch.kappa)
        problem = sum(parts[1:], parts[0])
        for name, pose in self.fixed.items():
            problem.fix(name, pose)
        for name, pose, sigma, kappa in self.priors:
            problem.add_prior(name, pose, sigma, kappa)
        for name, scale in self.fixed_scales.items():
            problem.fix_scale(name, scale)
        return problem

    def solution(self, problem: rw.Problem) -> rw.Solution:
        """What a user gets of it."""
        options = rw.SolveOptions(nonnegative_scale=self.has_nonnegative_scale)
        if self.method != "local":
            return rw.solve(problem, self.method, options=options)
        X, Y = ({name: self.truth[name] for name in names} for names in (problem.targets, problem.sensors))
        X, Y = ({name: T for name, T in poses.items() if name not in problem.fixed} for poses in (X, Y))
        scale = self.scales if self.scale == "per_target" else next(iter(self.scales.values()))
        return rw.solve(problem, "local", initial=(X, Y, scale), options=options)


def seeded(seed: int, *, sane: bool = False) -> Case:
    """The problem of a seed."""
    return (_Sane if sane else _Any)(seed).case()


class _Draw(ABC):
    """The draws that make one problem, in their order."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = np.random.default_rng([seed, type(self).SALT])
        self.traits: list[str] = []

    SALT = 0
    #: How far stated poses may be from the truth, in metres and radians.
    ERRORS = (0.0, 1e-3, 1.0)

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def decades(self, low: float, high: float) -> float:
        return float(10 ** self.rng.uniform(low, high))

    # -- what a subclass decides --------------------------------------------------------------------------------

    @abstractmethod
    def kind(self) -> str:
        """The kind of problem, as the campaign counts it."""

    @abstractmethod
    def weights(self) -> tuple[float, float]:
        """sigma in metres, kappa."""

    @abstractmethod
    def noise(self) -> tuple[str, float]:
        """Where noise is ("B", "A", "AB" or "none"), and how many of the stated standard deviations."""

    @abstractmethod
    def offsets(self) -> tuple[float, float]:
        """Distances of the world's origin on the target carrier's side and on the sensor carrier's, in metres."""

    # -- the problem --------------------------------------------------------------------------------------------

    def case(self) -> Case:
        self.name = self.kind()
        special = 1.0 if isinstance(self, _Sane) else float(np.random.default_rng([self.seed, self.SALT, 1]).random())
        if special < MIRROR_TWINS:
            self.name = "quarter turns" if special < QUARTER_TURNS else "mirror twins"
        self.is_uneven = LOCAL <= special < UNEVEN
        self.is_many = MIRROR_TWINS <= special < MANY
        self.scale_mode = str(self.rng.choice(["known", "shared", "per_target"], p=[0.45, 0.3, 0.25]))
        self.sigma, self.kappa = self.weights()
        self.where, self.level = self.noise()
        far_target, far_sensor = self.offsets()
        self.origin_target = (far_target * motions.unit(self.rng)).astype(Long)
        self.origin_sensor = (far_sensor * motions.unit(self.rng)).astype(Long)
        edges = self.edges()
        frames = list(dict.fromkeys(name for edge in edges for name in edge))
        size = 1.0 if self.chance(0.8) else self.decades(-2, 1)
        if self.is_uneven:
            size = self.decades(-6, 5)
            self.traits.append("uneven")
        self.poses = {name: motions.random_pose(self.rng, size) for name in frames}
        self.alpha = self.scales(edges)
        self.base = motions.random_pose(self.rng), motions.random_pose(self.rng)
        if self.name == "mirror twins":
            self.poses = {name: (motions.about_z(self.rng), t) for name, (_, t) in self.poses.items()}
            self.base = tuple((motions.about_z(self.rng), t) for _, t in self.base)
        elif self.name == "quarter turns":
            whole = np.zeros(3, dtype=Long)
            self.poses = {
                n: (motions.quarter_turns(self.rng, 1)[0].astype(Long), t) for n, (_, t) in self.poses.items()
            }
            self.base = (np.eye(3, dtype=Long), whole), (np.eye(3, dtype=Long), whole)
        # Poses about the far origins.
        truth = {}
        for name, (R, t) in self.poses.items():
            origin = self.origin_target if name.startswith("target") else self.origin_sensor
            truth[name] = motions.doubles((R[None], (t + origin)[None]))[0]
        projected = self.may_be_rough() and self.chance(0.04)
        batches = tuple(batch for edge in edges for batch in self.batches(edge, projected))
        if projected:
            self.traits.append("projected")
        fixed, priors, fixed_scales = self.knowledge(frames, edges, truth)
        as_sum = len(batches) > 1 and self.chance(0.15)
        keep = not self.chance(0.08)
        has_nonnegative_scale = RELAXED <= special < NONNEGATIVE and self.scale_mode == "shared"
        method = "sdp" if MANY <= special < RELAXED else "auto"
        if NONNEGATIVE <= special < LOCAL:
            method = "local"
            self.traits.append("local")
        if method == "sdp" or has_nonnegative_scale:
            self.traits.append("relaxed")
        return Case(
            seed=self.seed,
            kind=self.name,
            is_sane=isinstance(self, _Sane),
            scale=self.scale_mode,
            batches=batches,
            truth=truth,
            scales=self.alpha,
            fixed=fixed,
            priors=priors,
            fixed_scales=fixed_scales,
            keep_measurements=keep,
            as_sum=as_sum,
            is_exact=not projected,
            method=method,
            has_nonnegative_scale=has_nonnegative_scale,
            traits=tuple(self.traits),
        )

    def edges(self) -> list[tuple[str, str]]:
        """Pairs: a sparse graph of up to four targets and four sensors, motions, sometimes two unconnected parts."""
        rng = self.rng
        draw = rng.random()
        if draw < 0.08:  # motions alone
            return [(name, name) for name in ("sensor0", "sensor1")[: 1 + (draw < 0.02)]]
        if draw < 0.55:
            targets, sensors = 1, 1
        elif draw < 0.9:
            targets, sensors = (int(n) for n in rng.integers(1, 3, 2))
        else:
            targets, sensors = (int(n) for n in rng.integers(1, 5, 2))
        names_t, names_s = [f"target{i}" for i in range(targets)], [f"sensor{i}" for i in range(sensors)]
        edges = [(t, s) for t in names_t for s in names_s]
        if len(edges) > 2 and self.chance(0.4):  # a tree, and some edges more
            order = rng.permutation(len(edges))
            joined: dict[str, int] = {}
            kept = []
            for e in order:
                t, s = edges[e]
                if joined.get(t, -1) != joined.get(s, -2) or t not in joined or self.chance(0.2):
                    first, second = joined.get(t, 100 + int(e)), joined.get(s, 200 + int(e))
                    joined = {name: first if part == second else part for name, part in joined.items()}
                    joined[t] = joined[s] = first
                    kept.append(edges[e])
            edges = kept
        if self.chance(0.06):
            edges.append(("sensor0", "sensor0"))
            self.traits.append("motions too")
        if self.chance(0.05):
            edges.append(("target8", "sensor8"))
            self.traits.append("unconnected")
        return edges

    def scales(self, edges: list[tuple[str, str]]) -> dict[str, float]:
        owners = list(dict.fromkeys(target for target, _ in edges))
        if self.scale_mode == "known":
            return dict.fromkeys(owners, 1.0)
        spread = 0.3 if isinstance(self, _Sane) or self.chance(0.7) else 3.0
        values = np.exp(spread * self.rng.standard_normal(len(owners)))
        if self.scale_mode == "shared":
            values[:] = values[0]
        return dict(zip(owners, values.tolist(), strict=True))

    def count(self) -> int:
        return int(self.rng.choice(COUNTS, p=COUNT_CHANCES))

    def batches(self, edge: tuple[str, str], projected: bool) -> list[Batch]:
        """The measurements of one pair, in one batch or several."""
        target, sensor = edge
        rng, n = self.rng, self.count()
        if self.is_many:
            n = int(rng.choice([300, 1100, 2100]))
        D = MOTIONS.get(self.name, MOTIONS["excited"])(rng, n)
        if self.is_uneven:  # stations next to one another and far apart, in one batch
            D = D[0], D[1] * 10 ** rng.uniform(-6, 5, (n, 1))
        (left, right), Y = self.base, self.poses[sensor]
        if target == sensor:
            A, X = motions.composed(motions.composed(left, D), motions.inverted(left)), Y
        else:
            A, X = motions.composed(motions.composed(left, D), right), self.poses[target]
        B = motions.composed(motions.composed(motions.inverted(Y), A), X)
        B = B[0], Long(self.alpha[target]) * B[1]
        sigma, kappa = self.spread_of_weights(n)
        turn = self.level * np.minimum(1.0 / np.sqrt(2.0 * kappa), 1.0)[..., None]
        shift = self.level * np.minimum(sigma, 10.0)[..., None]
        if "B" in self.where:
            B = self.perturbed(B, turn, shift)
        if "A" in self.where:
            A = self.perturbed(A, turn, shift)
        outliers = self.outliers(n)
        if outliers.any():
            wild = motions.random_rotations(rng, n), rng.standard_normal((n, 3)).astype(Long)
            B = np.where(outliers[:, None, None], wild[0], B[0]), np.where(outliers[:, None], wild[1], B[1])
        # The far origins: A becomes T(origin_sensor) A T(-origin_target).
        near = self.origin_sensor if target == sensor else self.origin_target
        A = A[0], A[1] + self.origin_sensor - (A[0] @ near[:, None])[..., 0]
        given_A, given_B = motions.doubles(A), motions.doubles(B)
        if n > 1 and self.chance(0.05):
            self.traits.append("duplicates")
            given_A[n // 2 :] = given_A[: n - n // 2]
            given_B[n // 2 :] = given_B[: n - n // 2]
        if self.chance(0.25):  # rotations as products of doubles leave them, not the nearest to exact ones
            for given in (given_A, given_B):
                other = motions.random_rotations(rng, 1)[0].astype(float)
                given[:, :3, :3] = (given[:, :3, :3] @ other) @ other.T
        if projected:
            given_A[:, :3, :3] = given_A[:, :3, :3].astype(np.float32)
            given_B[:, :3, :3] = given_B[:, :3, :3].astype(np.float32)
        cut = int(rng.integers(1, n)) if n > 1 and self.chance(0.15) else n
        result = []
        for part in (slice(0, cut), slice(cut, n)):
            if part.start < n:
                weights = [value if value.ndim == 0 else value[part] for value in (sigma, kappa)]
                given_weights = [float(value) if value.ndim == 0 else value for value in weights]
                result.append(Batch(target, sensor, given_A[part], given_B[part], *given_weights))
        return result

    def perturbed(self, T: Poses, turn: np.ndarray, shift: np.ndarray) -> Poses:
        n = len(T[0])
        R = T[0] @ motions.rotations(turn * self.rng.standard_normal((n, 3)))
        return R, T[1] + (shift * self.rng.standard_normal((n, 3))).astype(Long)

    def spread_of_weights(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self.sigma), np.array(self.kappa)

    def outliers(self, n: int) -> np.ndarray:
        return np.zeros(n, dtype=bool)

    def may_be_rough(self) -> bool:
        return False

    def knowledge(
        self, frames: list[str], edges: list[tuple[str, str]], truth: dict[str, np.ndarray]
    ) -> tuple[dict[str, np.ndarray], tuple[Any, ...], dict[str, float]]:
        """Fixed frames, priors and fixed scales."""
        rng = self.rng
        fixed: dict[str, np.ndarray] = {}
        priors: list[tuple[str, np.ndarray, float | None, float | None]] = []
        fixed_scales: dict[str, float] = {}
        if self.scale_mode == "per_target" and self.chance(0.6):
            owner = str(rng.choice(list(self.alpha)))
            fixed_scales[owner] = self.alpha[owner]
        if self.chance(0.12):
            name = str(rng.choice(frames))
            fixed[name] = self.near(truth[name], rng.choice(self.ERRORS, p=[0.4, 0.4, 0.2]))
            self.traits.append("fixed")
            if name in self.alpha and self.scale_mode == "per_target":
                fixed_scales[name] = self.alpha[name]
        if self.chance(0.18):
            for _ in range(int(rng.integers(1, 3))):
                name = str(rng.choice(frames))
                sigma, kappa = self.decades(-5, 1), self.decades(0, 9)
                what = rng.integers(3)
                pose = self.near(truth[name], rng.choice(self.ERRORS, p=[0.4, 0.4, 0.2]))
                priors.append((name, pose, None if what == 0 else sigma, None if what == 1 else kappa))
            self.traits.append("priors")
        return fixed, tuple(priors), fixed_scales

    def near(self, T: np.ndarray, distance: float) -> np.ndarray:
        """A pose near a matrix, or the matrix."""
        if not distance:
            return T
        R = T[:3, :3].astype(Long) @ motions.rotations(distance * self.rng.standard_normal((1, 3)))[0]
        # R is as orthonormal as T is, to rounding.
        return motions.doubles((R[None], (T[:3, 3] + distance * self.rng.standard_normal(3))[None]))[0]


class _Any(_Draw):
    """Every degeneracy."""

    SALT = 0x5EED

    def kind(self) -> str:
        names = list(KINDS)
        return str(self.rng.choice(names, p=np.array([KINDS[name] for name in names]) / sum(KINDS.values())))

    def weights(self) -> tuple[float, float]:
        if self.name.startswith("micro"):
            return 1e-6, self.decades(10, 13)
        if self.chance(0.5):
            return self.decades(-4, -1), self.decades(2, 7)
        self.traits.append("wild weights")
        return self.decades(-6, 3), self.decades(-2, 14)

    def noise(self) -> tuple[str, float]:
        if self.name.startswith("micro"):
            return "B", 1.0
        where = str(self.rng.choice(["B", "A", "AB", "none"], p=[0.45, 0.1, 0.25, 0.2]))
        level = 1.0 if self.chance(0.6) else self.decades(-3, 3)
        return where, 0.0 if where == "none" else level

    def offsets(self) -> tuple[float, float]:
        draw = self.rng.random()
        if self.name == "micrometres":
            far = self.decades(0, 3)
        elif self.name.startswith("micro"):
            far = 1e6
        elif draw < 0.5:
            return 0.0, 0.0
        else:
            far = self.decades(0, 3) if draw < 0.7 else self.decades(4, 6)
        sides = int(self.rng.integers(3))
        if far > 1.1e3:
            self.traits.append("far away")
        return (0.0 if sides == 0 else far), (0.0 if sides == 1 else far)

    def spread_of_weights(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        draw = self.rng.random()
        if draw < 0.75 or self.name.startswith("micro"):
            return np.array(self.sigma), np.array(self.kappa)
        width = 0.5 if draw < 0.85 else 3.0
        spread = 10 ** self.rng.uniform(-width, width, (2, n))
        return np.clip(self.sigma * spread[0], 1e-7, 1e4), np.clip(self.kappa * spread[1], 1e-3, 9e14)

    def outliers(self, n: int) -> np.ndarray:
        if self.name.startswith("micro") or not self.chance(0.08):
            return np.zeros(n, dtype=bool)
        self.traits.append("outliers")
        return self.rng.random(n) < 0.3

    def may_be_rough(self) -> bool:
        return not self.name.startswith("micro")


class _Sane(_Draw):
    """Problems as sane users have them."""

    SALT = 0x5A4E
    ERRORS = (0.0, 0.0, 0.0)

    def kind(self) -> str:
        return "excited"

    def weights(self) -> tuple[float, float]:
        return self.decades(-4, -1.5), self.decades(3, 7)

    def noise(self) -> tuple[str, float]:
        where = str(self.rng.choice(["B", "AB", "none"], p=[0.7, 0.2, 0.1]))
        return where, 0.0 if where == "none" else self.rng.uniform(0.3, 1.5)

    def offsets(self) -> tuple[float, float]:
        if self.chance(0.6):
            return 0.0, 0.0
        return self.decades(0, 3), self.decades(0, 3)

    def count(self) -> int:
        return int(self.rng.choice([4, 5, 6, 8, 12, 20, 40], p=[0.2, 0.2, 0.2, 0.2, 0.1, 0.07, 0.03]))
