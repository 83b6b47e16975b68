"""Particle filters over body poses, and the search for a first pose."""
