"""The measurements of a problem as rows: those that were given, or those that the library holds."""

from __future__ import annotations

import numpy as np
from seeded_case import Case
from stated_cost import Rows

import gtsam_rwhec as rw

#: Rotations with R'R off by more than this are projected; the library says the same of its own.
ROUNDING = 1e-13


def given_rows(case: Case, problem: rw.Problem) -> Rows:
    """Rows of a case; where rotations are to be projected, as the library holds them."""
    if case.is_exact or not case.keep_measurements:
        blocks = [(b.target, b.sensor, b.A, b.B, b.sigma, b.kappa) for b in case.batches]
    else:
        blocks = []
        for target, sensor in problem.pairs:
            raw = problem.measurements(target, sensor)
            blocks.append((target, sensor, raw.A, raw.B, raw.sigma, raw.kappa))
    return rows(blocks, problem)


def rows(blocks: list[tuple], problem: rw.Problem) -> Rows:
    """Rows of measurements (target, sensor, A, B, sigma, kappa), with a problem's knowledge."""
    frames = tuple(dict.fromkeys(name for target, sensor, *_ in blocks for name in (target, sensor)))
    owners = tuple(dict.fromkeys(target for target, *_ in blocks))
    counts = [len(block[2]) for block in blocks]
    A, B = (_projected(np.concatenate([block[k] for block in blocks])) for k in (2, 3))
    sigma, kappa = (
        np.concatenate([np.broadcast_to(np.asarray(b[k], float), n) for b, n in zip(blocks, counts, strict=True)])
        for k in (4, 5)
    )
    known = dict.fromkeys(owners, 1.0) if problem.scale == "known" else dict(problem.fixed_scales)
    return Rows(
        frames=frames,
        R_A=A[:, :3, :3],
        t_A=A[:, :3, 3],
        R_B=B[:, :3, :3],
        t_B=B[:, :3, 3],
        sigma=sigma,
        kappa=kappa,
        X=np.repeat([frames.index(block[0]) for block in blocks], counts),
        Y=np.repeat([frames.index(block[1]) for block in blocks], counts),
        owner=np.repeat([owners.index(block[0]) for block in blocks], counts),
        owners=owners,
        known_scales=known,
        shares_scale=problem.scale == "shared",
        fixed={name: T for name, T in problem.fixed.items() if name in frames},
        priors=tuple(
            (name, p.transform, p.sigma, p.kappa)
            for name, beliefs in problem.priors.items()
            if name not in problem.fixed  # a constant, of which the cost says nothing
            for p in beliefs
        ),
    )


def _projected(T: np.ndarray) -> np.ndarray:
    """Poses with the nearest rotations in place of those that are off by more than rounding."""
    R = T[:, :3, :3]
    off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2)) > ROUNDING
    if not off.any():
        return T
    result = T.copy()
    near = R[off].astype(np.longdouble)
    for _ in range(5):  # Newton and Schulz (Higham 2008, eq. 8.20)
        near = near @ (3 * np.eye(3) - near.transpose(0, 2, 1) @ near) / 2
    result[off, :3, :3] = near
    return result
