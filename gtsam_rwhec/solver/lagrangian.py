"""The product of Z = Q' - Lambda and a vector in extended precision, with a bound on its rounding."""

from __future__ import annotations

from typing import Any

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import CONSTRAINTS_FLAT
from gtsam_rwhec.solver.verified import gamma

#: numpy's widest real number: 80 bits on x86, 128 on aarch64 Linux, plain double elsewhere (looser bounds).
Wide = np.longdouble
#: Its unit roundoff.
WIDE_UNIT = float(np.finfo(Wide).eps) / 2.0


def lagrangian(form: ReducedForm, multipliers: Array, x: Array) -> tuple[Any, Array, float, Array]:
    """x'Zx and Z x for x (9 n + 1,), Z = Q' - Lambda, in extended precision, each with a bound on its rounding.

    Returns x'Zx, Z x (9 n + 1,), the bound for x'Zx, and the bounds (9 n + 1,) for Z x.
    """
    n, split = form.rotations, 9 * form.leaves
    wide_x = x.astype(Wide)

    def evaluate(y: Array, stored: tuple[Array, ...], Lambda: Array, minus: int) -> Array:
        """(D, C, E) y - G'(G y) - Lambda y; with absolute values and minus = -1, the size that bounds the rounding."""
        D, C, E, G = stored
        leaf, border = y[:split], y[split:]
        local = np.empty((n, 10), dtype=y.dtype)
        local[:, :9], local[:, 9] = y[:-1].reshape(n, 9), y[-1]
        product = np.einsum("nij,nj->ni", Lambda, local)
        result = np.empty_like(y)
        result[:split] = np.einsum("lij,lj->li", D, leaf.reshape(-1, 9)).ravel() + C @ border
        result[split:] = C.T @ leaf + E @ border
        result -= minus * (G.T @ (G @ y))
        result[:-1] -= minus * product[:, :9].ravel()
        result[-1] -= minus * product[:, 9].sum()
        return result

    stored = (form.D, form.wide, form.E, form.G)
    Lambda = (multipliers.astype(Wide) @ CONSTRAINTS_FLAT.astype(Wide)).reshape(n, 10, 10)
    z = evaluate(wide_x, tuple(m.astype(Wide) for m in stored), Lambda, 1)
    size_Lambda = (np.abs(multipliers) @ np.abs(CONSTRAINTS_FLAT)).reshape(n, 10, 10)
    size = evaluate(np.abs(x), tuple(np.abs(m) for m in stored), size_Lambda, -1)
    # At most this many operations make an entry of z; sums within sums add their counts.
    unit = gamma(2 * form.size + len(form.G) + 60, WIDE_UNIT)
    z_error = unit * size * (1.0 + gamma(4 * form.size))
    value = wide_x @ z
    value_error = float(np.abs(x) @ (z_error + unit * size)) * (1.0 + gamma(2 * form.size))
    return value, z, value_error, z_error
