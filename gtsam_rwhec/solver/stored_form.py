"""The cost of a part from its moments: the quadratic form as it is stored, where raw measurements were not kept.

What comes out is about the stored form, and says nothing of the rounding of its entries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma
from gtsam_rwhec.solver.full_form import FullForm
from gtsam_rwhec.solver.point import Action, Evaluation, Point

#: numpy's widest real number: 80 bits on x86, 128 on aarch64 Linux, plain double elsewhere (looser bounds).
Wide = np.longdouble
#: Its unit roundoff.
WIDE_UNIT = float(np.finfo(Wide).eps) / 2.0
#: What rounding takes from a moment, as a part of it: an estimate, as the measurements that would tell are gone.
MOMENTS_UNIT = 2.0**-51


@dataclass(frozen=True)
class StoredForm:
    """x' Q x of a stored form, in extended precision."""

    form: FullForm

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
        """What the form does to directions."""
        wide = np.concatenate([V, np.zeros((1, V.shape[1]))]).astype(Wide)
        QV, error = self._times(wide)
        x = np.r_[evaluation.point.numbers.ravel(), evaluation.point.alpha, 1.0].astype(Wide)
        products, of_x = wide.T @ QV, QV.T @ x
        # V'QV and V'Q x cancel like Q V, whose error counts for more than that of the sums.
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
        """At most so many operations make an entry of a product: each block's sums, and the sums over blocks."""
        return gamma(13 * (self.form.leaves + self.form.centers) + 60, WIDE_UNIT)

    def _times(self, x: Array) -> tuple[Array, Array]:
        """Q x for x (13 n + 2, D), and a bound on its rounding, in doubles."""
        form = self.form
        blocks = (form.leaf, form.leaf_center, form.leaf_tail, form.center, form.center_tail, form.tail)
        return _product(blocks, x), self._unit * self._sizes(x) * (1.0 + 1e-9)

    def _sizes(self, x: Array) -> Array:
        """|Q| |x|, in doubles."""
        form = self.form
        blocks = (form.leaf, form.leaf_center, form.leaf_tail, form.center, form.center_tail, form.tail)
        return _product(tuple(np.abs(block) for block in blocks), np.abs(x).astype(float))


def _product(blocks: tuple[Array, ...], x: Array) -> Array:
    """The form's blocks times x (13 n + 2, D), in the precision of x."""
    leaf, leaf_center, leaf_tail, center, center_tail, tail = (block.astype(x.dtype) for block in blocks)
    L, P, D = len(leaf), len(center), x.shape[1]
    of_leaf, of_center, of_tail = (
        x[: 13 * L].reshape(L, 13, D),
        x[13 * L : -2].reshape(P, 13, D),
        x[-2:],
    )
    # Sums over no frame are left out: numpy's einsum gives anything for them in extended precision.
    first = np.einsum("lij,ljd->lid", leaf, of_leaf) + np.einsum("lit,td->lid", leaf_tail, of_tail)
    second = np.einsum("pij,pjd->pid", center, of_center) + np.einsum("pit,td->pid", center_tail, of_tail)
    third = np.zeros_like(of_tail)
    if L and P:
        first += np.einsum("lpij,pjd->lid", leaf_center, of_center)
        second += np.einsum("lpij,lid->pjd", leaf_center, of_leaf)
    if L:
        third += np.einsum("lit,lid->td", leaf_tail, of_leaf)
    if P:
        third += np.einsum("pit,pid->td", center_tail, of_center)
    third += tail @ of_tail
    result: Array = np.concatenate([first.reshape(13 * L, D), second.reshape(13 * P, D), third])
    return result


def _rounded(values: Array) -> Array:
    """What rounding to doubles takes."""
    result: Array = 2.0**-52 * np.abs(values).astype(float)
    return result
