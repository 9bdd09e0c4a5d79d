"""The cost of a part from its moments: the quadratic form as it is stored, where raw measurements were not kept.

The results are about the stored form, and do not include the rounding of its entries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma
from gtsam_rwhec.solver.answers import Action, Evaluation, Point
from gtsam_rwhec.solver.block_matrix import BlockMatrix

#: numpy's widest real number: 80 bits on x86, 128 on aarch64 Linux, plain double elsewhere (looser bounds).
Wide = np.longdouble
#: Its unit roundoff.
WIDE_UNIT = float(np.finfo(Wide).eps) / 2.0
#: The relative rounding error of a moment: an estimate, as the measurements are no longer there.
MOMENTS_UNIT = 2.0**-51


@dataclass(frozen=True)
class StoredForm:
    """x' Q x of a stored form, in extended precision."""

    form: BlockMatrix

    def at(self, point: Point) -> Evaluation:
        """The cost at values of the variables."""
        x = np.r_[point.numbers.ravel(), point.alpha, 1.0][:, None].astype(Wide)
        Qx, error = self._times(x)
        cost = (x * Qx).sum()
        cost_error = float((np.abs(x) * error).sum()) + self._unit * float((np.abs(x) * self._sizes(x)).sum())
        gradient = Qx[:-1, 0]
        return Evaluation(
            point,
            float(cost),
            cost_error,
            gradient.astype(float),
            error[:-1, 0] + _rounded(gradient),
            MOMENTS_UNIT * float((np.abs(x) * self._sizes(x)).sum()),
        )

    def action(self, evaluation: Evaluation, V: Array) -> Action:
        """The form's products with directions."""
        wide = np.concatenate([V, np.zeros((1, V.shape[1]))]).astype(Wide)
        QV, error = self._times(wide)
        x = np.r_[evaluation.point.numbers.ravel(), evaluation.point.alpha, 1.0].astype(Wide)
        products, of_x = wide.T @ QV, QV.T @ x
        # V'QV and V'Q x cancel like Q V; the error of Q V is larger than that of these sums.
        size = self._sizes(wide)
        products_error = (np.abs(wide).T @ (error + self._unit * size)).astype(float)
        of_x_error = (np.abs(x) @ (error + self._unit * size)).astype(float)
        return Action(
            QV[:-1].astype(float),
            error[:-1] + _rounded(QV[:-1]),
            products.astype(float),
            products_error + _rounded(products),
            of_x.astype(float),
            of_x_error + _rounded(of_x),
            sizes=(size[:-1], np.abs(V).T @ size[:-1], size.T @ np.abs(x).astype(float)),
        )

    @property
    def _unit(self) -> float:
        """Relative rounding of a product's entry, from its operations: each block's sums, and the sums over blocks."""
        return gamma(13 * len(self.form.frames) + 60, WIDE_UNIT)

    def _times(self, x: Array) -> tuple[Array, Array]:
        """Q x for x (13 n + 2, D), and a bound on its rounding, in doubles."""
        return self.form.times(x), self._unit * self._sizes(x) * (1.0 + 1e-9)

    def _sizes(self, x: Array) -> Array:
        """|Q| |x|, in doubles."""
        return self.form.sizes(x.astype(float))


def _rounded(values: Array) -> Array:
    """A bound on the error of rounding to doubles."""
    return 2.0**-52 * np.abs(values).astype(float)
