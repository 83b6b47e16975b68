"""Read one file format per module, which `torchpose.io` chooses from."""
