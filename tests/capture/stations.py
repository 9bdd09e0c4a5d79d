"""A made-up hand that goes from station to station and stands still at each: its log, and its rig file."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3
from synthetic_logs import BEGIN_NS, CAMERAS, TAGS, K, Message, X, Y, detections, hand, tag, transform

#: Seconds that it stands at a station, and that it takes to the next one.
STANDS_S, GOES_S = 1.2, 0.4
#: The corners of a tag, metres.
SQUARE = 0.06 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])


def path(count: int) -> list[tuple[float, np.ndarray]]:
    """Time and T_base_hand, fifty a second, over so many stations."""
    poses = []
    each_s = STANDS_S + GOES_S
    for i in range(round(50 * count * each_s)):
        station, t = divmod(i / 50, each_s)
        share = max(0.0, t - STANDS_S) / GOES_S
        first, second = hand(1.3 * station), hand(1.3 * (station + 1))
        step = se3.logmap((np.linalg.inv(first) @ second)[None])
        poses.append((i / 50, first @ se3.expmap(share * step)[0]))
    return poses


def stations(count: int, *, seed: int = 0) -> list[Message]:
    """Poses, and what drivers see of every tag in every camera, by log time."""
    rng = np.random.default_rng(seed)
    messages = []
    for i, (t, T_base_hand) in enumerate(path(count)):
        stamp = BEGIN_NS + round(1e9 * t)
        messages.append(transform(stamp, "base", "hand", T_base_hand))
        if i % 5 == 2:
            for camera in CAMERAS:
                tags = []
                for number, name in enumerate(TAGS):
                    T = np.linalg.inv(T_base_hand @ Y[camera]) @ X[name]
                    seen = T[:3, :3] @ SQUARE.T + T[:3, 3:]
                    pixels = (seen[:2] / seen[2] * K[0][0]).T + np.array([K[0][2], K[1][2]])
                    pixels += rng.normal(0.0, 0.1, (4, 2))
                    T = T @ se3.expmap(rng.normal(0.0, 1.0, (1, 6)) * ([1e-3] * 3 + [5e-4] * 3))[0]
                    tags.append(tag(number, T, corners_px=pixels))
                messages.append(detections(f"/{camera}/tags", stamp, camera, tags))
    return messages
