"""The draws that make one problem of a seed, in their order; nothing of the library makes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import seeded_motions as motions
from seeded_case import Batch, Case
from seeded_motions import MOTIONS, Long, Poses

#: Seeds that are something else than their kind: chances up to this draw.
QUARTER_TURNS, MIRROR_TWINS, MANY, RELAXED = 0.04, 0.07, 0.074, 0.1
NONNEGATIVE, LOCAL, UNEVEN = 0.115, 0.13, 0.155
COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 14, 20, 40)
COUNT_CHANCES = np.array([3, 6, 16, 16, 14, 12, 12, 10, 6, 3.5, 1.5]) / 100.0


class Draw(ABC):
    """The draws that make one problem, in their order."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = np.random.default_rng([seed, type(self).SALT])
        self.traits: list[str] = []

    SALT = 0
    #: Whether problems are those of sane users.
    IS_SANE = False
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
        special = 1.0 if self.IS_SANE else float(np.random.default_rng([self.seed, self.SALT, 1]).random())
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
            is_sane=self.IS_SANE,
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
        spread = 0.3 if self.IS_SANE or self.chance(0.7) else 3.0
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
