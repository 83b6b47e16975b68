"""Recorded clips, views and runs that the protocols over whole bodies share."""
