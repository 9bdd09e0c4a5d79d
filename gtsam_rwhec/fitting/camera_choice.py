"""The simplest model that explains the images: what is free of a lens, which cameras share one, which boards are bent.

Free coefficients that no image asks for take up errors of corners that go together, and move the poses. So cameras are
compared by how well they predict images that were left out: the simplest one wins whose error is within one standard
error of the best one's (Breiman et al. 1984, the rule of one standard error). Images are left out in blocks of time, of
the carriers' configuration, and of the image's regions, so that a lens that extrapolates badly shows.

All is linear about one refinement in which everything is free. A block b of instants has the sums H_b, h_b, c_b of its
rows, the carriers' errors eliminated (`Reduced`). A camera model is a prior (P, mu), in which what is not free is held;
cameras that share intrinsics have the unknowns theta = T phi + theta_0. Then

    phi_b = -(T'(H - H_b)T + P)^-1 (T'(h - h_b) + P off),    error_b = c_b + 2 h_b' theta_b + theta_b' H_b theta_b,

in the noise's units: what an image's corners say in spite of the noise of its A counts, and no more.

The simplest model may lack what is there, and images that tell it not for sure. So how far its rivals' answers are from
its own is in the covariance, each weighed by how well it predicts, exp(-error / 2) (Buckland, Burnham and Augustin
1997).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import get_args

import numpy as np
from rwhec_factors import se3
from scipy.special import chdtri

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.corner_model import Model
from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.fit_options import CornerOptions, FreeLens
from gtsam_rwhec.fitting.held_out import blocks_of
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.fitting.stated_intrinsics import PINHOLE, is_free, prior_of
from gtsam_rwhec.geometry.poses import Array

#: Blocks of time and of configurations, and columns and rows of the image's regions.
BLOCKS, REGIONS = 6, 3
#: Each image is left out so often: by time, by configuration, by region.
WAYS = 3
#: A lens model of so many coefficients has k3.
K3 = 5
#: A target of so many corners in one plane may be bent, with heights of this standard deviation, metres; flat ones are
#: held to the second.
BENT, WARP_M, FLAT_M = 9, 1e-3, 1e-8
#: Without a block each camera and each target must keep so many images, or the block is not left out.
FEWEST = 4
#: The scatter of blocks' answers counts where chance gives it with less than this probability. Each frame's six numbers
#: count as this many, since they go together. A block tells of an unknown where its variance grows by this share
#: without it; so many blocks must.
BY_CHANCE, NUMBERS, TOLD, FEWEST_BLOCKS = 0.01, 3, 0.01, 3
#: Lengths and angles of configurations are alike where they are as far apart, m over rad.
M_PER_RAD = 0.5

WORDS: dict[FreeLens, str] = {
    "focal": "one focal length and the centre",
    "focals": "two focal lengths and the centre",
    "k1": "with k1",
    "k2": "with k1 and k2",
    "p2": "with k1, k2, p1 and p2",
    "k3": "with k1, k2, p1, p2 and k3",
    "rational": "a rational lens, with k1 to k6, p1 and p2",
    "all": "with all coefficients of its lens model",
}


@dataclass(frozen=True)
class Rival:
    """A model of some cameras or of a board that was tried, and its error in images that were left out."""

    #: "camera model of cam_0", "shape of board": what was chosen.
    what: str
    #: What is free.
    words: str
    #: One camera for several sensors.
    is_shared: bool
    #: Root mean square length of a corner's error in images that were left out, pixels, beyond what the noise of A
    #: explains; and one standard error of its difference from the best model's.
    px: float
    more_px: float
    is_chosen: bool


@dataclass(frozen=True, eq=False)
class ChosenCameras:
    """The options with the chosen cameras and boards, what was tried, and how far blocks of images disagree with it."""

    options: CornerOptions
    tried: tuple[Rival, ...]
    #: By unknown: the jackknife's deviation over the claimed one, the larger of blocks of time and of configurations; 1
    #: where chance explains it.
    spread: Mapping[tuple[str, str], float]
    #: By unknown, each: how far the answer of a rival is from that of the chosen model, times the root of its weight.
    rivals: tuple[Mapping[tuple[str, str], Array], ...] = ()

    @property
    def asking(self) -> tuple[str, ...]:
        """Sensors whose images ask for k3, and perhaps for more."""
        lens = self.options.lens
        return tuple(name for name, of in lens.items() if of == "k3") if isinstance(lens, Mapping) else ()


def with_widest(
    options: CornerOptions, observations: Observations, before: ChosenCameras | None = None
) -> CornerOptions:
    """The options with everything free that may be chosen to be so, where they leave the choice.

    A rational lens is so where k3 was chosen before.
    """
    if options.lens == "all":
        short = (name for name, of in observations.cameras.items() if of.model == "pinhole" or is_short(of))
        asking = before.asking if before else ()
        options = replace(options, lens={name: "rational" if name in asking else "k3" for name in short})
    if options.warp_m == 0.0:
        corners = {name: observations.corners[name] for name in observations.targets}
        boards = [name for name, points in corners.items() if len(points) >= BENT and not points[:, 2].any()]
        options = replace(options, warp_m=dict.fromkeys(boards, WARP_M))
    return options


def is_short(camera: Camera) -> bool:
    """Whether a radtan camera has no coefficients after k3."""
    return camera.model == "radtan" and len(camera.D) <= K3


def alike(cameras: Mapping[str, Camera], options: CornerOptions) -> list[tuple[str, ...]]:
    """Groups of two sensors and more that were stated alike, as nominal or by a calibration, and are in no group."""
    groups: dict[tuple[object, ...], list[str]] = {}
    grouped = {name for group in options.shared for name in group}
    for name, camera in cameras.items():
        stated = options.stated_of(name)
        if stated in ("nominal", "calibration") and name not in grouped:
            same = (camera.width, camera.height, camera.model, *camera.parameters.tolist(), stated)
            groups.setdefault(same, []).append(name)
    return [tuple(names) for names in groups.values() if len(names) > 1]


def chosen_cameras(
    refined: CornersRefined, observations: Observations, options: CornerOptions, before: ChosenCameras | None = None
) -> ChosenCameras:
    """Choose which boards are bent, what is free of each camera, and which cameras share intrinsics.

    Parameters
    ----------
    refined : CornersRefined
        From the observations, under `with_widest` of the options.
    observations : Observations
        With the cameras as they are stated.
    options : CornerOptions
        What is free of cameras is chosen where ``lens`` is "all", and boards where ``warp_m`` is 0; groups of
        ``shared`` stay, and others may be added.
    before : ChosenCameras, optional
        What was chosen where less was free.
    """
    blocks, widest = Blocks.of(refined), with_widest(options, observations, before)
    choice = Choosing(blocks, observations.cameras, widest)
    if len(blocks) > 1 and options.warp_m == 0.0:
        choice.boards()
    if len(blocks) > 1 and options.lens == "all":
        choice.cameras()
    if len(blocks) <= 1:  # no image can be left out: nothing is free that nothing asks for
        choice.options = replace(choice.options, warp_m=options.warp_m)
        if options.lens == "all":
            assert isinstance(widest.lens, Mapping)
            least: dict[str, FreeLens] = {
                name: "k1" if options.stated_of(name) == "unknown" else "focal" for name in widest.lens
            }
            choice.options = replace(choice.options, lens=least)
    model = LinearModel.of(refined, observations.cameras, choice.options)
    return ChosenCameras(choice.options, tuple(choice.tried), blocks.spread(model), tuple(choice.rivals))


def spread_of(
    refined: CornersRefined, observations: Observations, options: CornerOptions
) -> dict[tuple[str, str], float]:
    """By unknown of a refinement under the options: how far blocks of images scatter; `ChosenCameras.spread`."""
    return Blocks.of(refined).spread(LinearModel.of(refined, observations.cameras, options))


@dataclass(eq=False)
class Choosing:
    """The options as they are chosen, one thing after the other, with the rest as it is."""

    blocks: Blocks
    stated: Mapping[str, Camera]
    options: CornerOptions
    tried: list[Rival] = field(default_factory=list)
    rivals: list[Mapping[tuple[str, str], Array]] = field(default_factory=list)

    def boards(self) -> None:
        """Flat, or bent."""
        assert isinstance(self.options.warp_m, Mapping)
        for name in self.options.warp_m:
            flat = replace(self.options, warp_m={at: m for at, m in self.options.warp_m.items() if at != name})
            self.options = self._simplest(f"shape of {name}", [("flat", flat), ("bent", self.options)])

    def cameras(self) -> None:
        """Sharing first, of each group; then what is free of each camera that is alone, with the others as they are."""
        every_camera = self.blocks.refined.graph.model.camera_priors
        alone = [name for name in every_camera if self.options.stated_of(name) != "exact"]
        for names in alike({name: self.stated[name] for name in alone}, self.options):
            levels = _levels(self.blocks.refined, names)
            every = [(lens, is_shared) for lens in levels for is_shared in (True, False)]
            rivals = [(self._words(names, lens), self._with(names, lens, is_shared)) for lens, is_shared in every]
            chosen = self._simplest(f"camera model of {', '.join(names)}", rivals)
            if chosen.shared != self.options.shared:
                self.options = chosen
                alone = [name for name in alone if name not in names]
        for name in alone:
            levels = _levels(self.blocks.refined, (name,))
            rivals = [(self._words((name,), lens), self._with((name,), lens, False)) for lens in levels]
            self.options = self._simplest(f"camera model of {name}", rivals)

    def _words(self, names: Sequence[str], lens: FreeLens) -> str:
        """What is free of a camera, by the names that its lens model has."""
        camera = self.blocks.refined.intrinsics[names[0]].camera
        if lens in ("focal", "focals", "all") or camera.model in ("pinhole", "radtan"):
            return WORDS[lens]
        free = [name for name, is_it in zip(camera.parameter_names, is_free(camera, lens), strict=True) if is_it]
        return f"with {', '.join(free[PINHOLE:])}"

    def _with(self, names: tuple[str, ...], lens: FreeLens, is_shared: bool) -> CornerOptions:
        assert isinstance(self.options.lens, Mapping)
        shared = (*self.options.shared, names) if is_shared else self.options.shared
        return replace(self.options, lens={**self.options.lens, **dict.fromkeys(names, lens)}, shared=shared)

    def _simplest(self, what: str, rivals: Sequence[tuple[str, CornerOptions]]) -> CornerOptions:
        """The first that predicts as well as the best."""
        models = [LinearModel.of(self.blocks.refined, self.stated, options) for _, options in rivals]
        at, scores, weights = self.blocks.simplest(models)
        answers = [model.theta(self.blocks.all) for model in models]
        for weight, answer in zip(weights.tolist(), answers, strict=True):
            off = np.sqrt(weight) * (answer - answers[at])
            self.rivals.append({slot: off[rows] for slot, rows in self.blocks.refined.slots.items()})
        for i, ((words, options), (px, more_px)) in enumerate(zip(rivals, scores, strict=True)):
            self.tried.append(Rival(what, words, options.shared != self.options.shared, px, more_px, i == at))
        return rivals[at][1]


def _levels(refined: CornersRefined, names: Sequence[str]) -> list[FreeLens]:
    """What may be free of a camera, in order of freedom; each has more than the one before."""
    camera = refined.intrinsics[names[0]].camera
    found: dict[tuple[bool, ...], FreeLens] = {}
    for lens in get_args(FreeLens):
        found.setdefault((lens == "focal", *is_free(camera, lens).tolist()), lens)
    return list(found.values())


@dataclass(frozen=True, eq=False)
class LinearModel:
    """All but poses are T phi + start, with the prior's precision P on phi, and how far phi = 0 is from its mean."""

    T: Array
    start: Array
    P: Array
    off: Array

    @staticmethod
    def of(refined: CornersRefined, stated: Mapping[str, Camera], options: CornerOptions) -> LinearModel:
        """The model of options about a refinement in which each camera has its own intrinsics."""
        model, point = refined.graph.model, refined.point
        poses = poses_of(refined)
        slots = {at: slice(rows.start - poses, rows.stop - poses) for at, rows in refined.slots.items()}
        size = len(refined.joint) - poses
        T, start = np.eye(size), np.zeros(size)
        P, off = np.zeros((size, size)), np.zeros(size)
        vectors, gone = model.vectors(point), []
        for at, prior in model.priors(point).items():
            letter, name = at
            rows = slots[at]
            if letter == "k":
                first = options.camera_of(name)
                if first != name and ("k", first) in slots:
                    T[rows, slots["k", first]] = np.eye(rows.stop - rows.start)
                    start[rows] = point.cameras[first] - point.cameras[name]
                    gone += list(range(rows.start, rows.stop))
                    continue
                lens = options.lens_of(name)
                camera = refined.intrinsics[name].camera
                given = stated[name].parameters
                camera = camera.with_parameters(np.pad(given, (0, len(prior.mean) - len(given))))
                now = prior_of(camera, options.stated_of(name), lens)
                # where the images contradicted the prior it was widened, and stays so
                wide = np.where(is_free(camera, lens), np.maximum(now.deviation, prior.deviation), now.deviation)
                prior = now._replace(deviation=wide)
            elif letter == "b" and options.warp_m_of(name) == 0.0:
                is_warp = model.free_shape(name) > 0
                prior = prior._replace(deviation=np.where(is_warp, FLAT_M, prior.deviation))
            P[rows, rows] = prior.precision
            off[rows] = vectors[at] - prior.mean
        kept = np.setdiff1d(np.arange(size), gone)
        return LinearModel(T[:, kept], start, P[np.ix_(kept, kept)], off[kept])

    def theta(self, sums: WithoutPoses) -> Array:
        """The unknowns (d,) of least cost."""
        A, b = self.T.T @ sums.H @ self.T + self.P, self.T.T @ (sums.h + sums.H @ self.start) + self.P @ self.off
        size = np.sqrt(np.diagonal(A))
        rest: Array = self.T @ (-np.linalg.solve(A / size[:, None] / size, b / size) / size) + self.start
        found: Array = np.r_[-sums.through @ np.r_[rest, 1.0], rest]
        return found

    def variances(self, sums: WithoutPoses) -> Array:
        """Those of the unknowns (d,)."""
        A = self.T.T @ sums.H @ self.T + self.P
        size = np.sqrt(np.diagonal(A))
        rest: Array = self.T @ (np.linalg.inv(A / size[:, None] / size) / size[:, None] / size) @ self.T.T
        by_rest = sums.through[:, :-1]
        found: Array = np.r_[sums.variances + ((by_rest @ rest) * by_rest).sum(axis=1), np.diagonal(rest)]
        return found


def poses_of(refined: CornersRefined) -> int:
    """The number of the unknowns that are poses, which come first."""
    return 6 * sum(letter in "xy" for letter, _ in refined.slots)


@dataclass(frozen=True, eq=False)
class WithoutPoses:
    """H (m, m) and h (m,) of sums from which the poses are eliminated: no model has a prior of these.

    The poses (p,) are -through (p, m + 1) times the others and 1.
    """

    variances: Array  #: (p,): Of the poses with all else known
    through: Array
    H: Array
    h: Array

    @staticmethod
    def of(H: Array, h: Array, poses: int) -> WithoutPoses:
        """Of sums (d, d) and (d,) with so many numbers of poses."""
        own, ties = H[:poses, :poses], np.c_[H[:poses, poses:], h[:poses]]
        size = np.sqrt(np.diagonal(own))
        inverse = np.linalg.inv(own / size[:, None] / size) / size[:, None] / size
        through = inverse @ ties
        rest = np.c_[H[poses:, poses:], h[poses:]] - H[poses:, :poses] @ through
        return WithoutPoses(np.diagonal(inverse), through, rest[:, :-1], rest[:, -1])


@dataclass(frozen=True, eq=False)
class Blocks:
    """Sums of blocks of instants: H (b, d, d), h (b, d), c (b,), how many residuals, and the way each was cut."""

    refined: CornersRefined
    H: Array
    h: Array
    c: Array
    count: Array
    #: (b,): 0 by time, 1 by configuration, 2 by region.
    way: np.ndarray
    #: Of all images, and of all but each block's.
    all: WithoutPoses
    rest: list[WithoutPoses]

    def __len__(self) -> int:
        """The number of blocks."""
        return len(self.c)

    @staticmethod
    def of(refined: CornersRefined) -> Blocks:
        """The blocks of a refinement's images that can be left out."""
        model, noise = refined.graph.model, refined.noise
        whole = Reduced.of(model, refined.point).without_carriers(noise)
        found, ways = [], []
        in_time = blocks_of(model.stacks, len(model.A), min(BLOCKS, len(model.A)))
        for way, block in enumerate((in_time, _by_configuration(model), _by_region(model))):
            for number in range(block.max() + 1):
                inside = block == number
                if inside.any() and _leaves_enough(model, inside):
                    reduced = Reduced.of(model.of_instants(inside), refined.point, refined.slots)
                    sums = reduced.without_carriers(noise)
                    found.append((sums.H, sums.h, sums.rr, reduced.count))
                    ways.append(way)
        H, h, c, count = (np.array(each) for each in zip(*found, strict=True)) if found else (np.zeros(0),) * 4
        without = partial(WithoutPoses.of, poses=poses_of(refined))
        rest = [without(whole.H - H[i], whole.h - h[i]) for i in range(len(c))]
        return Blocks(refined, H, h, c, count, np.array(ways), without(whole.H, whole.h), rest)

    def errors(self, model: LinearModel) -> Array:
        """Squared errors (b,) of each block, predicted from the others."""
        found = np.zeros(len(self))
        for i in range(len(self)):
            theta = model.theta(self.rest[i])
            found[i] = self.c[i] + 2.0 * self.h[i] @ theta + theta @ self.H[i] @ theta
        return found

    def simplest(self, models: Sequence[LinearModel]) -> tuple[int, list[tuple[float, float]], Array]:
        """The first model that predicts as well as the best, within one standard error; errors (pixels); weights."""
        errors, px2 = np.array([self.errors(model) for model in models]), self.refined.noise.corner_px**2
        means = errors.sum(axis=1) / self.count.sum()
        best = int(np.argmin(means))
        more = (errors - errors[best]) / self.count  # of each block
        weights = self.count / self.count.sum()
        off = more - (more @ weights)[:, None]
        standard_error = np.sqrt((weights**2 * off**2).sum(axis=1) * len(self) / max(len(self) - 1, 1))
        good = means - means[best] <= standard_error
        at = int(np.argmax(good))
        px = np.sqrt(2.0 * px2 * means)
        weights = np.exp(-0.5 * (errors.sum(axis=1) - errors.sum(axis=1).min()) / WAYS)
        return at, list(zip(px.tolist(), (px2 * standard_error / px).tolist(), strict=True)), weights / weights.sum()

    def spread(self, model: LinearModel) -> dict[tuple[str, str], float]:
        """By unknown: the scatter of the blocks' answers over what the covariance claims; `ChosenCameras.spread`.

        Without block j the answer differs by what has the covariance C_j - C: with C_j that of the rest, C that of all.
        """
        found = dict.fromkeys(self.refined.slots, 1.0)
        theta, C = model.theta(self.all), model.variances(self.all)
        for way in (0, 1):
            at = np.flatnonzero(self.way == way)
            if not len(at):
                continue
            off = np.array([model.theta(self.rest[i]) for i in at]) - theta
            claimed = np.array([model.variances(self.rest[i]) for i in at]) - C
            told = claimed > TOLD * C
            squares = np.where(told, off**2, 0.0) / np.where(told, claimed, 1.0)
            for slot, rows in self.refined.slots.items():
                number = told[:, rows].sum() / max(rows.stop - rows.start, 1)  # of blocks that tell of it
                freedom = NUMBERS * (number - 1.0)
                ratio = float(squares[:, rows].sum() / max(told[:, rows].sum(), 1))
                if number >= FEWEST_BLOCKS and ratio > chdtri(freedom, BY_CHANCE) / freedom:
                    found[slot] = max(found[slot], float(np.sqrt(ratio)))
        return found


def _leaves_enough(model: Model, inside: np.ndarray) -> bool:
    """Whether without some instants (I,) each target and each sensor keeps enough images."""
    left: dict[tuple[str, str], int] = {}
    for stack in model.stacks:
        outside = stack.sums((~inside[stack.instant]).astype(int)).tolist()
        for (pair, _), number in zip(stack.pairs, outside, strict=True):
            for at in zip("xy", pair, strict=True):
                left[at] = left.get(at, 0) + number
    return min(left.values()) >= FEWEST


def _by_configuration(model: Model) -> np.ndarray:
    """Blocks (I,) of instants whose carriers' poses are near each other: halved along the direction they vary most."""
    features = se3.logmap(se3.inverse(model.A[:1]) @ model.A) * np.repeat([M_PER_RAD, 1.0], 3)
    block = np.zeros(len(features), dtype=np.int64)
    for number in range(1, min(BLOCKS, len(features))):
        largest = np.flatnonzero(block == np.argmax(np.bincount(block)))
        centred = features[largest] - features[largest].mean(axis=0)
        along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
        block[largest[along > np.median(along)]] = number
    return block


def _by_region(model: Model) -> np.ndarray:
    """Blocks (I,) of instants by where in the image the corners are, of the sensor that sees most of them first."""
    place, count = np.zeros((len(model.A), 2)), np.zeros(len(model.A))
    for stack in model.stacks:
        size = np.array([stack.camera.width, stack.camera.height])
        np.add.at(place, stack.instant, (stack.pixels * stack.known[..., None]).sum(axis=1) / size)
        np.add.at(count, stack.instant, stack.known.sum(axis=1))
    at = np.clip((REGIONS * place / np.maximum(count, 1.0)[:, None]).astype(int), 0, REGIONS - 1) @ [1, REGIONS]
    return np.unique(at, return_inverse=True)[1]
