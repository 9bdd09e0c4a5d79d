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
from gtsam_rwhec.solver.full_form import PAIRS_AT_ONCE

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
        return _product(self.form, x, size=False), self._unit * self._sizes(x) * (1.0 + 1e-9)

    def _sizes(self, x: Array) -> Array:
        """|Q| |x|, in doubles."""
        return _product(self.form, np.abs(x).astype(float), size=True)


def _product(form: BlockMatrix, x: Array, *, size: bool) -> Array:
    """The form, or the absolute values of its entries, times x (13 n + 2, D), in the precision of x."""
    n, D = len(form.frames), x.shape[1]
    ends = form.ends
    of_frames, of_tail = x[:-2].reshape(n, 13, D), x[-2:]
    result, last = np.zeros((n, 13, D), dtype=x.dtype), _as(form.tail, x, size=size) @ of_tail
    for begin in range(0, n, PAIRS_AT_ONCE):
        at = slice(begin, begin + PAIRS_AT_ONCE)
        frames, tails = _as(form.frames[at], x, size=size), _as(form.tails[at], x, size=size)
        result[at] = np.einsum("nij,njd->nid", frames, of_frames[at]) + np.einsum("nit,td->nid", tails, of_tail)
        last += np.einsum("nit,nid->td", tails, of_frames[at])
    for begin in range(0, len(form.couplings), PAIRS_AT_ONCE):
        at = slice(begin, begin + PAIRS_AT_ONCE)
        couplings, first, second = _as(form.couplings[at], x, size=size), ends[0][at], ends[1][at]
        np.add.at(result, first, np.einsum("fij,fjd->fid", couplings, of_frames[second]))
        np.add.at(result, second, np.einsum("fij,fid->fjd", couplings, of_frames[first]))
    whole: Array = np.concatenate([result.reshape(13 * n, D), last])
    return whole


def _as(blocks: Array, x: Array, *, size: bool) -> Array:
    """Blocks, or their absolute values, in the precision of x."""
    result: Array = (np.abs(blocks) if size else blocks).astype(x.dtype, copy=False)
    return result


def _rounded(values: Array) -> Array:
    """A bound on the error of rounding to doubles."""
    result: Array = 2.0**-52 * np.abs(values).astype(float)
    return result
