"""Particle filters over body poses."""
