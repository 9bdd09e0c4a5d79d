"""The rig files of the two folders of other people, as their users would write them, and one of a folder of our own."""

from __future__ import annotations

WORKCELL = """\
carriers: {sensors: base, targets: hand, poses: {frames: [base, hand]}}
sensors:
  camera2: {images: image, poses: pose, intrinsics: intrinsic_pars_file.yaml}
targets:
  board: {type: checkerboard, inner_corners: [3, 4], square_m: 0.05}
"""
CIRCLES = """\
carriers: {sensors: wrist, targets: base, poses: {frames: [base, wrist]}}
sensors:
  camera: {images: images, poses: poses, intrinsics: {K: [550, 550, 320, 240], size: [640, 480]}}
targets:
  grid: {type: circle_grid, circles: [10, 10], spacing_m: 0.0254, larger_dot: true}
"""
UNKNOWN_LENS = """\
carriers: {sensors: hand, targets: base, poses: {frames: [base, hand]}}
sensors:
  camera: {images: images, poses: poses.csv, intrinsics: estimate}
targets:
  board: {type: checkerboard, inner_corners: [5, 4], square_m: 0.05}
"""
