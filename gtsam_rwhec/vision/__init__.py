"""Images of a log to poses of tags and boards, each with its covariance and what was rejected, with OpenCV."""
