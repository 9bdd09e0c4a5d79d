"""When to stop measuring: a rule that stays true although it is asked after every take.

The rule stops when the radius r_n, within which a point lies with 95 % by what n takes say, is at most the wanted one.
Asked once that is an F quantile (a t vector): r_n = c(nu_n) s_n q_n, where s_n^2 estimates the noise's variance with
nu_n degrees of freedom, q_n^2 is what the poses make of a variance 1, and c^2 = 3 F(3, nu_n). Asked after every take it
stops where s_n happens to be small: at the moment of stopping s_N underestimates the noise, and the ellipsoid is too
small (Anscombe, 1953; Chow and Robbins, Ann. Math. Statist. 36, 1965).

With Gaussian errors the estimate is independent of s_1, ..., s_n together: these are made of recursive residuals, each
of which is independent of all estimates after it (Brown, Durbin and Evans, J. R. Statist. Soc. B 37, 1975). So the
choice of N depends on the estimate through s alone, and the probability that the truth is inside is

    E[ F_3( kappa^2 c(nu_N)^2 s_N^2 / sigma^2 ) ],        nu_n s_n^2 / sigma^2 = sum of independent chi-squares,

with chi-square's distribution function F_3 and a factor kappa that widens all ellipsoids. No estimate is in it, so it
can be computed for any sigma: by paths of the chi-squares, stopped where the rule stops. kappa (`widening`) is the
smallest that gives the level for the worst sigma: 1.03 to 1.07. The worst case of looks is taken, one pose a take
(three equations of each kind) and q_n^2 like 1 / nu_n. So the ellipsoid at the moment of stopping holds the truth with
the level, and since its radius is at most the wanted one, so does the accuracy.

"Never" is said after every take too. It rests on a lower bound of the noise that is true at all takes together with
95 %: with x = nu s^2 / sigma^2, exp((1 - tau) x / 2) tau^(nu / 2) is a martingale for every tau, and so is its mean
over tau ~ Gamma(a, a) (Robbins, Ann. Math. Statist. 41, 1970; Howard, Ramdas, McAuliffe and Sekhon, Ann. Statist. 49,
2021),

    M(x, nu) = exp(x / 2) a^a Gamma(a + nu / 2) / (Gamma(a) (a + x / 2)^(a + nu / 2)),

which exceeds 1 / alpha ever with probability alpha at most (Ville).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np
from scipy.special import chdtr, fdtri, gammaln

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.point_uncertainty import PointUncertainty, ball_radius, jacobian_of_point
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.capture.accuracy import Accuracy
from gtsam_rwhec.capture.stream_update import StreamUpdate
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief, rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import check_kind, is_whole

#: With fewer degrees of freedom the rule does not stop: F quantiles are large there, and models of noise undecided.
FEWEST_FREEDOM = 12
#: The least that a take adds: the three equations of a kind of one pose.
OF_ONE_POSE = 3
#: The looks, paths and deviations (over that which would stop at the first look) by which `widening` is computed. With
#: so many paths its coverage is known to 0.0005.
LOOKS, PATHS, SIGMAS = 40, 20_000, np.geomspace(1.0, 3.0, 12)
SEED = 20_260_101
#: The probability that "never" is said of an accuracy that can be reached.
WRONGLY_NEVER = 0.05
#: The mixture's a: the bound is tightest at about twice as many degrees of freedom.
MIXTURE = 4.0


class Why(StrEnum):
    """Why a rule stops, goes on, or says that the accuracy is never reached."""

    REACHED = "reached"
    MORE_TAKES = "more takes reach it"
    TOO_FEW = "too few takes to tell the noise"
    NO_ANSWER = "no answer whose uncertainty can be relied on"
    FREE_DIRECTION = "the motion leaves a direction free"
    #: Never:
    NOISE = "the noise is too large: it takes more than the most takes"
    CONSTANT_ERRORS = "errors of the carriers' poses that no number of takes averages out are larger"

    @property
    def is_never(self) -> bool:
        """Whether more takes of this kind do not help."""
        return self in (Why.NOISE, Why.CONSTANT_ERRORS)


@dataclass(frozen=True, eq=False)
class StopDecision:
    """What a rule says after a take; ``str()`` is a sentence."""

    stop: bool
    why: Why
    wanted: Accuracy
    takes: int
    #: By sensor: how far off the wanted point is, widened for the moment of stopping; empty where it cannot be said
    points: dict[str, PointUncertainty]
    #: By this the deviations of an answer are multiplied, so that they stay true at the moment of stopping
    widening: float
    more_takes: int | None  #: About so many more takes reach it, if they are like those so far; None where not known
    reason: str = ""  #: What the answer says against itself

    @property
    def reached_m(self) -> float:
        """The radius that is reached with the wanted probability, of the worst sensor, metres; infinite if unknown."""
        return max((1e-3 * point.radius_mm for point in self.points.values()), default=math.inf)

    def __str__(self) -> str:
        now = f"{rounded(1e3 * self.reached_m)} mm now, {self.wanted} is wanted" if self.points else f"{self.wanted}"
        if self.stop:
            return f"Stop: {now}."
        more = f"; about {self.more_takes} more takes" if self.more_takes else ""
        because = f" ({self.reason})" if self.reason else ""
        return f"{'Never' if self.why.is_never else 'Go on'}: {now}: {self.why}{because}{more}."


class StoppingRule:
    """Says after each take whether the wanted accuracy is reached, and stays true although it is asked so often.

    Parameters
    ----------
    wanted : Accuracy
    most_takes : int
        An accuracy that takes more than this counts as never reached.
    accepts_care : bool
        Whether a ``Calibration`` that is to be used with care may stop it: its uncertainty may be too small.
    """

    def __init__(self, wanted: Accuracy, *, most_takes: int = 100, accepts_care: bool = False) -> None:
        if not isinstance(wanted, Accuracy) or math.isinf(wanted.radius_m):
            raise OptionError(f"wanted is {brief(wanted)}; give a gtsam_rwhec.Accuracy with a radius and a distance")
        if not is_whole(most_takes, 1) or not isinstance(accepts_care, bool):
            raise OptionError(f"most_takes={brief(most_takes)} is a whole number from 1, accepts_care True or False")
        self.wanted, self.most_takes, self.accepts_care = wanted, most_takes, accepts_care
        self._place = wanted.place_m
        self._takes = 0
        self._first_freedom: float | None = None  #: at the first look that may stop

    def after(self, answer: Calibration | StreamUpdate, *, takes: int | None = None) -> StopDecision:
        """Decide after a take.

        Parameters
        ----------
        answer : Calibration or StreamUpdate
            What all takes so far say.
        takes : int, optional
            How many there are; left out, one more than at the last call.

        Raises
        ------
        FrameError
            The wanted accuracy names a sensor that has no answer.
        """
        self._takes = takes if takes is not None else self._takes + 1
        check_kind(answer, Calibration | StreamUpdate, "answer", "a Calibration or a StreamUpdate")
        refined = answer.refined
        if isinstance(answer, Calibration):
            refused = (Verdict.DO_NOT_USE,) if self.accepts_care else (Verdict.DO_NOT_USE, Verdict.CARE)
            if refined is None or answer.judgement.verdict in refused:
                return self._without(Why.NO_ANSWER, str(answer.judgement))
        elif not answer.is_unique:
            return self._without(Why.FREE_DIRECTION if answer.free_directions else Why.NO_ANSWER, str(answer))
        if refined is None:
            return self._without(Why.TOO_FEW)
        nu = refined.degrees_of_freedom
        names = self.wanted.sensors or tuple(refined.Y)
        strange = [name for name in names if name not in refined.Y]
        if strange:
            raise FrameError(
                f"{brief(strange[0])} is wanted, but no sensor of this answer; there are {', '.join(refined.Y)}"
            )
        points = {name: answer.uncertainty_at(self._place, name, level=self.wanted.level) for name in names}
        if not np.isfinite([point.radius_mm for point in points.values()]).all():
            return self._without(Why.FREE_DIRECTION)
        if self._first_freedom is None and nu >= FEWEST_FREEDOM:
            self._first_freedom = nu
        factor = widening(int(min(self._first_freedom or FEWEST_FREEDOM, 10_000)), self.wanted.level)
        widened = {name: _widened(point, factor) for name, point in points.items()}
        worst = max(widened, key=lambda name: widened[name].radius_mm)
        constant, is_sure = _constant_of(answer, worst, self._place)
        decision = StopDecision(False, Why.MORE_TAKES, self.wanted, self._takes, widened, factor, None)
        wanted = self.wanted.radius_m
        if nu >= FEWEST_FREEDOM and decision.reached_m <= wanted:
            return replace(decision, stop=True, why=Why.REACHED, more_takes=0)
        varying = np.maximum(np.linalg.eigvalsh(points[worst].covariance_m2 - constant), 0.0)
        if is_sure and ball_radius(np.linalg.eigvalsh(constant), self.wanted.level) > wanted:
            return replace(decision, why=Why.CONSTANT_ERRORS)
        least = ball_radius(varying * lowest_share(nu), self.wanted.level)
        if least * math.sqrt(self._takes / self.most_takes) > wanted:
            return replace(decision, why=Why.NOISE)
        return replace(
            decision,
            why=Why.MORE_TAKES if nu >= FEWEST_FREEDOM else Why.TOO_FEW,
            more_takes=self._more(constant, varying, nu),
        )

    def _without(self, why: Why, reason: str = "") -> StopDecision:
        return StopDecision(False, why, self.wanted, self._takes, {}, 1.0, None, reason)

    def _more(self, constant: Array, varying: Array, nu: float) -> int | None:
        """How many more takes like those so far reach it; None for more than the most."""
        of_constant = np.linalg.eigvalsh(constant).max()
        for takes in range(self._takes + 1, self.most_takes + 1):
            grown = nu + (takes - self._takes) * max(nu, OF_ONE_POSE) / self._takes
            if grown < FEWEST_FREEDOM:
                continue
            radius = ball_radius(varying * self._takes / takes + of_constant, self.wanted.level, grown)
            if radius * widening(FEWEST_FREEDOM, self.wanted.level) <= self.wanted.radius_m:
                return takes - self._takes
        return None


def _widened(point: PointUncertainty, factor: float) -> PointUncertainty:
    return replace(
        point,
        covariance_m2=point.covariance_m2 * factor**2,
        half_lengths_mm=point.half_lengths_mm * factor,
        radius_mm=point.radius_mm * factor,
    )


def _constant_of(answer: Calibration | StreamUpdate, sensor: str, place: list[float]) -> tuple[Array, bool]:
    """(3, 3): the part of a point's covariance that errors of A make which are the same at every take; whether the data
    show such errors, which few takes only allow for."""
    model = answer.noise.model if isinstance(answer, Calibration) else None
    if model is None:
        return np.zeros((3, 3)), False
    Y = answer.Y[sensor]
    shift = Y.inverse().AdjointMap() * np.array(model.constant_deviations[1])
    J = jacobian_of_point(Y.rotation().matrix(), np.array(place)) @ shift
    return J @ J.T, model.has_systematic


@lru_cache(maxsize=32)
def widening(first_freedom: int, level: float) -> float:
    """kappa for a rule that may stop from this many degrees of freedom on."""
    if first_freedom >= 2000:  # s is known to 1.6 %, and stopping changes nothing that shows
        return 1.0
    nu = first_freedom + OF_ONE_POSE * np.arange(LOOKS)
    draws = np.random.default_rng(SEED)
    first = draws.chisquare(first_freedom, (PATHS, 1))
    s2 = np.cumsum(np.hstack([first, draws.chisquare(OF_ONE_POSE, (PATHS, LOOKS - 1))]), axis=1) / nu
    c2 = 3.0 * fdtri(3, nu, level)
    r2 = s2 * (c2 / c2[0]) * (nu[0] / nu)  # over that of sigma at the first look

    stops = [sigma**2 * r2 <= 1.0 for sigma in SIGMAS]  # sigma times kappa: the worst of all is looked for
    looks = np.array([np.where(each.any(axis=1), each.argmax(axis=1), LOOKS - 1) for each in stops])
    at_stop = (c2 * s2)[np.arange(PATHS), looks]
    low, high = 1.0, 1.5
    for _ in range(12):
        middle = 0.5 * (low + high)
        is_enough = chdtr(3, middle**2 * at_stop).mean(axis=1).min() >= level
        low, high = (low, middle) if is_enough else (middle, high)
    return high


def lowest_share(nu: float) -> float:
    """sigma^2 is at least this share of its estimate, at all takes together but for ``WRONGLY_NEVER``."""
    if np.isinf(nu):
        return 1.0
    constant = MIXTURE * math.log(MIXTURE) + gammaln(MIXTURE + nu / 2.0) - gammaln(MIXTURE)
    low, high = nu, 1e3 * (nu + 10.0)  # log M is convex in x, least at x = nu
    for _ in range(100):
        x = 0.5 * (low + high)
        log_m = x / 2.0 + constant - (MIXTURE + nu / 2.0) * math.log(MIXTURE + x / 2.0)
        low, high = (x, high) if log_m < -math.log(WRONGLY_NEVER) else (low, x)
    return nu / high
