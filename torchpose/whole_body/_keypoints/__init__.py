"""Track whole bodies from keypoints by a Kalman filter over the articulated body."""
