"""An arm by its URDF: where its hand is at joint angles, and whether joints within their limits reach a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.geometry.poses import Array

#: Steps of the damped least squares, and the damping, in units of the arm's reach.
STEPS, DAMPING = 60, 0.03
#: A pose is reached when the hand is so near to it, m and rad.
REACHED = 1e-4
#: A joint turns by at most this in one step, rad or m.
LARGEST_STEP = 0.3
#: A joint without limits turns this far to each side.
UNLIMITED_RAD = np.pi
MOVING = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True, eq=False)
class Arm:
    """A chain of joints from a base to a tip: T_base_tip = prod origin_i motion_i(q_i)."""

    names: tuple[str, ...]  #: Of the joints that move, n of them
    origins: Array  #: (n + 1, 4, 4): each joint's origin behind the joint before it, and the tip's behind the last
    axes: Array  #: (n, 3): unit vectors in the joints' own frames
    slides: np.ndarray  #: (n,): whether a joint slides in place of turning
    limits: Array  #: (2, n): the least and the largest angle (rad) or way (m)
    present: Array  #: (n,): where the joints are now

    @staticmethod
    def read(path: str | Path, base: str, tip: str, joints: Sequence[float] | None = None) -> Arm:
        """Read the chain from ``base`` to ``tip`` of a URDF; meshes are not needed.

        Parameters
        ----------
        joints : (n,), optional
            Where the joints are now, rad (m of joints that slide); without it in the middle of their limits.

        Raises
        ------
        FileFormatError
            The file cannot be read as a URDF, has no such link, or no chain from one to the other that moves.
        MissingPackageError
            yourdfpy is not installed.
        """
        with extra_named():
            import yourdfpy
        if not Path(path).is_file():
            raise FileFormatError(f"{path}: there is no such file; give the robot's URDF")
        try:
            robot = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
        except (ValueError, OSError, SyntaxError, AttributeError, TypeError, KeyError) as error:
            raise FileFormatError(f"{path} cannot be read as a URDF: {shown(str(error))}") from error
        links, above = {link.name for link in robot.robot.links}, {one.child: one for one in robot.robot.joints}
        chain: list[Any] = []
        link = tip
        while link in above and link != base and len(chain) <= len(above):
            chain.insert(0, above[link])
            link = above[link].parent
        moving = [one for one in chain if one.type in MOVING]
        if link != base or not moving:
            named = ", ".join(sorted(map(shown, links))[:30])
            raise FileFormatError(
                f"{path} has no chain of joints from {shown(base)} to {shown(tip)}; its links are {named}"
            )
        origins, so_far = [], np.eye(4)
        for one in chain:
            so_far = so_far @ (np.eye(4) if one.origin is None else one.origin)
            if one.type in MOVING:
                origins.append(so_far)
                so_far = np.eye(4)
        axes = np.array([one.axis for one in moving], dtype=float)
        ends = [
            (-UNLIMITED_RAD, UNLIMITED_RAD)
            if one.type == "continuous" or one.limit is None
            else (float(one.limit.lower or 0.0), float(one.limit.upper or 0.0))
            for one in moving
        ]
        limits = np.array(ends).T
        present = limits.mean(axis=0) if joints is None else np.array(joints, dtype=float)
        if present.shape != (len(moving),) or not np.isfinite(present).all():
            words = ", ".join(shown(one.name) for one in moving)
            raise FileFormatError(f"{path}: {len(present)} joint values for {len(moving)} joints ({words})")
        return Arm(
            tuple(one.name for one in moving),
            np.array([*origins, so_far]),
            axes / np.linalg.norm(axes, axis=1, keepdims=True),
            np.array([one.type == "prismatic" for one in moving]),
            limits,
            present,
        )

    def hand(self, joints: Array) -> tuple[Array, Array]:
        """T_base_tip (N, 4, 4) at joints (N, n), and its derivative (N, 6, n): right perturbations [omega, v]."""
        T, before = np.tile(np.eye(4), (len(joints), 1, 1)), []
        for i, axis in enumerate(self.axes):
            twist = np.concatenate([np.zeros(3), axis] if self.slides[i] else [axis, np.zeros(3)])
            T = T @ self.origins[i]
            before.append((T, twist))
            T = T @ se3.expmap(joints[:, i, None] * twist)
        T = T @ self.origins[-1]
        J = np.stack([np.einsum("nij,j->ni", se3.adjoint(se3.inverse(T) @ at), twist) for at, twist in before], axis=2)
        return T, J

    def reached(self, wanted: Array) -> tuple[np.ndarray, Array]:
        """Which poses T_base_tip (N, 4, 4) are reached from the present joints, and the joints (N, n).

        Damped least squares (Wampler 1986), all poses together, with the joints kept within their limits. A pose that
        only another branch of the arm reaches counts as not reached: going there is no small motion.
        """
        q = np.tile(np.clip(self.present, *self.limits), (len(wanted), 1))
        off = np.zeros((len(wanted), 6))
        for _ in range(STEPS):
            T, J = self.hand(q)
            off = se3.logmap(se3.inverse(T) @ wanted)
            if np.abs(off).max(initial=0.0) < 0.1 * REACHED:
                break
            damping = np.clip(np.linalg.norm(off, axis=1), 1e-5, DAMPING) ** 2
            H = J @ J.transpose(0, 2, 1) + damping[:, None, None] * np.eye(6)
            step = (J.transpose(0, 2, 1) @ np.linalg.solve(H, off[:, :, None]))[:, :, 0]
            step /= np.maximum(np.abs(step).max(axis=1, initial=0.0) / LARGEST_STEP, 1.0)[:, None]
            q = np.clip(q + step, *self.limits)
        off = se3.logmap(se3.inverse(self.hand(q)[0]) @ wanted)
        return np.abs(off).max(axis=1) < REACHED, q
