"""Rotations that are rotations exactly: of quaternions (..., 4) in pairs of doubles, of any length, w first."""

from __future__ import annotations

from fractions import Fraction

import double_double as dd
import numpy as np
from double_double import Pairs

#: R = (sum over a <= b of ROTATION[i, j, a, b] q_a q_b) / |q|^2
ROTATION = np.zeros((3, 3, 4, 4))
for _i in range(3):
    ROTATION[_i, _i, 0, 0] = 1.0
    for _j in range(3):
        ROTATION[_i, _i, 1 + _j, 1 + _j] = 1.0 if _i == _j else -1.0
        if _i != _j:
            ROTATION[_i, _j, 1 + min(_i, _j), 1 + max(_i, _j)] = 2.0
for _i, _j, _k, _sign in ((0, 1, 2, -1), (1, 2, 0, -1), (2, 0, 1, -1), (1, 0, 2, 1), (2, 1, 0, 1), (0, 2, 1, 1)):
    ROTATION[_i, _j, 0, 1 + _k] = 2.0 * _sign
_ROTATION = ROTATION.reshape(9, 16)
_NORM = np.eye(4).ravel()
#: (p q)_c = sum PRODUCT[c, a, b] p_a q_b
PRODUCT = np.zeros((4, 4, 4))
for _c, _rows in enumerate(
    (
        ((0, 0, 1), (1, 1, -1), (2, 2, -1), (3, 3, -1)),
        ((0, 1, 1), (1, 0, 1), (2, 3, 1), (3, 2, -1)),
        ((0, 2, 1), (1, 3, -1), (2, 0, 1), (3, 1, 1)),
        ((0, 3, 1), (1, 2, 1), (2, 1, -1), (3, 0, 1)),
    )
):
    for _a, _b, _sign in _rows:
        PRODUCT[_c, _a, _b] = _sign
_PRODUCT = PRODUCT.reshape(4, 16)


def _outer(p: Pairs, q: Pairs) -> Pairs:
    product = dd.multiplied(p.at((..., slice(None), None)), q.at((..., None, slice(None))))
    shape = (*product.hi.shape[:-2], 16)
    return Pairs(product.hi.reshape(shape), product.lo.reshape(shape))


def _combined(table: np.ndarray, terms: Pairs) -> Pairs:
    """Sums of the terms (..., 16) with small whole numbers (n, 16), which change no digit."""
    return dd.summed(table * terms.hi[..., None, :], table * terms.lo[..., None, :])


def rotations(q: Pairs) -> Pairs:
    """(..., 3, 3)."""
    squares = _outer(q, q)
    norm = dd.summed(_NORM * squares.hi, _NORM * squares.lo)
    turned = dd.multiplied(_combined(_ROTATION, squares), dd.reciprocal(norm).at((..., None)))
    shape = (*q.hi.shape[:-1], 3, 3)
    return Pairs(turned.hi.reshape(shape), turned.lo.reshape(shape))


def turned(q: Pairs, omega: np.ndarray) -> Pairs:
    """q times the quaternion of R Expmap(omega), omega (..., 3), and of length near 1."""
    angle = np.linalg.norm(omega, axis=-1, keepdims=True)
    half = 0.5 * omega * np.sinc(angle / (2.0 * np.pi))
    step = np.concatenate([np.cos(0.5 * angle), half], axis=-1)
    product = _combined(_PRODUCT, _outer(q, Pairs.of(step)))
    length = 1.0 / np.linalg.norm(product.hi, axis=-1, keepdims=True)
    return dd.multiplied(product, Pairs.of(length))


def nearest(R: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) next to rotations (..., 3, 3)."""
    K = np.empty((*R.shape[:-2], 4, 4))  # its leading eigenvector is the quaternion (Bar-Itzhack 2000)
    K[..., 0, 0] = np.trace(R, axis1=-2, axis2=-1)
    K[..., 0, 1], K[..., 0, 2], K[..., 0, 3] = (R[..., j, k] - R[..., k, j] for j, k in ((2, 1), (0, 2), (1, 0)))
    K[..., 1:, 0] = K[..., 0, 1:]
    K[..., 1:, 1:] = R + np.swapaxes(R, -1, -2) - K[..., :1, :1] * np.eye(3)
    return np.linalg.eigh(K)[1][..., -1]


def exactly(q: list[Fraction]) -> list[list[Fraction]]:
    """The rotation of a rational quaternion."""
    norm = sum(v * v for v in q)
    products = [a * b for a in q for b in q]
    entries = [sum(int(c) * p for c, p in zip(row, products, strict=True) if c) / norm for row in _ROTATION]
    return [entries[0:3], entries[3:6], entries[6:9]]
