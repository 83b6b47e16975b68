"""Filter body poses by particles, from silhouettes."""
