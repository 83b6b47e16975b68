"""Readers of one file format each, which `torchpose.io` chooses from."""
