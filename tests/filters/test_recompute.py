"""Gradients that are computed from the arguments anew, against those that keep everything."""

import gc

import pytest
import torch

from torchpose.filters._recompute import recomputed


def curve(x, slope):
    """Two outputs, with something large between for each."""
    times = torch.linspace(0, 1, 50, dtype=x.dtype)
    first = (x[:, None] * times).sin() @ slope
    second = (x[:, None] + times).sin() @ slope
    return first.square().sum(-1), second.exp().mean(-1)


@pytest.fixture
def problem():
    g = torch.Generator().manual_seed(0)
    x = torch.randn(6, generator=g, dtype=torch.float64, requires_grad=True)
    return x, torch.randn(50, 3, generator=g, dtype=torch.float64, requires_grad=True) / 10


def test_gradients_of_arguments_and_of_what_the_function_sees_are_the_same(problem):
    x, slope = problem
    for pick in (0, 1):
        plain = torch.autograd.grad(curve(x, slope)[pick].sum(), [x, slope])
        ours = torch.autograd.grad(recomputed(lambda x: curve(x, slope), x)[pick].sum(), [x, slope])
        for found, expected in zip(ours, plain, strict=True):
            torch.testing.assert_close(found, expected, rtol=0, atol=0)


def test_a_graph_may_be_gone_through_twice_and_differentiated_again(problem):
    x, slope = problem
    total = sum(out.sum() for out in recomputed(curve, x, slope))
    first = torch.autograd.grad(total, x, retain_graph=True)[0]
    torch.testing.assert_close(torch.autograd.grad(total, x)[0], first)
    few = slope.detach()[:, :1].requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x: recomputed(curve, x, few), x)


def test_nothing_in_between_is_kept_before_or_after(problem):
    x, slope = problem

    def large():
        objects = gc.get_objects()
        return sum(type(o) is torch.Tensor and o.shape == (2, 50) for o in objects)

    parts = [recomputed(curve, x[i : i + 2], slope) for i in (0, 2, 4)]
    assert large() == 0
    # The other output is not asked for: its graph stays, but of what that needs only the last part's.
    sum(first.sum() for first, _ in parts).backward()
    assert large() <= 2
    assert all(second.requires_grad for _, second in parts)


def test_transforms_of_torch_func_go_through(problem):
    x, slope = (value.detach() for value in problem)
    plain = torch.func.jacrev(lambda x: curve(x, slope)[0])(x)
    torch.testing.assert_close(
        torch.func.jacrev(lambda x: recomputed(curve, x, slope)[0])(x), plain
    )
