"""Cameras that are slightly wrong: delays and turned cameras, found from the keypoints of a body."""
