"""What the whole-body protocols share: recorded clips, what cameras see of them, runs of a filter."""
