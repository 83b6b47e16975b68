"""Measure keypoints by detectors that the user brings: ONNX models, MediaPipe, Python objects."""
