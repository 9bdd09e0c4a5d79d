"""Measurements one by one, as a stream takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors.se3 import expmap

import gtsam_rwhec as rw


@dataclass(frozen=True)
class One:
    """One measurement."""

    target: str
    sensor: str
    A: np.ndarray
    B: np.ndarray
    stamp_ns: int
    sigma: float
    kappa: float

    def off_by(self, xi: Sequence[float]) -> One:
        """The same with another B."""
        return replace(self, B=self.B @ expmap(np.array([xi]))[0])


def ones_of(problem: rw.Problem) -> list[One]:
    """All measurements of a problem, in the order of stamps."""
    every = []
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        stamps = raw.stamps_ns if raw.stamps_ns is not None else np.arange(len(raw.A))
        each = zip(raw.A, raw.B, stamps.tolist(), raw.sigma.tolist(), raw.kappa.tolist(), strict=True)
        every += [One(*pair, *values) for values in each]
    return sorted(every, key=lambda one: one.stamp_ns)


def add(stream: rw.Stream, one: One, **others: object) -> rw.StreamUpdate:
    """Give a measurement to a stream."""
    stated = {"stamp_ns": one.stamp_ns, "sigma": one.sigma, "kappa": one.kappa} | others
    return stream.add(
        target=one.target,
        sensor=one.sensor,
        T_sensorcarrier_targetcarrier=one.A,
        T_sensor_target=one.B,
        **stated,  # type: ignore[arg-type]
    )


def streamed(ones: Sequence[One], knowledge: rw.Problem | None = None, **options: object) -> rw.Stream:
    """A stream that took measurements."""
    stream = rw.Stream(knowledge, options=rw.StreamOptions(**options))  # type: ignore[arg-type]
    for one in ones:
        add(stream, one)
    return stream


def farthest(first: rw.StreamUpdate | rw.Solution | rw.Calibration, second: object) -> float:
    """The largest difference of an entry of two answers' poses."""
    poses = [of.X | of.Y for of in (first, second)]  # type: ignore[attr-defined]
    assert poses[0].keys() == poses[1].keys()
    return max(float(np.abs(poses[0][name].matrix() - poses[1][name].matrix()).max()) for name in poses[0])
