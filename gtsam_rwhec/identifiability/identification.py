"""What the motion can and cannot determine (RWHEC paper Section 6, design fact 8).

Noise excites every direction a little, so the rank decides nothing on real data. A direction counts as *free* when the
motions give no more information about it than noise alone would create if the true motions left the direction open
(``noise_bounds.pair_noise``). The test divides the information by that of noise alone. For a free direction this ratio
follows an F distribution: squares of noise are divided by a noise variance that nu equations to spare tell. N
measurements have two squares each; tilts of the direction at both its ends fit four of them away. The threshold is the
99.9 % quantile, so a free direction counts as determined once in a thousand times. Three measurements have three to six
equations of rotations to spare and need a ratio of 50 to 9, a hundred measurements need 1.4.

Rotation residuals depend on rotations only, so rotations are tested first. If all are determined, the second test is
about translations and scales at those rotations. If not, one test of everything uses all residuals together.

Corollaries 2 and 4 are the same test on one pair: rotations about two distinct axes leave nothing free. Information
adds along the graph, and the whole is tested as the pairs are. So Theorems 1 and 3 (one determined pair determines all
that is connected) and endnote 9 (pairs that determine only together) need no rule of their own.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.identifiability.free_directions import free_directions_of, sparse_basis
from gtsam_rwhec.identifiability.information import (
    IS_ROTATION,
    PairInformation,
    information,
    order_of,
    pair_information,
    prior_information,
)
from gtsam_rwhec.identifiability.noise_bounds import PairNoise, common_axes, pair_noise, variance_factors
from gtsam_rwhec.identifiability.pairs_alone import PairsAlone
from gtsam_rwhec.identifiability.verdicts import Identifiability, LaterVerdicts
from gtsam_rwhec.identifiability.weak_directions import Weak, weakest
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses

#: The pairs of larger parts are tested one by one where their verdicts are asked for: 80,000 take seconds.
AT_ONCE = 2000


def identify(part: Part, poses: PairPoses, J_t: Array, J_R: Array, order: Elimination | None = None) -> Identifiability:
    """Test every direction of a part at an answer, and every direction of each pair alone.

    J_t and J_R (E,) are the costs of the pairs at the answer ``poses``, in the physical model; the noise is estimated
    from them. ``order`` is that of the part's frames, where it is known already.
    """
    return identify_with_basis(part, poses, J_t, J_R, order)[0]


def identify_with_basis(
    part: Part, poses: PairPoses, J_t: Array, J_R: Array, order: Elimination | None = None
) -> tuple[Identifiability, Array]:
    """``identify``, and the free directions with their small shares, which the records leave out.

    The basis (7 n + 1, k) has a column for each record: [omega (rad), v (m), log own scale] for each of ``part.free``,
    then the shared scale's logarithm. It spans exactly what is free.
    """
    pairs = pair_information(part, poses)
    in_target, in_sensor, singular_values = common_axes(part)
    factors = variance_factors(part, pairs, J_t, J_R)
    noise = pair_noise(part, poses, pairs, factors, in_target, in_sensor)
    alone = PairsAlone.of(part, pairs, noise, singular_values, J_R)
    weak = _weakest_of_part(part, pairs, noise, order or order_of(part))
    basis = sparse_basis(weak.directions[:, weak.free], alone.length)
    free = free_directions_of(part.free, basis, alone.length, alone.reasons_of_frames() if basis.shape[1] else {})
    known = Identifiability(
        is_unique=not free,
        free_directions=free,
        weakest=float(weak.values[0]) if len(weak.values) else np.inf,
        threshold=float(weak.thresholds[0]) if len(weak.values) else 0.0,
        pairs=alone.verdicts() if len(part.pairs) <= AT_ONCE else LaterVerdicts((part.pairs,), (alone,)),
        parts=(part.names,),
    )
    return known, basis


def _weakest_of_part(part: Part, pairs: PairInformation, noise: PairNoise, order: Elimination) -> Weak:
    """Test rotations; then, if all are determined, the rest at those rotations, and else everything together."""
    n, count = len(part.free), part.moments.count
    is_free = part.ends < n
    # A motion's two ends are one frame; a fixed frame leaves both to the other.
    of_each = 2.0 * count / np.maximum(is_free.sum(axis=1), 1)
    sums = [np.bincount(part.ends[has, side], of_each[has], minlength=n) for side, has in enumerate(is_free.T)]
    ends = np.append(sums[0] + sums[1], float(part.number_of_measurements))
    rotation_prior, translation_prior = prior_information(part)
    rotations = pairs.used & IS_ROTATION
    turning = information(part, order, [pairs.rotation], noise.rotation, rotations, rotation_prior)
    spare = float(noise.spare.min())
    tests = [weakest(turning, ends, spare, few=noise.few)]
    del turning
    if tests[0].free.any():
        everything = information(
            part,
            order,
            [pairs.rotation, pairs.translation],
            noise.rotation + noise.translation,
            pairs.used,
            rotation_prior + translation_prior,
        )
        tests = [weakest(everything, ends, min(spare, noise.spare_translation), few=noise.few)]
    else:
        rest = pairs.used & ~IS_ROTATION
        moving = information(part, order, [pairs.translation], noise.translation, rest, translation_prior)
        tests.append(weakest(moving, ends, _spare_of_rest(part, noise), few=noise.few))
    return min(tests, key=lambda test: test.ratio)


def _spare_of_rest(part: Part, noise: PairNoise) -> float:
    """The equations to spare that tell the noise of what is not a rotation: only A's noise, where sizes are known."""
    of_carrier = float(noise.spare.min())
    return of_carrier if part.scale == "known" else min(of_carrier, noise.spare_translation)
