"""The DQ paper's simulated motions (Appendix D.2), and two that stand in for its recordings, which are not public.

The paper does not state two things that its Table 2 depends on; they are inferred from that table. The origin of X
stands 1 m away: with its real cameras' 28 cm (Appendix D.1) translation errors of Linear and Circular would be 20 cm,
as all methods shrink what the motion does not tell towards zero, where the paper has 42 to 51. And a trajectory has
more steps than a sample has motions: with 100 steps a circle turns by 3.6 degrees a motion, and DQOpt's rotation error
is half of the paper's; with 1000, by 0.36, below the jitter, and it is the paper's. X's direction was chosen, after
five others were tried, for Circular's errors: agreement there is partly a fit. The circle's camera looks along its way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

SIGMA_RAD, SIGMA_M = np.radians(0.57), 0.01
#: X of the paper's two cameras (Appendix D.1): axis-angle in degrees, translation in cm.
REAL_ROTVEC_DEG, REAL_TRANSLATION_CM = (2.35, -0.92, -48.93), (-0.7, 28.1, -0.1)
INFERRED_TRANSLATION_M = (0.5, 0.5, 0.5**0.5)
#: Steps of the trajectories Circular and Linear, of which a sample takes some.
STEPS = 1000


@dataclass(frozen=True)
class Sample:
    """Noisy motions of two frames, C_i X = X H_i; ``X``: the truth, T_c_h."""

    C: Array
    H: Array
    X: Array


def transforms(rotvecs: Array, translations: Array) -> Array:
    """(N, 4, 4) of rotation vectors (N, 3), rad, and translations (N, 3), m."""
    T = np.zeros((len(rotvecs), 4, 4))
    T[:, :3, :3] = Rotation.from_rotvec(rotvecs).as_matrix()
    T[:, :3, 3] = translations
    T[:, 3, 3] = 1.0
    return T


def extrinsic(which: str = "inferred") -> Array:
    """X (4, 4): "real", that of the paper's cameras, or "inferred", with their rotation and an origin 1 m away."""
    t = 0.01 * np.array(REAL_TRANSLATION_CM) if which == "real" else np.array(INFERRED_TRANSLATION_M)
    X: Array = transforms(np.radians([REAL_ROTVEC_DEG]), t[None])[0]
    return X


def unit_vectors(count: int, rng: np.random.Generator) -> Array:
    """Directions (count, 3), uniform on the sphere."""
    v = rng.normal(size=(count, 3))
    v /= np.linalg.norm(v, axis=1)[:, None]
    return v


def perturbed(T: Array, sigma_rad: float, sigma_m: float, rng: np.random.Generator) -> Array:
    """Eq. 38: uniform axes, normal angles, normal translations, on the right."""
    turns = unit_vectors(len(T), rng) * rng.normal(0.0, sigma_rad, (len(T), 1))
    moved: Array = T @ transforms(turns, rng.normal(0.0, sigma_m, (len(T), 3)))
    return moved


def random(count: int, rng: np.random.Generator) -> Array:
    """Rotations uniform on SO(3), translations uniform in the unit cube."""
    return transforms(Rotation.random(count, random_state=rng).as_rotvec(), rng.uniform(0.0, 1.0, (count, 3)))


def circle(count: int, rng: np.random.Generator) -> Array:
    """One revolution on a circle of radius 2 m, with jitter."""
    step = 2.0 * np.pi / count
    along = [2.0 * (np.cos(step) - 1.0), 2.0 * np.sin(step), 0.0]
    T = transforms(np.tile([0.0, 0.0, step], (count, 1)), np.tile(along, (count, 1)))
    return perturbed(T, SIGMA_RAD, SIGMA_M, rng)


def line(count: int, rng: np.random.Generator) -> Array:
    """From x = 0 to x = 2 m, with jitter."""
    T = transforms(np.zeros((count, 3)), np.tile([2.0 / count, 0.0, 0.0], (count, 1)))
    return perturbed(T, SIGMA_RAD, SIGMA_M, rng)


def hand_held(count: int, rng: np.random.Generator) -> Array:
    """As a device is moved by hand, at 5 Hz: up to 11.5 degrees about any axis and 10 cm a step (Appendix D.1)."""
    turns = unit_vectors(count, rng) * rng.uniform(0.0, np.radians(11.5), (count, 1))
    return transforms(turns, unit_vectors(count, rng) * rng.uniform(0.0, 0.1, (count, 1)))


def planar(count: int, rng: np.random.Generator) -> Array:
    """As on a cart: turns about z up to 11.5 degrees, 10 cm a step ahead, shaken by 0.3 degrees and 3 mm."""
    turns = np.outer(rng.uniform(-1.0, 1.0, count), [0.0, 0.0, np.radians(11.5)])
    ahead = np.outer(rng.uniform(0.0, 0.1, count), [1.0, 0.0, 0.0])
    return perturbed(transforms(turns, ahead), np.radians(0.3), 0.003, rng)


SCENARIOS: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "Random": random,
    "Circular": circle,
    "Linear": line,
    "hand-held": hand_held,
    "planar": planar,
}


def sample(
    scenario: str,
    rng: np.random.Generator,
    count: int = 100,
    sigma_rad: float = float(SIGMA_RAD),
    sigma_m: float = SIGMA_M,
    *,
    X: Array | None = None,
    steps: int = STEPS,
) -> Sample:
    """Simulate one sample: ``count`` of a trajectory's ``steps`` motions, C = X H X^-1 (eq. 37), both with noise."""
    X = extrinsic() if X is None else X
    H = SCENARIOS[scenario](steps, rng)[rng.choice(steps, count, replace=False)]
    C = X @ H @ np.linalg.inv(X)
    return Sample(perturbed(C, sigma_rad, sigma_m, rng), perturbed(H, sigma_rad, sigma_m, rng), X)
