"""Foundations that every other package stands on: checks, registered state, safe files."""
