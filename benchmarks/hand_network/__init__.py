"""Fit the network that tells hands in video, and score it on persons that it was not fitted to."""
