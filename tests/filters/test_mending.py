"""What filters report of covariances that were mended, on a mixture where it can be counted by hand."""

import pytest
import torch

from torchpose.filters import BootstrapParticleFilter, MixtureKalmanFilter
from torchpose.priors import GaussianMixture
from torchpose.upper_body._estimator import joined_notes, mending_notes

N_FRAMES = 5
# Of rank one, in powers of two: pixels and radians whose factor breaks down at exactly zero.
THIN = torch.outer(*2 * (torch.tensor([2.0**7, 2.0**-10], dtype=torch.float64),))


def problem(thin, batch=3, **options):
    """A filter without memory whose components `thin` have singular covariances; z and its mask."""
    eye = torch.eye(2, dtype=torch.float64)
    gmm = GaussianMixture(
        torch.full((3,), 1 / 3).double(), torch.zeros(3, 2).double(), eye.expand(3, 2, 2)
    )
    noise = torch.full((2,), 1e-30, dtype=torch.float64)
    options = {"transition": "ou", "gamma": 0.0} | options
    model = MixtureKalmanFilter(gmm, torch.ones(2).double(), noise, [0, 1], **options)
    for k in thin:
        model.covariances[k] = THIN
    mask = torch.rand(batch, N_FRAMES, 2, generator=torch.Generator().manual_seed(1)) < 0.7
    mask[0, 0], mask[0, 1, 1] = True, False
    return model, torch.zeros(batch, N_FRAMES, 2, dtype=torch.float64), mask


def check(out, expected):
    assert torch.equal(out.mended, expected)
    assert torch.equal(out.jitter, (expected > 0).double() * 1e-14)
    assert torch.isfinite(out.mean).all()


@pytest.mark.parametrize("weighting", ["sequence", "frame"])
@pytest.mark.parametrize("thin", [(), (0, 2)])
@pytest.mark.parametrize("own_noise", [False, True])
def test_fixed_tracks_count_what_they_mended(weighting, thin, own_noise):
    model, z, mask = problem(thin, weighting=weighting)
    noise = model.measurement_cov.expand(*z.shape[:2], 2, 2) if own_noise else None
    expected = len(thin) * mask.all(-1).long()
    out = model(z, mask, noise)
    check(out, expected)
    check(model(z, mask, noise), expected)  # gains are known by now
    state = model.init(len(z))
    for t in range(N_FRAMES):
        state, step = model.step(state, z[:, t], mask[:, t], None if noise is None else noise[:, t])
        assert torch.equal(step.mended, expected[:, t]) and torch.equal(
            step.jitter, out.jitter[:, t]
        )


def test_many_sequences_of_one_history_count_the_same_and_nothing_past_their_ends():
    model, z, _ = problem((1,), batch=20)
    lengths = torch.full((20,), N_FRAMES)
    lengths[3] = 2
    expected = (torch.arange(N_FRAMES) < lengths[:, None]).long()
    check(model(z, lengths=lengths), expected)
    check(model(z, lengths=lengths, return_cov=True), expected)


def test_smoothing_counts_the_predicted_covariances_too():
    model, z, mask = problem((0, 2))
    expected = 2 * mask.all(-1).long()
    expected[:, 1:] += 2
    check(model.smooth(z, mask), expected)


@pytest.mark.parametrize("tracks", ["sampled", "split"])
def test_other_tracks_count_what_they_mended(tracks):
    model, z, mask = problem((0, 1, 2), tracks=tracks)
    count = 3 if tracks == "sampled" else 3 * 3 + 3
    out = model(z, mask, generator=torch.Generator().manual_seed(0))
    check(out, count * mask.all(-1).long())


def test_a_lost_element_is_not_counted_as_mended_and_stays_lost():
    model, z, mask = problem((0,))
    model.covariances[1] = -torch.eye(2)
    with pytest.warns(UserWarning, match="degenerated"):
        out = model(z, mask)
    assert torch.isnan(out.mean[0]).all() and int(out.failed_at[0]) == 0
    assert int(out.mended[0, 0]) == 1


def test_particles_that_start_from_the_first_measurement_count_what_they_mended():
    eye = torch.eye(2, dtype=torch.float64)
    gmm = GaussianMixture(
        torch.full((2,), 0.5).double(), torch.zeros(2, 2).double(), eye.expand(2, 2, 2)
    )
    options = {"n_particles": 20, "start": "measured", "dtype": torch.float64}
    out = BootstrapParticleFilter(gmm, eye, 1e-30 * eye, [0, 1], **options)(torch.zeros(1, 2, 2))
    assert out.mended.shape == (1, 2) and int(out.mended[0, 0]) == 2 and int(out.mended[0, 1]) == 0


def test_a_track_notes_what_was_mended_and_nothing_else():
    model, z, mask = problem((0,))
    healthy, mended = problem(())[0](z, mask), model(z, mask)
    assert mending_notes(healthy, healthy) == ()
    (note,) = mending_notes(healthy, mended)
    count = int(mask.all(-1).sum())
    assert note.startswith(f"{count} covariances were not positive definite in rounding")
    assert "at most 1e-14" in note


def test_notes_of_parts_are_those_of_the_whole():
    said = "covariances were not positive definite in rounding and were mended: their variances grew by"
    few, more = f"2 {said} at most 1e-14 of themselves", f"3 {said} at most 2e-09 of themselves"
    assert joined_notes(["a", few, "b", few, "a", more]) == (
        "a", "b", f"7 {said} at most 2e-09 of themselves",
    )  # fmt: skip
