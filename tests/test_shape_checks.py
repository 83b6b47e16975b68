"""The suite itself: wrong shapes are caught, and typed errors come through."""

import os

import pytest
import torch
from jaxtyping import TypeCheckError

from torchpose.camera import _projection as projection
from torchpose.errors import ShapeError
from torchpose.math import _gaussian as gaussian

pytestmark = pytest.mark.skipif(
    os.environ.get("TORCHPOSE_SHAPE_CHECKS") == "0", reason="shape checks are switched off"
)


def test_wrong_shape_is_caught():
    """Mean and covariance disagree about D, which indexing alone would not notice."""
    with pytest.raises(TypeCheckError):
        gaussian.marginal(torch.zeros(3), torch.eye(2), torch.tensor([0]))


def test_wrong_dtype_is_caught():
    with pytest.raises(TypeCheckError):
        gaussian.symmetrise(torch.eye(2, dtype=torch.long))


def test_typed_error_of_the_function_wins():
    eye = torch.eye(3)
    with pytest.raises(ShapeError, match="points"):
        projection.project(torch.zeros(4, 2), eye, eye, torch.zeros(3))
