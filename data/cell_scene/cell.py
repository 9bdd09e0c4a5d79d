"""What both logs' scenes have in common: cameras with clocks of their own that see a robot's hand move."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cell_scene.poses import FloatArray
from cell_scene.rendering import Disc, Image, Lens, Print, render

#: The robot's zero seconds.
START_NS = 1_700_000_000_000_000_000
BLUR_PX, NOISE = 0.6, 2.5


class Cell(ABC):
    """One log's scene. Each image is drawn by itself: any one can be made again without those before it.

    Class attributes: the log's file name and the quality of its JPEGs; lenses by camera; what to add to a camera's
    stamp for the robot's time; how many images a camera takes, and how far apart; where the lamp hangs (metres, from
    the base); the number of the first camera's random stream.
    """

    file: ClassVar[str]
    jpeg_quality: ClassVar[int]
    lenses: ClassVar[dict[str, Lens]]
    offset_s: ClassVar[dict[str, float]]
    images: ClassVar[int]
    period_s: ClassVar[float]
    lamp: ClassVar[FloatArray]
    first_stream: ClassVar[int]

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._rays: dict[str, FloatArray] = {}

    @staticmethod
    @abstractmethod
    def hand(t_s: FloatArray) -> FloatArray:
        """T_base_hand (N, 4, 4) at the robot's seconds (N,)."""

    @abstractmethod
    def camera(self, name: str, t_s: float) -> FloatArray:
        """T_base_camera (4, 4) at a time."""

    @abstractmethod
    def things(self, camera: str, number: int, T_camera_base: FloatArray) -> list[tuple[Print, FloatArray]]:
        """What may be seen in an image, and T_camera_print of each."""

    def hidden(self, number: int, generator: np.random.Generator) -> Disc | None:
        """What is before the camera in an image."""
        return None

    def times(self, camera: str) -> FloatArray:
        """When the images are taken, robot's seconds (images,): not quite evenly, as cameras do."""
        generator = self._generator(camera, self.images)
        return 0.5 + self.period_s * np.arange(self.images) + generator.uniform(-0.02, 0.02, self.images)

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The images' stamps (images,), by the camera's clock."""
        return START_NS + np.rint((self.times(camera) - self.offset_s[camera]) * 1e9).astype(np.int64)

    def image(self, camera: str, number: int) -> Image:
        """One image, not compressed."""
        if camera not in self._rays:
            self._rays[camera] = self.lenses[camera].rays()
        T_camera_base = np.linalg.inv(self.camera(camera, self.times(camera)[number]))
        generator = self._generator(camera, number)
        return render(
            self._rays[camera],
            self.things(camera, number, T_camera_base),
            lamp=T_camera_base[:3, :3] @ self.lamp + T_camera_base[:3, 3],
            blur_px=BLUR_PX,
            noise=NOISE,
            disc=self.hidden(number, generator),
            generator=generator,
        )

    def _generator(self, camera: str, number: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, self.first_stream + list(self.lenses).index(camera), number])
