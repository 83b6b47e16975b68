"""Evaluate priors and trackers on recordings: each protocol is one function, ``run(data, out)``.

- ``score``: a prior and a tracker on any recordings, beside the mean pose.
- ``leave-one-person-out``: each person of any recordings under a prior of the others.
- ``learning-curve``: error over the number of training persons; one person's prior against many.
- ``cross-dataset``: a prior of one data set on another one's persons, and what motion capture adds.

`torchpose evaluate` runs them. Every one returns a `Report`, which is also written into the folder
``out``.
"""

from torchpose._core.facade import set_up_facade
from torchpose.evaluation._report import Report

__all__ = ["Report"]

set_up_facade(__name__)
