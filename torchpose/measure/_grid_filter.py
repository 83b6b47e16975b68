"""Filter the places of two hands over a grid: prediction, mutual exclusion, estimate."""

import math
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.module_state import outside_inference

_LEAST = 1e-12  # belief in a cell: denormal numbers are slow


class GridEstimate(NamedTuple):
    """Holds the estimate that is read from a belief over a grid, in cells.

    Attributes:
        place: mean about the mode. covariance: there. mass: probability near the mode.
        mode: the cell, column and row.
    """

    place: Float[Tensor, "N 2 2"]
    covariance: Float[Tensor, "N 2 2 2"]
    mass: Float[Tensor, "N 2"]
    mode: Int[Tensor, "N 2 2"]


def blur(
    maps: Float[Tensor, "*batch h w"], sigma: float, shift: Float[Tensor, "*batch 2"] | None = None
) -> Float[Tensor, "*batch h w"]:
    """Return maps blurred by a Gaussian and shifted by `shift` (x, y), in cells."""
    if sigma == 0 and shift is None:
        return maps
    height, width = maps.shape[-2:]
    if shift is None:
        return gaussian_matrix(height, sigma) @ maps @ gaussian_matrix(width, sigma).mT
    x, y = shift.unbind(-1)
    return gaussian_matrix(height, sigma, y) @ maps @ gaussian_matrix(width, sigma, x).mT


def gaussian_bump(
    mean: Float[Tensor, "*batch 2"], cov: Float[Tensor, "*batch 2 2"], size: tuple[int, int]
) -> Float[Tensor, "*batch h w"]:
    """Return Gaussians over a grid, each of which sums to one.

    Args:
        mean: (x, y), in cells. cov: cells squared. size: rows and columns.
    """
    x = torch.arange(size[1], dtype=mean.dtype) - mean[..., :1]
    y = torch.arange(size[0], dtype=mean.dtype) - mean[..., 1:]
    precision = torch.linalg.inv(cov)[..., None, None]
    xx = precision[..., 0, 0, :, :] * x[..., None, :].square()
    yy = precision[..., 1, 1, :, :] * y[..., :, None].square()
    xy = 2 * precision[..., 0, 1, :, :] * x[..., None, :] * y[..., :, None]
    return torch.softmax(-0.5 * (xx + yy + xy).flatten(-2), -1).view(*mean.shape[:-1], *size)


def predict(
    belief: Float[Tensor, "N 2 h w"],
    rebirth: Float[Tensor, "N 2 h w"],
    speed: Float[Tensor, "N 2 2"],
    flow: Float[Tensor, "N h w 2"] | None,
    moves: Float[Tensor, " N"],
    near: float,
    far: float,
    near_share: float,
    flow_share: float,
    flow_blur: float,
    jump: float,
    rest: float = 0.35,
) -> Float[Tensor, "N 2 h w"]:
    """Return the prediction p(x_t | z_1..t-1): diffusion, velocity, optical flow, reinitialisation.

        p' = m [(1 - j) ((1 - f) (s G_near(v) + (1 - s) G_far) p + f flow p) + j q] + (1 - m) G_rest p

    Args:
        belief: p. rebirth: q, where hands are reinitialised, sums to one. speed: v, cells per step.
            flow: from each cell back to the place of its content, cells. moves: m, the amount of
            motion in the frame, 0 to 1.
        near, far, flow_blur, rest: standard deviations, cells. near_share: s. flow_share: f. jump: j.
    """
    out = blur(belief, near, speed).lerp_(blur(belief, far), 1 - near_share)
    if flow is not None and flow_share > 0:
        out = out.lerp_(_carry(blur(belief, flow_blur), flow), flow_share)
    out = out.lerp_(rebirth, jump)
    return blur(belief, rest).lerp_(out, moves[:, None, None, None])


def _carry(belief: Float[Tensor, "N 2 h w"], flow: Float[Tensor, "N h w 2"]) -> Tensor:
    """Return the belief at the places that the content of each cell comes from."""
    start, scale = _whole_grid(belief.shape[-2], belief.shape[-1])
    grid = torch.addcmul(start.to(flow), scale.to(flow), flow)
    return torch.nn.functional.grid_sample(belief, grid, align_corners=False)


@cache
@outside_inference()
def _whole_grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return the places of all cells as `grid_sample` takes them, and how far apart these are [h, w, 2]."""
    x, y = (2 * torch.arange(n, dtype=torch.float32) + 1 for n in (width, height))
    start = torch.stack(torch.broadcast_tensors(x / width - 1, (y / height - 1)[:, None]), -1)
    scale = start.new_tensor([2 / width, 2 / height]).expand_as(start)
    return start.contiguous(), scale.contiguous()


def without_jumps(
    predicted: Float[Tensor, "N 2 h w"],
    cost: float,
    reach: float,
    radius: float,
    present: Float[Tensor, "N 2"],
) -> Float[Tensor, "N 2 h w"]:
    """Return the predictions of both hands, less likely where one could only have jumped to the other.

        p'_k(x) = p_k(x) (1 - v_l taken_l(x) (1 - exp(-J v_k (max_y near_k(y) - near_k(x)))))

    near_k is the predicted probability of a hand within about `reach` of x, taken_l that of the other one
    within about `radius`. A hand that was seen elsewhere
    has to move to the other hand l, however much the place of l looks like a hand. One whose place was
    not known, or that was not visible, may appear there.

    Args:
        predicted: p, each sums to one. cost: J, nats. reach, radius: cells.
        present: v, the probability that each hand is visible.
    """
    there = present[..., None, None]
    total = predicted.sum((2, 3), keepdim=True)
    near, taken = (_mass_near(predicted, size, total) for size in (reach, radius))
    jump = near.amax((2, 3), keepdim=True).sub(near).mul_(-cost * there).expm1_()
    return jump.mul_(taken.mul_(there).flip(1)).add_(1).mul_(predicted)


def exclude(
    base: Float[Tensor, "N 2 h w"],
    exclusion: float,
    radius: float,
    crossing: float,
    soft: float,
    present: Float[Tensor, "N 2"],
    rounds: int = 2,
) -> Float[Tensor, "N 2 h w"]:
    """Return the beliefs of the left and the right hand after mutual exclusion.

        p_k(x) ~ b_k(x) (1 - (1 - e^-X) v_l taken_l(x)) (1 - (1 - e^-C) v_l wrong_l(x))

    taken_l is the probability of the other hand l within about `radius` of x. wrong_l is its
    probability on the wrong side of x: the person's left hand is seldom to the left of the right
    hand in the image. A hand that is not visible takes no place in it.

    Args:
        base: beliefs before, any scale. exclusion: X. crossing: C. radius, soft: cells.
        present: v, the probability that each hand is visible.
        rounds: of messages from each hand to the other.
    """
    base = (base / base.sum((2, 3), keepdim=True).clamp_min(1e-30)).clamp_min_(_LEAST)
    hands = list(base.unbind(1))
    belief = list(hands)
    for turn in range(2 * rounds):  # one hand after the other: both at once would oscillate
        k = turn % 2
        there = present[:, 1 - k, None, None]
        taken, wrong = (x.mul_(there) for x in _occupied(belief[1 - k], k, radius, soft))
        free = taken.mul_(math.expm1(-exclusion)).add_(1)
        belief[k] = hands[k] * free.mul_(wrong.mul_(math.expm1(-crossing)).add_(1))
    both = torch.stack(belief, 1)
    return both.div_(both.sum((2, 3), keepdim=True)).clamp_min_(_LEAST)


def _occupied(
    other: Tensor, hand: int, radius: float, soft: float
) -> tuple[Float[Tensor, "N h w"], Float[Tensor, "N 1 w"]]:
    """Return taken_l and wrong_l of `exclude`."""
    columns = other.sum(1, keepdim=True)
    total = columns.sum(2, keepdim=True)
    wrong = (columns @ _side_matrix(other.shape[2], soft, hand)).div_(total)
    return _mass_near(other, radius, total), wrong


def _mass_near(
    belief: Float[Tensor, "*batch h w"], radius: float, total: Float[Tensor, "*batch 1 1"]
) -> Float[Tensor, "*batch h w"]:
    """Return the share of each belief within about a radius of every cell."""
    return blur(belief, radius).mul_(1.2 * 2 * math.pi * radius * radius / total).clamp_(0, 1)


@cache
@outside_inference()
def _side_matrix(size: int, soft: float, hand: int) -> Tensor:
    """Return the matrix from columns of the other hand to how far each column is on its wrong side."""
    left_of = gaussian_matrix(size, soft) @ torch.ones(size, size, dtype=torch.float32).tril()
    return (1 - left_of if hand == 0 else left_of).mT.contiguous()


def read_out(belief: Float[Tensor, "N 2 h w"], smooth: float, within: float) -> GridEstimate:
    """Return the mean, covariance and mass about the highest place of each smoothed belief.

    Args:
        belief: sums to one. smooth: standard deviation of the blur before the search for the mode, cells.
        within: radius about the mode that counts, cells.
    """
    n, hands, height, width = belief.shape
    best = blur(belief, smooth).flatten(2).argmax(2)
    mode = torch.stack([best % width, best // width], 2)
    powers, disc = _disc(within)
    (columns, inside_x), (rows, inside_y) = (
        _within_row(mode[..., i, None] + powers[1].long(), size)
        for i, size in enumerate((width, height))
    )
    index = rows[..., None] * width + columns[..., None, :]
    near = belief.flatten(2).gather(2, index.flatten(2)).view(index.shape).double()
    near = near * (disc & inside_y[..., None] & inside_x[..., None, :])
    moments = (powers @ near @ powers.mT).flatten(2)
    mass, mx, xx, my, xy, _, yy, *_ = moments.unbind(2)
    mx, my = mx / mass, my / mass
    xx, xy, yy = xx / mass - mx * mx, xy / mass - mx * my, yy / mass - my * my
    covariance = torch.stack([xx, xy, xy, yy], 2).view(n, hands, 2, 2)
    return GridEstimate(mode + torch.stack([mx, my], 2), covariance, mass, mode)


def _within_row(places: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the nearest of `size` cells, and whether it is the place itself."""
    nearest = places.clamp(0, size - 1)
    return nearest, nearest == places


@cache
@outside_inference()
def _disc(radius: float) -> tuple[Float[Tensor, "3 d"], Bool[Tensor, "d d"]]:
    """Return 1, x and x squared of every cell of a row about the middle, and the cells within the radius."""
    reach = math.ceil(radius)
    away = torch.arange(-reach, reach + 1, dtype=torch.float64)
    disc = away.square() + away.square()[:, None] < radius * radius
    return torch.stack([torch.ones_like(away), away, away.square()]), disc


def gaussian_matrix(
    size: int, sigma: float, shift: Float[Tensor, "*batch"] | None = None
) -> Float[Tensor, "*batch size size"]:
    """Return the matrix G that blurs a row of `size` cells and shifts it by `shift` cells: out = G in.

    Two of them blur a map: G_y map G_x^T. Every column sums to one, so no mass is lost at the border.

    >>> gaussian_matrix(3, 0.5)[:, 1]
    tensor([0.1065, 0.7870, 0.1065])
    """
    if shift is None:
        return _still_matrix(size, sigma)
    return _gaussian(size, sigma, shift[..., None])


@cache
@outside_inference()
def _still_matrix(size: int, sigma: float) -> Tensor:
    """Return `gaussian_matrix` without a shift, cached."""
    return _gaussian(size, sigma, torch.zeros(1, dtype=torch.float32))


def _gaussian(size: int, sigma: float, shift: Tensor) -> Tensor:
    """Return `gaussian_matrix`, whose entries depend on the distance from the diagonal alone."""
    away, index = _diagonals(size)
    exponent = -0.5 * ((away.to(shift) - shift) / sigma).square()
    weight = exponent.clamp_(min=-40).exp_()  # nothing so small that the processor becomes slow
    rows = weight.reshape(-1, 2 * size - 1)  # of more dimensions, `index_select` is slow
    weight = rows.index_select(1, index).view(*shift.shape[:-1], size, size)
    return weight / weight.sum(-2, keepdim=True).clamp_min(1e-6)


@cache
@outside_inference()
def _diagonals(size: int) -> tuple[Tensor, Tensor]:
    """Return how far each diagonal is from the middle one, and the diagonal of each entry, row by row."""
    place = torch.arange(size)
    return torch.arange(1 - size, size), (place[:, None] - place + size - 1).flatten()
