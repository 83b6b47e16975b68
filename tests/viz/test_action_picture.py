"""The picture of an action space shows the performances, their mean and the deviations."""

import numpy as np
import pytest

from torchpose.learning import fit_action_space
from torchpose.learning._action_spaces import fit_synchronised

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from tests.priors.performances import performances
from torchpose.errors import InputError, ShapeError
from torchpose.priors import ActionSpace
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


def test_a_fitted_space_is_drawn_with_its_performances_and_a_saved_one_is_not(tmp_path) -> None:
    space = fit_action_space(performances(8), 5, name="bend")
    steps = fit_synchronised(performances(8), 5)[1]
    first = space.with_dimensions(3)
    for drawn in (plot_action_space(space), plot_action_space(first)):
        lines = drawn.axes[0].lines
        np.testing.assert_allclose(lines[3].get_ydata(), steps.before[3, :, 0].numpy())
    assert len(plot_action_space(first).axes) == 6
    space.save(tmp_path / "bend.safetensors")
    loaded = ActionSpace.load(tmp_path / "bend.safetensors")
    with pytest.raises(InputError, match="from a file has no performances"):
        plot_action_space(loaded)
    assert loaded.with_dimensions(2).synchronised is None


def test_bad_input() -> None:
    space, steps = fit_synchronised(performances(8), 5)
    with pytest.raises(InputError, match="n_dimensions must be at least 1"):
        plot_action_space(space, steps, n_dimensions=0)
    with pytest.raises(ShapeError, match="postures and dimensions"):
        plot_action_space(space.with_dimensions(3), steps)
    with pytest.raises(InputError, match=r"space must be from .* got str"):
        plot_action_space("bend", steps)
    with pytest.raises(InputError, match=r"synchronised must be from .* got list"):
        plot_action_space(space, performances(8))
