"""Quantiles of bytes against NumPy's."""

import numpy as np
import pytest

from torchpose.measure._brightness import quantile_of_bytes


@pytest.mark.parametrize("shape", [(1,), (2,), (7, 5), (44, 48, 3)])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.9, 0.98, 1.0])
def test_a_quantile_of_bytes_is_that_of_numpy(shape, share):
    image = np.random.default_rng(len(shape)).integers(0, 256, shape, np.uint8)
    assert quantile_of_bytes(image, share) == pytest.approx(np.quantile(image, share), abs=1e-9)
