"""A session of gtsam-rwhec on ROS 2 topics."""
