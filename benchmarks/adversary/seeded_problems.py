"""Calibration problems of every degeneracy, each of one seed; nothing of the library makes them.

``seeded(seed)`` draws a problem of any kind, ``seeded(seed, sane=True)`` one as sane users have: a motion that
determines everything, weights that tell the truth, the world's origin within a kilometre.
"""

from __future__ import annotations

import numpy as np
from drawn_problems import Draw
from seeded_case import Case

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


def seeded(seed: int, *, sane: bool = False) -> Case:
    """The problem of a seed."""
    return (_Sane if sane else _Any)(seed).case()


class _Any(Draw):
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


class _Sane(Draw):
    """Problems as sane users have them."""

    SALT = 0x5A4E
    IS_SANE = True
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
