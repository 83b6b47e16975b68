"""Pictures of a prior: what is drawn, where, how strong, and what is refused."""

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from matplotlib.collections import LineCollection, PathCollection

from tests.priors.mixtures import random_mixture
from tests.priors.poses import REST
from torchpose.camera._viewpoints import Viewpoints
from torchpose.errors import InputError
from torchpose.priors import GaussianMixture, UpperBodyPrior
from torchpose.priors._arm_state import arm_states, mirror_mixture
from torchpose.priors._prior_file import PriorInfo
from torchpose.priors._window import WindowLayout, WindowPrior
from torchpose.viz._prior_pictures import (
    plot_log_likelihood,
    plot_prior_components,
    plot_prior_samples,
)

WEIGHTS = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
RAISED = REST.clone()
RAISED[[0, 1]] = torch.tensor([[0.32, -0.4, 0.0], [0.30, -0.15, 0.0]], dtype=torch.float64)


def one_arm(spread: float = 1e-6) -> GaussianMixture:
    """Three poses of a left arm, each seen from a viewpoint of its own."""
    bodies = torch.stack([REST, RAISED, 1.1 * REST])
    angles = torch.tensor([[0.1, -0.2, 0.3], [0.0, 0.1, -0.2], [0.2, 0.0, 0.1]]).double()
    place = torch.tensor([[0.1, -0.2, 2.0], [0.0, 0.0, 2.4], [-0.1, 0.1, 1.8]]).double()
    left, _ = arm_states(bodies, Viewpoints(angles, place), PriorInfo().matrix)
    return GaussianMixture(WEIGHTS, left, spread * torch.eye(21).double().expand(3, 21, 21))


@pytest.fixture(scope="module")
def prior() -> UpperBodyPrior:
    left = one_arm()
    return UpperBodyPrior(left, mirror_mixture(left, 319.5), PriorInfo("small", mirrored=True))


def markers(ax) -> np.ndarray:
    """Joints drawn in a panel, in the order drawn."""
    drawn = [c for c in ax.collections if isinstance(c, PathCollection)]
    return np.concatenate([np.asarray(c.get_offsets()) for c in drawn])


def bones(ax) -> LineCollection:
    """Limbs of the first pose of a panel."""
    return next(c for c in ax.collections if isinstance(c, LineCollection))


def panels(figure) -> list:
    """Panels with a pose in them."""
    return [ax for ax in figure.axes if ax.collections]


def test_components_are_the_poses_that_were_put_in_heaviest_first(prior) -> None:
    figure = plot_prior_components(prior)
    assert [ax.get_title() for ax in panels(figure)] == ["50.0 %", "30.0 %", "20.0 %"]
    joints = markers(panels(figure)[0])
    front_left, front_right, side = joints[:5], joints[5:10], joints[10:15]
    np.testing.assert_allclose(front_left, RAISED[:5, :2], atol=1e-9)
    np.testing.assert_allclose(front_right, RAISED[:5, :2] * torch.tensor([-1, 1]), atol=1e-9)
    np.testing.assert_allclose(np.diff(side[:, 0]), RAISED[:5, 2].diff(), atol=1e-9)
    np.testing.assert_allclose(side[:, 1], RAISED[:5, 1], atol=1e-9)
    widths = [max(bones(ax).get_linewidths()) for ax in panels(figure)]
    assert widths == sorted(widths, reverse=True) and widths[0] > widths[2]


def test_arms_that_are_no_mirror_images_have_blocks_of_their_own(prior) -> None:
    own = UpperBodyPrior(one_arm(), mirror_mixture(one_arm(), 319.5), PriorInfo("two"))
    figure = plot_prior_components(own, n_shown=2)
    assert len(panels(figure)) == 4
    layout = WindowLayout((4,), ())
    windows = {"causal": WindowPrior(random_mixture(3, 23), random_mixture(3, 23), layout, {})}
    with_windows = UpperBodyPrior(prior.left, prior.right, prior.info, None, windows)
    assert len(panels(plot_prior_components(with_windows, "causal"))) == 6
    with pytest.raises(InputError, match="must be one of pose, causal, got 'full'"):
        plot_prior_components(with_windows, "full")
    with pytest.raises(InputError, match="n_shown"):
        plot_prior_components(prior, n_shown=0)


def test_draws_are_seeded_and_on_one_neck(prior) -> None:
    first, again, other = (plot_prior_samples(prior, 3, seed, 20) for seed in (0, 0, 1))
    bodies = [markers(panels(figure)[0]) for figure in (first, again, other)]
    np.testing.assert_array_equal(bodies[0], bodies[1])
    assert not np.array_equal(bodies[0], bodies[2])
    np.testing.assert_allclose(bodies[0][4], 0, atol=1e-9)
    known = torch.stack([REST, RAISED, 1.1 * REST])[:, 0, :2].numpy()
    assert np.abs(bodies[0][0] - known).max(-1).min() < 0.02  # a hand of one of the three poses
    with pytest.raises(InputError, match="at least 1"):
        plot_prior_samples(prior, 0)


def test_likelihood_marks_the_best_held_out_step_and_skips_missing_ones() -> None:
    held_out = [torch.nan, -14.0, torch.nan, -12.5, torch.nan, -13.0]
    training = {
        "pose": [-30, -14, -13, -12.2, -12.1, -12],
        "causal.left": torch.linspace(-20, -10, 6),
    }
    figure = plot_log_likelihood(training, {"pose": held_out})
    curve, best = figure.axes[0].lines[2:4]
    assert curve.get_xdata().tolist() == [2, 4, 6]
    assert best.get_xydata().tolist() == [[4, -12.5]]
    assert figure.axes[0].get_ylim()[0] > -20  # the first step is off the scale
    assert len(figure.axes[1].lines) == 2
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words == ["training persons", "held-out persons", "best step"]
    assert len(plot_log_likelihood(training).legends[0].get_texts()) == 2
    with pytest.raises(InputError, match="the training curve of pose has no finite value"):
        plot_log_likelihood({"pose": [torch.nan]})
    with pytest.raises(InputError, match="held-out values of full"):
        plot_log_likelihood(training, {"full": [1.0]})
    with pytest.raises(InputError, match="at least one, got none"):
        plot_log_likelihood({})


def test_pictures_are_not_blank(prior) -> None:
    for figure in (plot_prior_components(prior), plot_prior_samples(prior, 2, n_cloud=10)):
        figure.set_dpi(40)
        figure.canvas.draw()
        inked = (np.asarray(figure.canvas.buffer_rgba())[..., :3] < 250).any(-1).mean()
        assert 0.01 < inked < 0.5
        for legend in figure.legends:
            box = legend.get_window_extent()
            assert not any(box.overlaps(ax.get_window_extent()) for ax in panels(figure))
