"""Which test file holds which module, where it is not the one of its name.

The rule is tests/PACKAGE/test_MODULE.py for gtsam_rwhec/PACKAGE/MODULE.py, and tests/factors/ for rwhec_factors. The
table has the other modules, each with a file that tests what it is for. tests/test_where_tested.py holds
it complete and true: it names each module that is missing, each entry that is not needed, each file that is not there.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from places import REPOSITORY

TESTS = REPOSITORY / "tests"
#: By the name that the table has: where the modules are, and where their tests.
PACKAGES = {
    "gtsam_rwhec": (REPOSITORY / "gtsam_rwhec", TESTS),
    "factors": (REPOSITORY / "factors" / "rwhec_factors", TESTS / "factors"),
}


def modules() -> Iterator[tuple[str, Path]]:
    """Each module's path in its distribution, without its ending, and the test file of its name."""
    for name, (root, tests) in PACKAGES.items():
        for path in sorted(root.rglob("*.py")):
            if not path.name.startswith("__"):
                place = path.relative_to(root).with_suffix("")
                yield f"{name}/{place.as_posix()}", tests / place.parent / f"test_{place.name}.py"


#: By package, then by file in tests/: the modules that it tests.
TABLE: dict[str, dict[str, str]] = {
    "gtsam_rwhec": {"test_bad_input.py": "errors"},
    "gtsam_rwhec/calibration": {
        "calibration/test_turning_of_carriers.py": "turning",
        "calibration/test_calibrating.py": (
            "calibrated choices clock_stage disagreement noise_choice noise_found noise_stage options "
            "outliers run statement_stage"
        ),
        "calibration/test_corner_stage.py": "corner_choice",
        "calibration/test_cross_validation.py": "folds prediction_errors",
        "calibration/test_task_units.py": "point_uncertainty seen_from",
        "calibration/test_misreadings.py": "reading readings samples trial_fits wrong_units",
        "reprojection/test_by_corners.py": "by_corners",
    },
    "gtsam_rwhec/changes": {
        "changes/test_comparing.py": "calibration_files comparable constant_errors quantities",
        "changes/test_control_chart.py": "chart_limits nights",
        "changes/test_charting.py": "change_found night_spread",
        "changes/test_verifying.py": "near_answer predictions verification",
    },
    "gtsam_rwhec/cleaning": {
        "cleaning/test_pair_consensus.py": "removed",
        "pipeline/test_synthetic_calibration.py": "odometry synchronisation",
        "trajectories/test_trajectory.py": "thinning",
    },
    "gtsam_rwhec/cli": {
        "cli/test_command.py": "app exit_status failures fetch options",
        "cli/test_roads.py": "calibrate",
        "cli/test_wheel.py": "demo",
        "fleet/test_fleet_report.py": "fleet",
        "pipeline/test_commands.py": "clean convert detect export init solve",
        "pipeline/test_verified_log.py": "verify",
    },
    "gtsam_rwhec/evidence": {
        "report/page/test_scene.py": "board_shapes scene",
        "report/page/test_written.py": "evidence gathered inputs measured record",
        "evidence/test_seen_cameras.py": "seen seen_in_problem",
        "evidence/test_linear_model.py": "contribution residuals",
        "pipeline/test_plotted_corners.py": "seen_views",
    },
    "gtsam_rwhec/compat": {
        "compat/test_opencv.py": (
            "andreff certified daniilidis dqopt inputs pair_translations quaternion_methods robot_world stations"
        ),
    },
    "gtsam_rwhec/export": {
        "export/test_camchain.py": "overlaps",
        "export/test_camera_files.py": "camera_info camera_words colmap opencv_cameras",
        "export/test_exported_files.py": "files python_snippet static_tf tf_tree urdf written_poses",
    },
    "gtsam_rwhec/files": {
        "cli/test_stage_display.py": "progress",
        "logs/test_hostile_logs.py": "budgets",
        "pipeline/test_hostile_names.py": "terminal",
        "problem/test_csv_folder.py": "natural_order",
    },
    "gtsam_rwhec/first_rig": {
        "first_rig/test_first_rig.py": "carriers log_contents names proposal targets",
        "first_rig/test_folder_proposal.py": "guessed_intrinsics",
        "pipeline/test_odometry_road.py": "odometry_proposal",
        "vision/test_boards_seen.py": "boards_seen",
    },
    "gtsam_rwhec/fleet": {
        "fleet/test_in_process.py": "attempts order",
        "fleet/test_log_parts.py": "mcap_copy",
        "fleet/test_stores.py": "byte_count store_requests",
        "fleet/test_dask_engine.py": "dask_cluster dask_process extras",
        "fleet/test_summary_page.py": "summary_charts watch_page",
        "fleet/test_watching.py": "night_rows watch_events watch_stream",
        "cli/test_fleet_watch.py": "history watch_words",
        "fleet/test_pair_moments.py": "merging",
        "fleet/test_running.py": ("log_facts map_log receipts solve_robot unit_calibration unit_rows"),
        "fleet/test_partial.py": "container measured_problem",
        "fleet/test_fleet_report.py": "engines",
        "fleet/test_bad_fleets.py": "planning rig_source",
    },
    "gtsam_rwhec/handeye": {
        "handeye/test_certified.py": "chordal_form",
        "handeye/test_cost.py": "motion_costs weights",
        "handeye/test_dual_quaternions.py": "signs",
        "handeye/test_linear_and_nonlinear_calls.py": "registry",
        "handeye/test_optimal.py": "proof saddle",
        "handeye/test_prior.py": "linear_prior",
        "handeye/test_refusals.py": "request",
        "methods/test_chained.py": "on_pairs",
    },
    "gtsam_rwhec/identifiability": {
        "identifiability/test_identification.py": "threshold verdicts",
        "identifiability/test_large_identification.py": "pairs_alone weak_directions",
    },
    "gtsam_rwhec/logs": {
        "logs/test_hostile_bags.py": "bag_definitions ros1_checks ros2_checks",
        "logs/test_hostile_logs.py": "mcap_chunks mcap_index mcap_records",
        "logs/test_mcap_reader.py": "mcap_blocks",
        "logs/test_pose_files.py": "pose_rows pose_tables pose_trees",
        "logs/test_image_folder.py": "stamp_text",
        "pipeline/test_folder_log.py": "matched_images",
        "logs/test_message_kinds.py": "checked_poses decoders records ros2_fields ros2_schemas",
        "logs/test_ros_detections.py": "ros2_detections",
        "logs/test_mcap_writer.py": "foxglove_schemas written_schemas",
        "logs/test_ros_bags.py": "ros_bag_process",
    },
    "gtsam_rwhec/methods": {
        "methods/test_closed_forms.py": "absolute dornaika1998 li2010 linear_methods normal_equations zhuang1994",
        "methods/test_comparison.py": "comparison_file",
        "methods/test_evangelista2023.py": "image_methods",
        "methods/test_heller2014.py": "quaternion_moments unit_weights",
        "methods/test_horn2023.py": "dual_quaternion_relaxation",
        "methods/test_reprojection.py": "corner_costs",
        "methods/test_registry.py": "applicability certified estimate evaluation method",
    },
    "gtsam_rwhec/noise_model": {
        "noise_model/test_likelihood.py": (
            "average_information drift eliminated_drift gradient measurements sparse_columns"
        ),
        "noise_model/test_stations.py": "rows",
        "reprojection/test_as_refined.py": "in_corners",
        "noise_model/test_refining.py": (
            "agreement components drift_choice found mixture modelled options prior_knowledge reml settling typical"
        ),
    },
    "gtsam_rwhec/odometry": {
        "odometry/test_calibrated.py": "found",
        "pipeline/test_odometry_road.py": "judging odometry_file",
        "odometry/test_calibrating_odometries.py": (
            "calibrating clocks findings freedom given_rows other_answers plausible refining result solved_windows up"
        ),
        "odometry/test_gates.py": "motions sampling window_choice",
        "odometry/test_given.py": "options",
        "odometry/test_odometry_tracks.py": "tracks",
        "odometry/test_joint_solution.py": "joint_form",
        "odometry/test_odometry_likelihood.py": "likelihood noise_by_residuals outlying unknowns window_motions",
    },
    "gtsam_rwhec/pipeline": {
        "test_gallery.py": "turned_images",
        "pipeline/test_all_stages.py": "image_options log_evidence log_report",
        "vision/test_likely_causes.py": "causes_in_words likely_causes",
        "pipeline/test_seen_sheet.py": "detected_source image_names",
        "pipeline/test_bad_logs.py": "no_detections",
        "pipeline/test_kept_detections.py": "detection_inputs",
        "pipeline/test_log_corners.py": "corner_answer first_answer",
        "pipeline/test_doubted_intrinsics.py": "seen_corners",
        "pipeline/test_log_findings.py": "output_paths",
        "pipeline/test_real_dataset.py": "driver_detections",
        "pipeline/test_commands.py": "log_metadata",
        "pipeline/test_verified_log.py": "old_calibration",
        "pipeline/test_mixed_odometry.py": "comparable_noise odometry_pairs odometry_windows",
        "pipeline/test_odometry_road.py": "odometry_cleaning odometry_solving odometry_tracks",
        "pipeline/test_synthetic_calibration.py": (
            "carrier_motion cleaning_stage detection_stage detections_in_images image_detections measured_pairs "
            "sensor_detections settled_poses solution_frames solution_plots solved_log solving_rounds solving_stage"
        ),
    },
    "gtsam_rwhec/problem": {
        "problem/test_corners.py": "corner_poses nearer_poses",
        "problem/test_moments.py": "accumulation",
        "problem/test_many_measurements.py": "moment_stack packed_moments segmented_moments",
        "problem/test_problem.py": "checked_arguments contents knowledge long_translations measurements",
        "problem/test_selection.py": "variance_factors",
        "fleet/test_pair_moments.py": "of_moments",
    },
    "gtsam_rwhec/refinement": {
        "refinement/test_bad_refinement.py": "input_checks",
        "refinement/test_carrier_noise.py": "graph pair_data",
        "refinement/test_coverage.py": "variance_components",
        "refinement/test_graduated.py": "admission truncated_least_squares",
        "refinement/test_refine.py": "chordal fit free_space geodesic optimisation options refined refining variables",
        "refinement/test_robust.py": "inliers weighting",
        "reprojection/test_as_refined.py": "reprojection_found",
    },
    "gtsam_rwhec/report": {
        "calibration/test_cross_validation.py": "cross_validation_table",
        "cli/test_diff.py": "change_report",
        "pipeline/test_odometry_road.py": "odometry_report",
        "pipeline/test_verified_log.py": "verification_report",
        "cli/test_wheel.py": "advice",
        "methods/test_comparison.py": "comparison_report",
        "report/test_solution_report.py": "pose_table printing sentences",
        "report/test_short_report.py": "short_poses",
    },
    "gtsam_rwhec/report/page/scene": {"report/page/test_scene.py": "directions layout model still traces"},
    "gtsam_rwhec/report/page/sections": {
        "report/page/test_scene.py": "scene",
        "report/page/test_seen.py": "seen",
        "report/page/test_residual_sections.py": "contribution residuals",
        "report/page/test_number_sections.py": (
            "covariance_charts determines inputs pose_tables proof spectrum_chart uncertainty verdict weak_directions"
        ),
    },
    "gtsam_rwhec/report/page": {
        "report/page/test_seen.py": "empty_regions seen_figures",
        "report/page/test_residual_sections.py": "residual_charts",
        "cli/test_diff.py": "changes_page",
        "pipeline/test_odometry_road.py": "odometry_page",
        "report/page/test_figures.py": "figure_files",
        "report/page/test_written.py": "blocks html shown_result",
    },
    "gtsam_rwhec/report/plots": {
        "report/plots/test_plots.py": "coverage deviations frames intrinsics plotted residuals",
    },
    "gtsam_rwhec/reprojection": {
        "reprojection/test_held_out.py": "jackknife",
        "methods/test_reprojection.py": "observations",
        "reprojection/test_calibrating_corners.py": "chosen_poses first_intrinsics",
        "reprojection/test_corner_findings.py": "findings",
        "reprojection/test_corner_graph.py": "model",
        "reprojection/test_refining_a_problem.py": "in_numbers problem_corners refining",
        "reprojection/test_refining_corners.py": "corner_outliers freedom intrinsics options refined stated_intrinsics",
    },
    "gtsam_rwhec/results": {
        "reprojection/test_corners_in_files.py": "corners_agreement",
        "results/test_agreement.py": "covariance_agreement",
        "results/test_result_file.py": "conventions json_tree schema written_result",
    },
    "gtsam_rwhec/rig": {
        "rig/test_rig_faults.py": "contradictions",
        "rig/test_odometry_rig.py": "given_section odometry_contradictions odometry_section reference_carrier",
        "export/test_exported_files.py": "camera_link",
        "reprojection/test_corners_in_files.py": "refined_frames",
        "rig/test_rig_file.py": "field_types intrinsics_section rig section sections target_sections written_rig",
    },
    "gtsam_rwhec/simulate": {
        "simulate/test_paper_simulations.py": "camera_on_sphere fixed_cameras",
        "simulate/test_rig.py": "graphs motion scales",
        "simulate/test_simulation.py": "transforms",
    },
    "gtsam_rwhec/solver": {
        "identifiability/test_information.py": "residuals",
        "solver/test_block_matrix.py": "elimination",
        "solver/test_graph_form.py": "graph_start",
        "solver/test_bound.py": (
            "bound_loss curvature form_rounding null_vectors part_form polish region stored_form weakest_rotation"
        ),
        "solver/test_measured_form.py": "exact_residuals given measured_priors point",
        "solver/test_reduced_form.py": "full_form variables",
        "solver/test_local_dual.py": "local_relaxation own_curvature",
        "solver/test_search.py": "attempt searched_part stages",
        "solver/test_search_methods.py": "options",
    },
    "gtsam_rwhec/solving": {
        "solving/test_certified_solution.py": "part_solution",
    },
    "gtsam_rwhec/trajectories": {"trajectories/test_trajectory.py": "local_paths"},
    "gtsam_rwhec/vision": {
        "vision/test_ambiguity.py": "agreement",
        "vision/test_board_tags.py": "detected layout_cures sightings tag_agreement",
        "vision/test_boards.py": "crossing_edges",
        "vision/test_camera.py": "distortion",
        "vision/test_circle_grids.py": "circle_centres circle_lattice",
        "vision/test_contact_sheet.py": "picture_text",
        "vision/test_detection.py": "options rejection",
        "vision/test_drawn_errors.py": "jpeg",
        "vision/test_edges.py": "edge_geometry edge_profiles",
        "vision/test_images.py": "image_sizes",
        "vision/test_intrinsics_files.py": "intrinsics_numbers",
        "vision/test_targets.py": "dictionaries tag_boards target_checks",
    },
    "factors": {
        "factors/test_drop_in.py": "hand_eye",
        "factors/test_known_carrier_options.py": "arguments measurement",
        "factors/test_priors.py": "values",
        "factors/test_summaries_and_batches.py": "batch edge_summary",
    },
}

WHERE_TESTED = {
    f"{package}/{module}": file
    for package, files in TABLE.items()
    for file, modules_of in files.items()
    for module in modules_of.split()
}
