"""Provide what every room stands on: checks, registered state, safe files."""
