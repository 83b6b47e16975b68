"""Protocol Bend: one camera, one action, and predictions that its action model lets through (aSpace)."""
