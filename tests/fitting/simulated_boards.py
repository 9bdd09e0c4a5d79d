"""Cells whose board was printed or made with errors: each corner is off its place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from simulated_cells import BOARD, Cell, cell

from gtsam_rwhec.cameras.targets import Checkerboard


@dataclass(frozen=True)
class Misprinted(Checkerboard):
    """A checkerboard with corners that are off their places by a normal draw along each axis, metres."""

    deviation_m: float = 0.0
    seed: int = 0

    def off(self) -> NDArray[np.float64]:
        """(n, 3), metres."""
        return np.random.default_rng(self.seed).normal(scale=self.deviation_m, size=super().corners().shape)

    def corners(self) -> NDArray[np.float64]:
        return super().corners() + self.off()


def misprinted(
    seed: int, deviation_m: float, board: Checkerboard = BOARD, **others: Any
) -> tuple[Cell, NDArray[np.float64]]:
    """A cell as `cell` makes it, whose observations have the board as it should be; and what each corner is off it."""
    made = Misprinted(board.name, board.columns, board.rows, board.square_m, deviation_m=deviation_m, seed=seed)
    given = cell(seed, board=made, **others)
    return replace(given, observations=replace(given.observations, corners={"board": board.corners()})), made.off()
