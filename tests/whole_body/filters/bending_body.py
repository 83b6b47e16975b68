"""A body that bends, or waves, a little differently every time, and actions learnt from that."""

import math

import torch

from torchpose.body import BODY_15, Body
from torchpose.learning import fit_action_space
from torchpose.priors._actions.postures import state_postures

BODY = Body.of_height(BODY_15, 1.75)
FPS = 30.0


def _turn(states, part, column, angle):
    states[:, 3 + 3 * BODY.skeleton.part(part) + column] = (angle / 2).sin()


def performance(action, seed, n_frames=40):
    """States [T, 36] of one performance: "bend" or "wave" (the right arm goes up and down again)."""
    g = torch.Generator().manual_seed(seed)
    size, lag, *sway = (torch.rand(12, generator=g, dtype=torch.float64) - 0.5).tolist()
    t = torch.linspace(0, 1, n_frames, dtype=torch.float64)
    phase = (math.pi * t ** (1 + 0.2 * lag)).sin() ** 2 * (1 + 0.3 * size)
    states = torch.zeros(n_frames, BODY.dim, dtype=torch.float64)
    states[:, 1] = 0.93
    if action == "bend":
        _turn(states, "torso", 0, 1.2 * phase)
        for side in ("left", "right"):
            _turn(states, f"{side}_upper_arm", 0, -0.5 * phase)
            _turn(states, f"{side}_thigh", 0, -0.3 * phase)
            _turn(states, f"{side}_shank", 0, 0.4 * phase)
    else:
        _turn(states, "right_upper_arm", 2, -1.8 * phase)
        _turn(states, "right_forearm", 0, -0.6 * phase)
    for column, value in zip((9, 11, 12, 14, 15, 18, 21, 24, 27, 30), sway, strict=True):
        states[:, column] += 0.06 * value * (1 + t)
    return states


def performances(action, n=8, first=100):
    return [performance(action, first + i, 36 + i) for i in range(n)]


def space(action, n_dimensions=4):
    """An action learnt from eight performances."""
    postures = [state_postures(BODY, states) for states in performances(action)]
    return fit_action_space(postures, n_dimensions, name=action, fps=FPS)
