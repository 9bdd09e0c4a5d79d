"""Rig files for tests: one with everything in it, and one with what there must be."""

FULL = """\
# a hand with two cameras
carriers:
  sensors: hand
  targets: base
  poses: {tf: [base, hand]}
  max_gap_s: 0.3
  noise: {rotation_deg: 0.02, translation_mm: 0.2}
sensors:
  cam_left:
    images: /cam_left/image
    intrinsics: {topic: /cam_left/camera_info}
    time_offset: estimate
    frame: cam_left_optical
  cam_right:
    images: /cam_right/image
    intrinsics:
      model: equidistant
      width: 640
      height: 480
      K: [300, 300.5, 320, 240]
      D: [0.01, 0, 1e-4, -0.0]
  driver:
    detections: /tag_detections
targets:
  tag_0: {type: tag, family: tag36h11, id: 0, size_m: 0.12}
  board: {type: charuco, family: aruco_5x5_100, squares: [7, 5], square_m: 0.041, marker_m: 0.03075, first_id: 0}
  grid: {type: aprilgrid, family: tag36h11, tags: [6, 6], tag_m: 0.088, spacing: 0.3, first_id: 10}
  chess: {type: checkerboard, inner_corners: [9, 6], square_m: 0.03}
sizes: check
noise: estimate
detection: {min_side_px: 18, max_reprojection_px: 2.0}
cleaning:
  min_rotation_deg: 0.5
  min_translation_mm: 3
  max_rotation_deg_s: null
  max_translation_m_s: 0.5
  consensus: true
  thin: false
  robust: gnc
"""

MINIMAL = """\
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors: {cam: {detections: /tags}}
targets: {tag: {type: tag, family: tag36h11, id: 3, size_m: 0.1}}
"""
