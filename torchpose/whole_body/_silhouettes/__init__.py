"""Silhouettes of articulated bodies: rendered, counted against observed ones, weighed."""
