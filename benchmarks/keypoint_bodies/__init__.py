"""Whole bodies from keypoints of one to four calibrated cameras: `python -m benchmarks.keypoint_bodies`."""
