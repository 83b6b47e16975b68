"""Fine-tuning through the filters: what gradients are, what stays positive, what a tuned prior does."""

from dataclasses import replace

import pytest
import torch

from tests.priors.mixtures import random_mixture
from tests.priors.poses import recording
from torchpose.demo import performer
from torchpose.errors import InputError, PriorError
from torchpose.learning._fine_tuning import (
    SequenceBatch,
    TunableKalman,
    TunableMixture,
    TunableWindow,
    WindowBatch,
    draw_sequences,
    draw_windows,
    parameter_groups,
    pose_error,
)
from torchpose.learning._recipes import UpperBodyRecipe
from torchpose.metrics import joint_errors_3d
from torchpose.priors import UpperBodyPrior
from torchpose.priors._upper_body_prior import released_process_cov
from torchpose.upper_body import UpperBodyTracker

RECIPE = UpperBodyRecipe(
    n_components=4,
    n_samples=3000,
    pose_steps=8,
    window_components=6,
    window_samples=3000,
    window_steps=6,
    calibration_folds=0,
)


@pytest.fixture(scope="module")
def recordings():
    return [recording(performer(200, seed=s).body, person=f"p{s}", fps=30.0) for s in (1, 2)]


@pytest.fixture(scope="module")
def prior(recordings):
    return RECIPE.fit(recordings)


@pytest.fixture(scope="module")
def sequences(recordings):
    poses = RECIPE.poses(recordings)
    return list(poses.joints.split(poses.lengths))


@pytest.fixture(scope="module")
def sources(recordings):
    tasks = RECIPE.tasks(recordings)
    found = {}
    for side in ("left", "right"):
        source = tasks[f"causal.{side}"].source
        found[side] = replace(getattr(source, "source", source), fresh=True)
    return found


def pieces(sequences, prior, n=4, seed=0, **options) -> SequenceBatch:
    return draw_sequences(sequences, prior, n, torch.Generator().manual_seed(seed), **options)


def noise(seed=0):
    return torch.Generator().manual_seed(seed)


# --- mixtures ---------------------------------------------------------------------------------


def test_a_tunable_mixture_starts_where_it_was_and_knows_how_far_it_went():
    start = random_mixture(3, 2)
    tunable = TunableMixture(start)
    for own, other in zip(
        tunable.mixture().parameters_tuple(), start.parameters_tuple(), strict=True
    ):
        torch.testing.assert_close(own, other)
    assert float(tunable.departure().detach()) == pytest.approx(0.0, abs=1e-12)


def test_the_departure_of_one_component_is_the_divergence_of_two_gaussians():
    start = random_mixture(1, 3)
    tunable = TunableMixture(start)
    with torch.no_grad():
        tunable.steps.normal_(generator=noise(1))
        tunable.shapes.normal_(generator=noise(2))
    tuned = tunable.mixture()
    own, other = (
        torch.distributions.MultivariateNormal(m.means[0], m.covariances[0]) for m in (tuned, start)
    )
    expected = torch.distributions.kl_divergence(own, other)
    torch.testing.assert_close(tunable.departure().detach(), expected)


def test_covariances_and_weights_stay_positive_after_any_step():
    tunable = TunableMixture(random_mixture(4, 3))
    with torch.no_grad():
        for parameter in tunable.parameters():
            parameter.uniform_(-6, 6, generator=noise(3))
    mixture = tunable.mixture()
    assert (torch.linalg.eigvalsh(mixture.covariances) > 0).all() and (mixture.weights > 0).all()
    torch.testing.assert_close(mixture.weights.sum(), torch.ones(()).double())


# --- the filter over single poses -------------------------------------------------------------


def directional(model, loss, seed=5, step=1e-5):
    """Slope of a loss along a random direction, by its gradient and by finite differences."""
    parameters = [p for p in model.parameters() if p.requires_grad]
    generator = noise(seed)
    ways = [
        torch.randn(p.shape, generator=generator, dtype=p.dtype) / p.numel() ** 0.5
        for p in parameters
    ]
    slopes = torch.autograd.grad(loss(), parameters)
    by_gradient = sum((s * w).sum() for s, w in zip(slopes, ways, strict=True))
    values = []
    for sign in (1, -2):
        with torch.no_grad():
            for parameter, way in zip(parameters, ways, strict=True):
                parameter += sign * step * way
            values.append(float(loss()))
    with torch.no_grad():
        for parameter, way in zip(parameters, ways, strict=True):
            parameter += step * way
    return float(by_gradient), (values[0] - values[1]) / (2 * step)


@pytest.mark.parametrize("transition", ["paper", "ou"])
def test_the_gradient_through_the_filter_is_that_of_finite_differences(
    prior, sequences, transition
):
    start = UpperBodyPrior(
        prior.left, prior.right, replace(prior.info, transition=transition), dict(prior.noise)
    )
    model = TunableKalman(start, mixtures=True, error=0.0, evidence=0.1)
    batch = pieces(sequences, prior, 2, frames=6)
    by_gradient, by_differences = directional(model, lambda: model.loss(batch))
    assert by_gradient == pytest.approx(by_differences, rel=1e-4, abs=1e-7)
    assert (model.gamma is not None) == (transition == "ou")


@pytest.mark.slow
def test_the_loss_of_noise_falls_and_the_tuned_prior_tracks_better(prior, sequences, tmp_path):
    poor = dict(prior.noise) | {"process_cov": released_process_cov() * 1e-3}
    start = UpperBodyPrior(prior.left, prior.right, prior.info, poor)
    model = TunableKalman(start)
    adam = torch.optim.Adam(model.parameters(), lr=0.3)
    batch = pieces(sequences, prior, 6, seed=1, frames=30)
    before = float(model.error(batch))
    for _ in range(12):
        adam.zero_grad()
        model.loss(batch).backward()
        adam.step()
    assert float(model.error(batch)) < 0.98 * before
    tuned = model.prior()
    assert tuned.info.extra["tuned"] == ["poses"] and (tuned.noise["process_cov"] > 0).all()
    tuned.save(tmp_path / "tuned.safetensors")
    loaded = UpperBodyPrior.load(tmp_path / "tuned.safetensors")
    errors = []
    for own in (start, loaded):
        tracker = UpperBodyTracker(own, own.camera, method="mkf-fixed", max_gap=None)
        track = tracker(batch.keypoints.clone(), lengths=batch.lengths)
        errors.append(float(joint_errors_3d(track.joints3d, batch.poses)[batch.inside].mean()))
    assert errors[1] < errors[0]


def test_the_model_errs_as_the_tracker_does(prior, sequences):
    batch = pieces(sequences, prior, 3, frames=20)
    tracker = UpperBodyTracker(prior, prior.camera, method="mkf-fixed", max_gap=None)
    track = tracker(batch.keypoints.clone(), lengths=batch.lengths)
    error = joint_errors_3d(track.joints3d, batch.poses)[batch.inside].mean()
    # the tracker lifts by the unscented transform, which carries covariances along
    torch.testing.assert_close(TunableKalman(prior).error(batch), error, rtol=0.1, atol=0)


def test_pieces_are_drawn_alike_from_one_seed_and_hold_the_recordings(prior, sequences):
    first, again = (pieces(sequences, prior, 5, seed=3, frames=16) for _ in range(2))
    torch.testing.assert_close(first.keypoints, again.keypoints, equal_nan=True)
    assert first.poses.shape == (5, 16, 8, 3) and (first.lengths == 16).all()
    flat = torch.cat(sequences).flatten(1)
    for frame in first.poses.flatten(0, 1).flatten(1)[::7]:
        assert bool((flat - frame).abs().amax(1).min() < 1e-12)


def test_bodies_of_pieces_may_be_of_other_sizes_but_keep_them(sequences, prior):
    recorded = pieces(sequences, prior, 3, seed=3, frames=8)
    batch = pieces(sequences, prior, 3, seed=3, frames=8, body_size=0.3)
    ratio = batch.poses[:, :, [0, 1, 2, 3]].norm(dim=-1) / recorded.poses[:, :, [0, 1, 2, 3]].norm(
        dim=-1
    )
    torch.testing.assert_close(ratio, ratio[:, :1, :1].expand_as(ratio))
    assert float((ratio - 1).abs().max()) <= 0.3 and float(ratio.std()) > 0.01


def test_every_parameter_is_in_one_group_and_mixtures_go_slower(prior):
    model = TunableKalman(prior, mixtures=True)
    noise_group, mixtures = parameter_groups(model, 0.1)
    assert len(noise_group["params"]) == 2 and len(mixtures["params"]) == 6
    assert mixtures["lr"] < noise_group["lr"] == 0.1
    assert len(parameter_groups(TunableKalman(prior), 0.1)) == 1


def test_what_fine_tuning_cannot_do_without(prior):
    with pytest.raises(InputError, match="at least one complete recording"):
        draw_sequences([], prior, 2, noise())
    with pytest.raises(PriorError, match="viewpoints"):
        nowhere = UpperBodyPrior(prior.left, prior.right, replace(prior.info, views={}))
        draw_sequences([torch.zeros(3, 8, 3)], nowhere, 2, noise())
    with pytest.raises(PriorError, match="causal"):
        TunableWindow(UpperBodyPrior(prior.left, prior.right, prior.info), "causal")


# --- windows ----------------------------------------------------------------------------------


def some_of(batch: WindowBatch, n: int) -> WindowBatch:
    """About so many windows, evenly spread."""
    step = len(batch.hands) // n
    states = {side: value[::step] for side, value in batch.states.items()}
    return WindowBatch(states, batch.hands[::step])


def test_the_gradient_of_windows_is_that_of_finite_differences(prior, sources):
    model = TunableWindow(prior, "causal", error=0.0, evidence=0.1)
    batch = some_of(draw_windows(sources, 0), 12)
    # a larger step: evidences of windows cancel to a slope of which 1e-5 leaves four digits
    by_gradient, by_differences = directional(model, lambda: model.loss(batch, noise()), step=1e-4)
    assert by_gradient == pytest.approx(by_differences, rel=3e-4, abs=1e-7)


def test_the_error_over_windows_falls(prior, sources):
    model = TunableWindow(prior, "causal", evidence=0.01)
    adam = torch.optim.Adam(model.parameters(), lr=0.01)
    batch = some_of(draw_windows(sources, 0), 300)
    before, generator = float(model.error(batch, noise())), noise(1)
    for _ in range(25):
        adam.zero_grad()
        model.loss(batch, generator).backward()
        adam.step()
    assert float(model.error(batch, noise())) < 0.97 * before
    window = model.prior().windows["causal"]
    assert window.layout == prior.windows["causal"].layout
    assert (torch.linalg.eigvalsh(window.left.covariances) > 0).all()


def test_windows_know_the_hands_inside_their_recording(sources):
    batch = draw_windows(sources, 0)
    left = sources["left"]
    centres = left.centres[left._poses(0, len(left.centres))]
    lags = [*left.layout.own, *left.layout.other]
    for row in range(0, len(centres), 97):
        frame, first = int(centres[row]), int(left.frames.first[centres[row]])
        assert batch.hands[row].tolist() == [frame - lag >= first for lag in lags]
    other = replace(sources["right"], seed=left.seed + 1)
    with pytest.raises(InputError, match="one seed"):
        draw_windows({"left": left, "right": other}, 0)


def test_the_error_has_a_gradient_where_the_estimate_is_exact():
    pose = torch.randn(2, 8, 3, generator=noise(), dtype=torch.float64)
    estimate = pose.clone().requires_grad_()
    error = pose_error(estimate, pose)
    error.sum().backward()
    assert torch.isfinite(estimate.grad).all() and float(error.max().detach()) < 1e-6
