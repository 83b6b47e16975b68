"""Several bodies from keypoints in calibrated cameras."""
