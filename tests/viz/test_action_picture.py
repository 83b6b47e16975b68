"""The picture of an action space shows the performances, their mean and the deviations."""

import numpy as np
import pytest

from torchpose.learning._action_spaces import fit_synchronised

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from tests.priors.performances import performances
from torchpose.errors import InputError, ShapeError
from torchpose.viz import plot_action_space, save_figure


def test_the_picture_shows_performances_mean_and_deviation(tmp_path) -> None:
    space, steps = fit_synchronised(performances(8), 5, name="bend")
    figure = plot_action_space(space, steps, deviations=2.0)
    axes = np.array(figure.axes).reshape(2, 4)
    for d in range(4):
        lines = [np.asarray(line.get_ydata(), float) for line in axes[1, d].lines]
        for p in range(8):
            np.testing.assert_allclose(lines[p], steps.after[p, :, d].numpy())
        mean, std = space.performance[:, d].numpy(), space.std[:, d].numpy()
        np.testing.assert_allclose(lines[8], mean - 2 * std)
        np.testing.assert_allclose(lines[9], mean + 2 * std)
        np.testing.assert_allclose(lines[10], mean)
        assert len(lines) == 11 + len(steps.key_frames) - 2
        before = [np.asarray(line.get_ydata(), float) for line in axes[0, d].lines]
        np.testing.assert_allclose(before[3], steps.before[3, :, d].numpy())
        np.testing.assert_allclose(before[-1], steps.before[..., d].mean(0).numpy())
    assert "bend" in figure.get_suptitle()
    assert save_figure(figure, tmp_path / "bend.png").stat().st_size > 10_000
    assert len(plot_action_space(space, steps, n_dimensions=9).axes) == 10


def test_bad_input() -> None:
    space, steps = fit_synchronised(performances(8), 5)
    with pytest.raises(InputError, match="n_dimensions must be at least 1"):
        plot_action_space(space, steps, n_dimensions=0)
    with pytest.raises(ShapeError, match="postures and dimensions"):
        plot_action_space(space.with_dimensions(3), steps)
    with pytest.raises(InputError, match=r"space must be of ActionSpace, from .* got str"):
        plot_action_space("bend", steps)
    with pytest.raises(InputError, match=r"synchronised must be of Synchronised, from .* got list"):
        plot_action_space(space, performances(8))
