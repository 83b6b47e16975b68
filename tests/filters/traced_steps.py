"""Steps of filters that are exported or compiled, against the plain steps; run without shape checks.

`python -m tests.filters.traced_steps` prints a line for each: its name and the largest difference.
"""

import gc
import json
import sys
import warnings

import torch
from torch import nn
from torch.utils import _pytree as pytree

import torchpose
from tests.filters.oracles import tensor
from tests.filters.small_problem import OBSERVED, Problem
from torchpose.filters import BootstrapParticleFilter

SEED = 5
KALMAN = {
    "fixed": {},
    "power and reset": {"likelihood_power": 0.5, "reset_below": -700.0},
    "weighted by frames": {"weighting": "frame"},
    "memoryless": {"weighting": "frame", "transition": "ou", "gamma": 0.0},
    "medians": {"weighting": "frame", "transition": "ou", "gamma": 0.0, "medians": [1]},
    "split": {"tracks": "split"},
    "sampled": {"tracks": "sampled", "resample_threshold": 0.9},
}
PARTICLES = ("mixture", "random-walk", "random-walk-unscaled")


def problem():
    return Problem(batch=3, n_frames=3, seed=2)


def make(name):
    """A small filter by its name."""
    p = problem()
    if name in KALMAN:
        return p.filter(**KALMAN[name])
    model = p.mixture(), tensor(p.process), tensor(p.noise), OBSERVED
    options = {"n_particles": 50, "dtype": torch.float64}
    return BootstrapParticleFilter(*model, proposal=name, **options)


def frames():
    """z and mask, time first."""
    p = problem()
    return tensor(p.z).transpose(0, 1), torch.as_tensor(p.mask).transpose(0, 1)


def sequences():
    """z and mask, sequences first."""
    return [x.transpose(0, 1) for x in frames()]


def seeded(function, *arguments):
    torch.manual_seed(SEED)
    return function(*arguments)


def begun(model):
    """A state after one step whose elements have covariances of their own."""
    z, mask = frames()
    with torchpose.without_value_checks():
        return seeded(lambda: model.step(model.init(3), z[0], mask[0])[0])


class Step(nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, state, z, mask):
        return self.model.step(state, z, mask, return_cov=True)


def largest_difference(found, expected):
    """Of all tensors of two trees; infinite where they are not alike."""
    pairs = zip(pytree.tree_leaves(found), pytree.tree_leaves(expected), strict=True)
    largest = 0.0
    for a, b in pairs:
        if not isinstance(b, torch.Tensor):
            continue
        if a.shape != b.shape or a.dtype != b.dtype:
            return float("inf")
        apart = (a.double() - b.double()).abs()
        apart = torch.where(torch.isnan(a.double()) & torch.isnan(b.double()), 0.0, apart)
        largest = max(largest, float(apart.nan_to_num(torch.inf).max()))
    return largest


class Run(nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, z, mask):
        return tuple(self.model(z, mask, return_cov=True))


class Smoothing(nn.Module):
    def __init__(self, model, lag=None):
        super().__init__()
        self.model, self.lag = model, lag

    def forward(self, z, mask, lengths):
        return tuple(self.model.smooth(z, mask, lengths=lengths, lag=self.lag, return_cov=True))


def traced(way, module, arguments):
    """The module after tracing on these arguments."""
    if way == "export":
        return torch.export.export(module, arguments).module()
    torch.compiler.reset()
    compiled = torch.compile(module, fullgraph=True, backend=way)
    compiled(*arguments)
    return compiled


def step_difference(way, name):
    """Between a step that was traced on one frame and the plain step, on another frame."""
    model, (z, mask) = make(name), frames()
    state, step = begun(model), Step(model)
    found = seeded(traced(way, step, (state, z[1], mask[1])), state, z[2], mask[2])[1]
    # the plain step gives covariances to histories, not to elements
    return largest_difference(found, seeded(step, state, z[2], mask[2])[1])


def run_difference(way, name):
    """Between sequences of two frames that were traced and plain ones, on other measurements."""
    run, (z, mask) = Run(make(name)), (x[:, :2] for x in sequences())
    found = seeded(traced(way, run, (z, mask)), z + 0.5, ~mask)
    return largest_difference(found, seeded(run, z + 0.5, ~mask))


def smoothing_difference(way, name):
    """Between traced smoothing and plain, on other measurements and lengths."""
    smoothing, (z, mask) = Smoothing(make(name)), sequences()
    other = z + 0.5, ~mask, torch.tensor([1, 3, 2])
    found = traced(way, smoothing, (z, mask, torch.tensor([3, 2, 3])))(*other)
    return largest_difference(found, smoothing(*other))


DIFFERENCES = {"step": step_difference, "run": run_difference, "smoothing": smoothing_difference}


if __name__ == "__main__":
    warnings.simplefilter("error")
    gc.disable()  # a fifth of the time would go into objects that tracing makes and keeps
    for case in sys.argv[1:]:
        way, what, name = case.split("/")
        print(json.dumps([case, DIFFERENCES[what](way, name)]), flush=True)
