"""The drawings of docs/frames.md, as SVG: `python docs/building/frame_drawings.py` writes them into docs/pictures/.

Each has a ground of its own, so that it is read in a light page and in a dark one. What a transform is shows by colour,
by the kind of line and by its words: known, measured, or solved.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

PICTURES = Path(__file__).resolve().parent.parent / "pictures"
WIDTH, HEIGHT = 760, 330
#: Colour (readable on white, and apart for the colour-blind) and dashes of each kind of transform.
KINDS = {"known": ("#1f5fa8", ""), "measured": ("#1c7c54", "9 6"), "solved": ("#b3470b", "")}
BOX = (150.0, 54.0)


@dataclass(frozen=True)
class Frame:
    """A frame: its middle, its name, and what carries it or what it is."""

    x: float
    y: float
    name: str
    what: str
    moves: bool = False

    def svg(self) -> str:
        """A box with the name; one that moves has a double border."""
        width, height = BOX
        left, top = self.x - width / 2, self.y - height / 2
        outer = ""
        if self.moves:
            outer = (
                f'<rect x="{left - 4:g}" y="{top - 4:g}" width="{width + 8:g}" height="{height + 8:g}" rx="11" '
                'fill="none" stroke="#333" stroke-width="1"/>'
            )
        return (
            f'{outer}<rect x="{left:g}" y="{top:g}" width="{width:g}" height="{height:g}" rx="8" fill="#fff" '
            'stroke="#333" stroke-width="1.5"/>'
            f'<text x="{self.x:g}" y="{self.y - 4:g}" font-weight="bold">{escape(self.name)}</text>'
            f'<text x="{self.x:g}" y="{self.y + 15:g}" font-size="13">{escape(self.what)}</text>'
        )


@dataclass(frozen=True)
class Transform:
    """A transform between two frames, T_first_second, and the words at its middle."""

    first: Frame
    second: Frame
    kind: str
    words: str
    #: Shift of the words from the middle.
    shift: tuple[float, float] = (0.0, -10.0)

    def svg(self) -> str:
        """An arrow from the first frame to the second, from border to border."""
        colour, dashes = KINDS[self.kind]
        (x0, y0), (x1, y1) = _border(self.first, self.second), _border(self.second, self.first)
        dash = f' stroke-dasharray="{dashes}"' if dashes else ""
        x, y = (x0 + x1) / 2 + self.shift[0], (y0 + y1) / 2 + self.shift[1]
        return (
            f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}" stroke-width="2.5"{dash} '
            f'marker-end="url(#{self.kind})"/>'
            f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" font-size="14">{escape(self.words)}</text>'
        )


def _border(frame: Frame, other: Frame) -> tuple[float, float]:
    """Where the line from a frame's middle to another's leaves the frame's box, with room for an arrow's head."""
    dx, dy = other.x - frame.x, other.y - frame.y
    half = (BOX[0] / 2 + 10, BOX[1] / 2 + 10)
    share = min(half[0] / abs(dx) if dx else 9.0, half[1] / abs(dy) if dy else 9.0)
    return frame.x + share * dx, frame.y + share * dy


def drawing(title: str, parts: list[Frame | Transform]) -> str:
    """The whole SVG, with the legend at its foot."""
    heads = "".join(
        f'<marker id="{kind}" markerWidth="12" markerHeight="12" refX="7" refY="4" orient="auto" '
        f'markerUnits="userSpaceOnUse"><path d="M0,0 L9,4 L0,8 z" fill="{colour}"/></marker>'
        for kind, (colour, _dashes) in KINDS.items()
    )
    legend = []
    for place, (kind, (colour, dashes)) in enumerate(KINDS.items()):
        x = 30 + 130 * place
        legend.append(
            f'<line x1="{x}" y1="{HEIGHT - 22}" x2="{x + 34}" y2="{HEIGHT - 22}" stroke="{colour}" stroke-width="2.5" '
            f'stroke-dasharray="{dashes}"/><text x="{x + 42}" y="{HEIGHT - 17}" text-anchor="start" font-size="13" '
            f'fill="{colour}">{kind}</text>'
        )
    legend.append(
        f'<text x="{WIDTH - 30}" y="{HEIGHT - 17}" text-anchor="end" font-size="13">'
        "double border: moves.   Arrow from a to b: T_a_b</text>"
    )
    body = "\n".join([*(part.svg() for part in parts), *legend])
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" '
        f'role="img" font-family="Helvetica, Arial, sans-serif" font-size="15" text-anchor="middle" fill="#222">\n'
        f"<title>{escape(title)}</title>\n<defs>{heads}</defs>\n"
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="10" fill="#fcfcfa" stroke="#ccc"/>\n{body}\n</svg>\n'
    )


def _loop(title: str, carrier: Frame, sensor: Frame, other: Frame, target: Frame, A: str) -> str:
    """One sensor and one target: the four frames of A X = Y B."""
    sides = (-86.0, 5.0), (82.0, 5.0)
    return drawing(
        title,
        [
            *(carrier, sensor, other, target),
            Transform(carrier, other, "known", A, sides[0]),
            Transform(carrier, sensor, "solved", f"Y = T_{carrier.name}_{sensor.name}"),
            Transform(other, target, "solved", f"X = T_{other.name}_{target.name}", (0.0, 22.0)),
            Transform(sensor, target, "measured", f"B = T_{sensor.name}_{target.name}", sides[1]),
        ],
    )


def drawings() -> dict[str, str]:
    """The drawings by the names of their files."""
    left, right, top, bottom = 200.0, 560.0, 60.0, 235.0
    hand = Frame(left, top, "hand", "flange of the arm", True)
    base = Frame(left, bottom, "base", "foot of the arm")
    camera = Frame(right, top, "camera", "on the hand", True)
    board = Frame(right, bottom, "board", "fixed in the room")
    in_hand = _loop("Eye in hand: A = T_hand_base", hand, camera, base, board, "A = T_hand_base")
    camera = Frame(right, top, "camera", "fixed in the room")
    board = Frame(right, bottom, "board", "on the hand", True)
    base = Frame(left, top, "base", "foot of the arm")
    hand = Frame(left, bottom, "hand", "flange of the arm", True)
    to_hand = _loop("Eye to hand: A = T_base_hand", base, camera, hand, board, "A = T_base_hand")
    return {
        "frames_eye_in_hand.svg": in_hand,
        "frames_eye_to_hand.svg": to_hand,
        "frames_rig.svg": _rig(),
        "frames_two_odometries.svg": _two_odometries(),
    }


def _rig() -> str:
    rig = Frame(110, 60, "rig", "body with cameras", True)
    world = Frame(110, 235, "world", "room, map")
    sensors = [Frame(325 + 162 * k, 60, f"cam_{k}", "on the rig", True) for k in range(3)]
    targets = [Frame(325 + 162 * k, 235, f"tag_{k}", "on a wall") for k in range(3)]
    parts: list[Frame | Transform] = [rig, world, *sensors, *targets]
    parts.append(Transform(rig, world, "known", "A = T_rig_world", (75.0, 5.0)))
    parts.append(Transform(rig, sensors[0], "solved", "Y_0", (0.0, -10.0)))
    parts.append(Transform(world, targets[0], "solved", "X_0", (0.0, 22.0)))
    for k, j in ((0, 0), (0, 1), (1, 1), (2, 1), (2, 2)):
        words = f"B_{k}{j}" if k == j else ""
        parts.append(Transform(sensors[k], targets[j], "measured", words, (28.0, 5.0)))
    return drawing("A rig of cameras among tags: one Y for each camera, one X for each tag", parts)


def _two_odometries() -> str:
    before, after = 60.0, 235.0
    body = Frame(200, before, "body", "before", True), Frame(200, after, "body", "after", True)
    sensor = Frame(560, before, "sensor", "before", True), Frame(560, after, "sensor", "after", True)
    parts: list[Frame | Transform] = [
        *(*body, *sensor),
        Transform(body[0], body[1], "known", "A = T_before_after", (-88.0, 5.0)),
        Transform(sensor[0], sensor[1], "measured", "B = T_before_after", (88.0, 5.0)),
        Transform(body[0], sensor[0], "solved", "Y = T_body_sensor"),
        Transform(body[1], sensor[1], "solved", "the same Y", (0.0, 22.0)),
    ]
    return drawing("Two odometries on one body: A Y = Y B", parts)


if __name__ == "__main__":
    PICTURES.mkdir(exist_ok=True)
    for name, text in drawings().items():
        (PICTURES / name).write_text(text, encoding="utf-8")
