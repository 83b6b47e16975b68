"""Feet of whole bodies from keypoints of calibrated cameras: `python -m benchmarks.keypoint_feet`."""
