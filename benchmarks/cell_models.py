"""Rendered cells again, with what is free of the cameras fixed beforehand, and with OpenCV's corners.

    python benchmarks/cell_models.py --folder FOLDER --keep FILE --models FILE2 [--jobs 1] [--opencv 0]

FOLDER and FILE are those of ``rendered_cells.py --folder FOLDER --keep FILE``; FILE2 keeps this table's errors. Six
camera models (as stated and held; one focal length; two; k1 k2; with p1 p2; with k3), each camera by itself and, where
four are alike, as one: refined from the corners of the images that the command counted, on the truth's side of the
board. An oracle takes the model whose sensors are nearest to the truth, cell by cell. Where the intrinsics are stated
right, the answer is compared with that from poses, too: target poses by the stated intrinsics, solved and refined.

With ``--opencv N`` the first N cells with a checkerboard or a ChArUco board are searched and calibrated once more, each
corner moved to where OpenCV's ``cornerSubPix`` has it, in the window that it is used with most, 11 pixels, or less
where squares are small.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import bars
import cv2
import numpy as np
import rendered_cells as cells
from bars import Row
from rendered_prints import Array

import gtsam_rwhec as rw
from gtsam_rwhec.detect import detector
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.fitting.fit_options import FreeLens
from gtsam_rwhec.fitting.observations import observations_of
from gtsam_rwhec.runs.detection_stage import detect_source
from gtsam_rwhec.runs.solving_stage import solve_log

LENSES: tuple[FreeLens, ...] = ("focal", "focals", "k2", "p2", "k3")
#: Errors in mean over those of the oracle; errors over those from poses, where K is right.
MOST, MOST_OF_POSES = 1.2, 1.05
M_PER_RAD = 0.5
WINDOW_PX = 11


def error_of(poses: Any, cell: cells.Cell) -> float:
    """The root mean square of the sensors' errors, rad, a length as an angle at half a metre."""
    xi = np.array([rw.pose_covariances.error_of(poses[name], T) for name, T in cell.Y.items()])
    return float(np.sqrt(((xi / np.repeat([1.0, M_PER_RAD], 3)) ** 2).sum(axis=1).mean()))


def fixed_models(cell: cells.Cell, log: Path) -> dict[str, float]:
    """Errors of the command's answer, of those of fixed models, and of that from poses."""
    solved = solve_log(log)
    refined, problem = solved.refined, solved.problem
    observations = observations_of(problem)
    warp = refined.reprojection is not None and any(len(b.names) for b in refined.reprojection.boards.values())
    stated = solved.calibration.options.corners
    assert stated is not None
    base = replace(stated, warp_m=1e-3 if warp else 0.0)
    tried: dict[str, rw.CornerOptions] = {}
    if cell.drawn["stated"] != "missing":
        tried["as stated"] = replace(base, stated="exact")
    every: list[tuple[str, ...]] = [(), *([tuple(cell.Y)] if cell.kind == "alike" else [])]
    for shared in every:
        more = ", as one camera" if shared else ""
        tried |= {lens + more: replace(base, lens=lens, shared=(shared,) if shared else ()) for lens in LENSES}
    found = {"command": error_of(refined.Y, cell)}
    for words, options in tried.items():
        try:
            found[words] = error_of(rw.refine_corners(observations, refined.X, refined.Y, options).Y, cell)
        except RwhecError:  # a model that the images cannot have is not the oracle's
            continue
    if cell.drawn["stated"] == "right":
        found["from poses"] = error_of(rw.calibrate(problem, rw.CalibrateOptions(observations="poses")).Y, cell)
    return found


def run(kind: str, seed: int, number: int, folder: Path) -> dict[str, float]:
    """One cell, which was rendered and calibrated."""
    cell = cells.made_cell(kind, seed, number, folder / f"{kind}_{seed}_{number}")
    return fixed_models(cell, cell.folder / "out" / "calibration.mcap")


def with_opencv(kind: str, seed: int, number: int, folder: Path) -> dict[str, Any]:
    """A cell that was rendered, with OpenCV's corners, through the command's stages."""
    cell = cells.made_cell(kind, seed, number, folder / f"{kind}_{seed}_{number}")
    find_checkerboard, board_corners = detector.find_checkerboard, detector.board_corners
    detector.find_checkerboard = lambda gray, board, camera=None: _moved(find_checkerboard(gray, board, camera), gray)
    detector.board_corners = lambda gray, board, tags, camera: _sharp(gray, *board_corners(gray, board, tags, camera))
    try:
        with tempfile.TemporaryDirectory() as temporary:
            out = Path(temporary)
            (out / "images").mkdir()  # without the log of our corners
            for name in cell.Y:
                (out / "images" / name).symlink_to((cell.folder / name).resolve())
            rig = rw.rig.read_rig(cell.folder / "rig.yaml")
            detect_source(out / "images", rig, out / "corners.mcap", workers=1)
            cells.command("calibrate", str(out / "corners.mcap"), "-o", str(out / "out"))
            return cells.compared(cell, rw.results.read_calibration(out / "out"))
    finally:
        detector.find_checkerboard, detector.board_corners = find_checkerboard, board_corners


def _moved(found: Any, gray: Array) -> Any:
    return found and replace(found, corners_px=_sharp(gray, np.arange(0), found.corners_px)[1])


def _sharp(gray: Array, numbers: np.ndarray, corners_px: Array) -> tuple[np.ndarray, Array]:
    """OpenCV's corners (n, 2) near these."""
    apart = np.linalg.norm(corners_px[:, None] - corners_px, axis=2)
    nearest = apart[apart > 0.0].min(initial=4.0 * WINDOW_PX)
    half = int(np.clip(nearest / 3.0, 2, WINDOW_PX))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    flat = corners_px.astype(np.float32).reshape(-1, 1, 2)
    return numbers, cv2.cornerSubPix(gray, flat, (half, half), (-1, -1), criteria).reshape(-1, 2).astype(np.float64)


def rows_of_models(found: list[dict[str, Any]]) -> list[Row]:
    """The command's errors beside those of fixed models."""
    names = [name for name in dict.fromkeys(n for one in found for n in one["errors"]) if name != "command"]
    table = []
    for name in names:
        both = np.array([(one["errors"]["command"], one["errors"][name]) for one in found if name in one["errors"]])
        ratio, figure = both[:, 0].mean() / both[:, 1].mean(), 1e3 * both[:, 1].mean()
        words = f"{ratio:.2f} times, {len(both)} cells; {figure:.3f} mrad; nearer in {(both[:, 0] < both[:, 1]).sum()}"
        table.append(Row(f"the command's mean error over that of: {name}", words))
    for kind in (*cells.KINDS, "all"):
        of_kind = [one["errors"] for one in found if kind in (one["kind"], "all")]
        if not of_kind:
            continue
        ours = np.array([of["command"] for of in of_kind])
        best = np.array([min(v for n, v in of.items() if n not in ("command", "from poses")) for of in of_kind])
        ratio = ours.mean() / best.mean()
        words = f"{ratio:.2f}; median of ratios {np.median(ours / best):.2f}"
        bar, met = (f"<= {MOST}", ratio <= MOST) if kind == "all" else ("", None)
        table.append(Row(f"{kind}: mean error over the oracle's", words, bar, met))
    right = [one["errors"] for one in found if "from poses" in one["errors"]]
    if not right:
        return table
    worse = sum(of["command"] > MOST_OF_POSES * of["from poses"] for of in right)
    ratio = np.mean([of["command"] for of in right]) / np.mean([of["from poses"] for of in right])
    words = f"{worse} of {len(right)}; {ratio:.2f} in mean"
    table.append(Row("K stated right: more than 5 % farther than from poses", words, "0", worse == 0))
    return table


def rows_of_opencv(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> list[Row]:
    """Errors of the sensors with the corners of both."""
    table = []
    pairs = [(a, b) for a, b in zip(ours, theirs, strict=True) if a["verdict"] and b["verdict"]]
    for board in ("Checkerboard", "Charuco"):
        of = [(a, b) for a, b in pairs if a["board"].startswith(board)]
        for unit in ("deg", "mm") if of else ():
            errors = np.array([
                [one["sensors"][n][unit] for one in (a, b)] for a, b in of for n in a["sensors"] if n in b["sensors"]
            ])  # fmt: skip
            ours_mean, their_mean = errors.mean(axis=0)
            nearer = (errors[:, 0] < errors[:, 1]).mean()
            words = f"{ours_mean:.4f} and {their_mean:.4f}; ours is nearer in {nearer:.0%}"
            what = f"{board}, {len(errors)} sensors: mean error, {unit}, ours and OpenCV's"
            table.append(Row(what, words, "ours <= theirs", bool(ours_mean <= their_mean)))
    return table


def rows(folder: Path, keep: Path, models: Path, jobs: int, opencv: int) -> list[Row]:
    """All tables."""
    kept = bars.kept_lines(keep)
    calls = [(one["kind"], one["seed"], one["number"], folder) for one in kept if one["verdict"] is not None]
    done = {(one["kind"], one["seed"], one["number"]) for one in bars.kept_lines(models)}
    for call, errors in bars.each_done(run, [c for c in calls if c[:3] not in done], jobs, "cells"):
        bars.keep_line(models, {"kind": call[0], "seed": call[1], "number": call[2], "errors": errors})
    table = rows_of_models(bars.kept_lines(models))
    if opencv:
        by_call = {(one["kind"], one["seed"], one["number"]): one for one in kept}
        found = {call[:3]: one for call, one in bars.each_done(with_opencv, calls[:opencv], jobs, "cells with OpenCV")}
        table += rows_of_opencv([by_call[at] for at in found], list(found.values()))
    return table


if __name__ == "__main__":
    bars.run_script(
        "fixed camera models, and OpenCV's corners", rows, folder=Path, keep=Path, models=Path, jobs=1, opencv=0
    )
