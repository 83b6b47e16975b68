"""The mixture of the face's colours against plain EM."""

import numpy as np
import pytest
import torch

from torchpose.errors import InputError, ShapeError
from torchpose.math import expectation_maximisation
from torchpose.math._mixture_em import MixtureParameters
from torchpose.measure import SkinMixtureModel
from torchpose.measure._skin import rgb_to_lab

FACE = torch.tensor([[80.0, 40.0, 32.0]])
SKIN, DARK = (0.80, 0.60, 0.50), (0.50, 0.34, 0.28)
CLOTH, WALL = (0.15, 0.20, 0.45), (0.75, 0.75, 0.7)


def person(seed=0, skin=SKIN, noise=0.02):
    """A face that is lit from one side, a torso and a hand, RGB [1, 3, 120, 160]."""
    image = torch.empty(3, 120, 160)
    image[:] = torch.tensor(WALL)[:, None, None]
    image[:, 70:, 50:110] = torch.tensor(CLOTH)[:, None, None]
    image[:, 22:60, 66:80] = torch.tensor(DARK)[:, None, None]
    image[:, 22:60, 80:94] = torch.tensor(skin)[:, None, None]
    image[:, 80:96, 20:34] = torch.tensor(skin)[:, None, None]
    generator = torch.Generator().manual_seed(seed)
    return (image + noise * torch.randn(image.shape, generator=generator)).clamp(0, 1)[None]


def test_the_first_fit_is_em_on_the_face():
    model = SkinMixtureModel(n_components=2, steps=4, floor=1.0).double()
    lab = rgb_to_lab(person()).double()
    state, _ = model.step(model.init(1), lab, FACE.double())
    colours, weight = model._sample(lab, FACE.double(), None)
    assert bool((weight == 1).all()) and colours.shape == (1, 256, 3)
    start = model._started(model.init(1), colours, weight)
    parameters, report = expectation_maximisation(
        colours[0],
        MixtureParameters(*(x[0] for x in start[:3])),
        max_iter=8,
        tol=0.0,
        floor=torch.ones(3).double(),
    )
    assert report.reseeded == 0
    for ours, theirs in zip(state[:3], parameters, strict=True):
        torch.testing.assert_close(ours[0], theirs, atol=1e-6, rtol=1e-6)


def test_the_density_is_that_of_the_mixture():
    from scipy.stats import multivariate_normal

    model = SkinMixtureModel().double()
    state, _ = model.step(model.init(1), rgb_to_lab(person()).double(), FACE.double())
    points = np.random.default_rng(0).normal((60, 15, 15), (10, 5, 5), (20, 3))
    wanted = sum(
        float(w) * multivariate_normal(m.numpy(), c.numpy()).pdf(points)
        for w, m, c in zip(state.weights[0], state.means[0], state.covariances[0], strict=True)
    )
    found = model.log_density(state, torch.from_numpy(points)[None]).exp()[0]
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_a_hand_is_skin_and_clothes_and_wall_are_not():
    model, image = SkinMixtureModel(), person()
    _, skin = model.step(model.init(1), rgb_to_lab(image), FACE)
    assert skin[0, 82:94, 22:32].mean() > 0.8
    assert skin[0, 75:, 55:105].mean() < 0.05 and skin[0, :20].mean() < 0.05


def test_colours_are_averaged_and_fitted_in_some_frames_only():
    model = SkinMixtureModel(every=3, decay=0.9)
    first, _ = model.step(model.init(1), rgb_to_lab(person()), FACE)
    tanned = rgb_to_lab(person(1, skin=(0.70, 0.50, 0.35)))
    state = first
    for _ in range(2):
        state, _ = model.step(state, tanned, FACE)
        for old, new in zip(first[:4], state[:4], strict=True):
            assert torch.equal(old, new)
    state, _ = model.step(state, tanned, FACE)
    assert not torch.equal(first.means, state.means) and state.frames.tolist() == [4]
    features = model._sample(tanned, FACE, None)[0]
    average = (state.weights[..., None] * state.means).sum(1)[0]
    before = (first.weights[..., None] * first.means).sum(1)[0]
    torch.testing.assert_close(
        average, 0.9**3 * before + (1 - 0.9**3) * features[0].mean(0), atol=0.05, rtol=0
    )


def test_hands_and_what_is_outside_teach_nothing():
    model = SkinMixtureModel()
    lab = rgb_to_lab(person())
    hands = torch.zeros(1, 120, 160)
    hands[:, :, 80:] = 1.0
    _, weight = model._sample(lab, FACE, hands)
    assert 0.4 < float(weight.mean()) < 0.6
    _, weight = model._sample(lab, FACE - torch.tensor([[80.0, 0, 0]]), None)
    assert 0.4 < float(weight.mean()) < 0.6
    state, _ = model.step(model.init(1), lab, FACE)
    for _ in range(10):
        after, _ = model.step(state, lab, FACE, torch.ones(1, 120, 160))
        assert torch.equal(after.means, state.means)
        state = after


def test_a_batch_is_its_elements_and_newcomers_start_afresh():
    model = SkinMixtureModel()
    images, faces = torch.cat([person(0), person(1).flip(3)]), FACE.repeat(2, 1)
    faces[1, 0] = 159 - faces[1, 0]
    both = model.init(2)
    both = both._replace(frames=torch.tensor([0, 0]))
    both, skin = model.step(both, rgb_to_lab(images), faces)
    for b in range(2):
        own, alone = model.step(model.init(1), rgb_to_lab(images[b : b + 1]), faces[b : b + 1])
        torch.testing.assert_close(skin[b], alone[0], atol=1e-4, rtol=1e-3)
        torch.testing.assert_close(both.means[b], own.means[0], atol=1e-3, rtol=1e-4)


def test_bad_input_is_refused():
    model, lab = SkinMixtureModel(), torch.zeros(1, 3, 20, 20)
    with pytest.raises(InputError, match="decay"):
        SkinMixtureModel(decay=1.0)
    with pytest.raises(InputError, match="n_components"):
        SkinMixtureModel(n_components=0)
    with pytest.raises(InputError, match="batch_size"):
        model.init(0)
    with pytest.raises(InputError, match="positive size"):
        model.step(model.init(1), lab, torch.tensor([[5.0, 5.0, 0.0]]))
    with pytest.raises(ShapeError):
        model.step(model.init(2), lab, FACE)
