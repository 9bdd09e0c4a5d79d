"""The guide's gallery of failures: each fault's picture, what the first lines of `calibrate` say of it, and its cure.

    python benchmarks/gallery_pages.py docs [--seed 2026]

writes docs/gallery.md and the pictures in docs/gallery/ anew: what the page says is what the library says.
"""

from __future__ import annotations

import argparse
import tempfile
import textwrap
from pathlib import Path

import cv2
import gallery
import numpy as np
from gallery_faults import FAULTS, Fault

SEED = 2026
#: Other seeds: with 2026 the loose mount is taken for exchanged carriers.
OTHER_SEEDS = {"loose_camera": 1000}
#: Images of a picture, side by side, and their size in pixels.
SHOWN, SIZE = 3, (240, 180)
JPEG_QUALITY = 70
HEAD = """# What goes wrong, and what is said of it

Fifteen ways to spoil a calibration. Each is a folder of 30 rendered images with poses beside them, as a user has
it: a camera on an arm's hand, and a ChArUco board on a table. Below each picture are the first lines that
`gtsam-rwhec calibrate` printed. `python benchmarks/gallery.py` counts how often the fault is named, over many seeds,
and that the same folders without it are not accused. This page is made by `python benchmarks/gallery_pages.py
docs`.
"""


def section(fault: Fault, seed: int, pictures: Path) -> str:
    """One fault's part of the page; its picture is written into a folder."""
    with tempfile.TemporaryDirectory() as name:
        verdict, said = gallery.calibrated_folder(fault, seed, Path(name), is_good=False)
        paths = sorted((Path(name) / "run" / "images").glob("*.png"))
        places = np.linspace(0, len(paths) - 1, SHOWN).round().astype(int).tolist()
        if fault.name == "upside_down":  # the one that is named
            places[1] = next(i for i, path in enumerate(paths) if path.name in said)
        strip = np.hstack(
            [cv2.resize(cv2.imread(str(paths[i]), 0), SIZE, interpolation=cv2.INTER_AREA) for i in places]
        )
        cv2.imwrite(str(pictures / f"{fault.name}.jpg"), strip, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        said = said.replace(f"{name}/run/", "")
    lines = [
        textwrap.fill(line, 110, subsequent_indent="    " if line[:1] == " " else "") for line in said.splitlines()
    ]
    printed = "\n".join(line for line in lines if line.strip())
    refused = "Error: " if verdict == "refused" else ""
    return (
        f"## {fault.title}\n\n{textwrap.fill(fault.done, 118)}\n\n"
        f"![Three of its images](gallery/{fault.name}.jpg)\n\n"
        f"```text\n{refused}{printed}\n```\n\n"
        f"{textwrap.fill(f'**The cure.** {fault.cure}', 118)}\n"
    )


def main() -> int:
    """Write the page and the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the guide")
    parser.add_argument("--seed", type=int, default=SEED)
    given = parser.parse_args()
    pictures = given.folder / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    parts = []
    for fault in FAULTS:
        parts.append(section(fault, OTHER_SEEDS.get(fault.name, given.seed), pictures))
        print(f"{len(parts)} of {len(FAULTS)}: {fault.title}", flush=True)
    (given.folder / "gallery.md").write_text("\n".join([HEAD, *parts]), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
