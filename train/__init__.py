"""Train with Lightning: `python -m train fit --config configs/kinect-upper-body.yaml`.

The library never imports this package; it is run from a checkout and is not part of the wheel.
"""
