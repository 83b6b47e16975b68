"""The mixture Kalman filter against dense joint Gaussians and enumeration."""

import copyreg
import inspect
import itertools

import numpy as np
import pytest
import torch

from tests.filters.oracles import (
    dense_posterior,
    paper_transition,
    random_covariance,
    random_mixture,
    tensor,
)
from tests.filters.small_problem import DIM, OBSERVED, Problem
from torchpose.errors import CovarianceError, DegenerateFilterWarning, InputError, ShapeError
from torchpose.filters import (
    FixedTrackFilter,
    MixtureKalmanFilter,
    RecursiveFilter,
    SampledTrackFilter,
    SplitTrackFilter,
    StepOutput,
)
from torchpose.filters._transition import make_transition
from torchpose.priors import GaussianMixture
from torchpose.whole_body import SilhouetteParticleFilter

KINDS = {"fixed": FixedTrackFilter, "sampled": SampledTrackFilter, "split": SplitTrackFilter}
DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


def online(model, z, mask, **options):
    """Step by step, as in a live system."""
    state, steps = model.init(len(z), generator=options.get("generator")), []
    for t in range(z.shape[1]):
        state, out = model.step(state, z[:, t], mask[:, t], return_cov=True, **options)
        steps.append(out)
    return [torch.stack(parts, 1) for parts in zip(*steps, strict=True)]


@pytest.mark.parametrize("tracks", ["fixed", "sampled", "split"])
def test_one_component_is_the_kalman_filter_of_the_dense_joint_gaussian(tracks):
    p = Problem(n_components=1, n_frames=5, batch=3)
    out = p.filter(tracks=tracks)(tensor(p.z), torch.tensor(p.mask), return_cov=True)
    model = p.models()[0]
    for b, t in itertools.product(range(3), range(5)):
        args = (p.means[0], p.covs[0], OBSERVED, p.noise)
        mean, cov, evidence = dense_posterior(
            [model] * (t + 1), *args, p.z[b, : t + 1], p.mask[b, : t + 1]
        )
        np.testing.assert_allclose(out.mean[b, t], mean[t], atol=1e-10)
        np.testing.assert_allclose(out.cov[b, t], cov[t], atol=1e-10)
        np.testing.assert_allclose(out.log_evidence[b, : t + 1].sum(), evidence, atol=1e-9)


def test_fixed_tracks_are_the_enumeration_of_constant_trajectories():
    p = Problem(n_frames=5)
    out = p.filter(uniform_weight=0.0)(tensor(p.z), torch.tensor(p.mask))
    log_w = np.log(p.weights)
    for t in range(5):
        means, joint = [], []
        for i, model in enumerate(p.models()):
            args = (p.means[i], p.covs[i], OBSERVED, p.noise)
            mean, _, evidence = dense_posterior(
                [model] * (t + 1), *args, p.z[0, : t + 1], p.mask[0, : t + 1]
            )
            means.append(mean[t])
            joint.append((t + 2) * log_w[i] + evidence)  # weights start at pi, times pi per step
        w = np.exp(joint - np.logaddexp.reduce(joint))
        np.testing.assert_allclose(out.log_weights[0, t].exp(), w, atol=1e-12)
        np.testing.assert_allclose(out.mean[0, t], w @ np.stack(means), atol=1e-10)


def test_split_tracks_that_are_never_pruned_are_the_exact_posterior():
    p = Problem(n_components=2, n_frames=4)
    n_frames = 4
    model = p.filter(tracks="split", n_tracks=2 ** (n_frames + 1))
    out = model(tensor(p.z), torch.tensor(p.mask))
    total = 0.0
    for t in range(n_frames):
        # The indicator before the first frame picks the track's start; after it, one per frame.
        logs, means = [], []
        for path in itertools.product(range(2), repeat=t + 2):
            models = [p.models()[i] for i in path[1:]]
            args = (p.means[path[0]], p.covs[path[0]], OBSERVED, p.noise)
            mean, _, evidence = dense_posterior(models, *args, p.z[0, : t + 1], p.mask[0, : t + 1])
            logs.append(np.log(p.weights[list(path)]).sum() + evidence)
            means.append(mean[t])
        log_evidence = np.logaddexp.reduce(logs)
        w = np.exp(np.array(logs) - log_evidence)
        np.testing.assert_allclose(out.mean[0, t], w @ np.stack(means), atol=1e-9)
        np.testing.assert_allclose(out.log_evidence[0, t], log_evidence - total, atol=1e-9)
        total = log_evidence


def test_sampled_tracks_agree_with_split_tracks_within_monte_carlo_error():
    p = Problem(n_components=2, n_frames=4, missing=0.2)
    z, mask = tensor(p.z), torch.tensor(p.mask)
    exact = p.filter(tracks="split", n_tracks=32)(z, mask)
    model = p.filter(tracks="sampled", n_tracks=400)
    runs = 40
    out = model(
        z.expand(runs, -1, -1),
        mask.expand(runs, -1, -1),
        generator=torch.Generator().manual_seed(0),
    )
    error = out.mean.std(0) / runs**0.5
    bias = out.mean.mean(0) - exact.mean[0]
    assert (bias.abs() < 4.5 * error + 1e-3).all()
    # The product of evidence increments is unbiased for the evidence itself.
    evidence = out.log_evidence.sum(1).exp()
    gap = evidence.mean() - exact.log_evidence.sum().exp()
    assert gap.abs() < 4.5 * evidence.std() / runs**0.5


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("batch", [1, 3, 20, 100])
def test_online_and_offline_give_the_same_numbers(batch, gaps):
    p = Problem(n_frames=260, batch=batch, missing=0.0)
    if gaps:
        p.mask[0, 50:60, 1] = False
        p.mask[-1, 230:240] = False
    model = p.filter()
    z, mask = tensor(p.z), torch.tensor(p.mask)
    offline = model(z, mask, return_cov=True)
    for ours, theirs in zip(offline[:2], online(model, z, mask)[:2], strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    step = online(model, z, mask)
    torch.testing.assert_close(offline.log_evidence, step[2], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(offline.cov, step[3], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("tracks", KINDS)
def test_some_more_frames_are_those_of_steps(tracks):
    p = Problem(n_frames=20, batch=3)
    z, mask, model = tensor(p.z), torch.tensor(p.mask), p.filter(tracks=tracks)
    steps = online(model, z, mask, generator=torch.Generator().manual_seed(0))
    draws, parts = torch.Generator().manual_seed(0), []
    state = model.init(3, generator=draws)
    for rows in (slice(0, 1), slice(1, 12), slice(12, 20)):
        options = {"generator": draws, "return_cov": True}
        state, out = model.advance(state, z[:, rows], mask[:, rows], **options)
        parts.append(out)
    assert state.time == 20
    for ours, expected in zip(zip(*(out[:4] for out in parts), strict=True), steps, strict=False):
        torch.testing.assert_close(torch.cat(ours, 1), expected, rtol=0, atol=0)
    with pytest.raises(ShapeError, match="state"):
        model.advance(state, z[:2], mask[:2])


def test_more_frames_without_memory_are_those_of_the_whole_sequence():
    p = Problem(n_frames=12, batch=2)
    z, mask = tensor(p.z), torch.tensor(p.mask)
    model = p.filter(transition="ou", gamma=0.0, weighting="frame", medians=[1])
    state, first = model.advance(model.init(2), z[:, :5], mask[:, :5])
    state, second = model.advance(state, z[:, 5:], mask[:, 5:])
    assert state.time == 12
    torch.testing.assert_close(torch.cat([first.mean, second.mean], 1), model(z, mask).mean)


def test_many_mask_histories_fall_back_to_the_plain_loop_with_the_same_numbers():
    p = Problem(n_frames=80, batch=20, missing=0.3)
    z, mask = tensor(p.z), torch.tensor(p.mask)
    model = p.filter()
    offline = model(z, mask)
    torch.testing.assert_close(offline.mean, online(model, z, mask)[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("tracks", ["fixed", "split", "sampled"])
def test_a_batch_of_different_lengths_equals_single_calls(tracks):
    rng = np.random.default_rng(1)
    p = Problem(n_frames=90, batch=12, missing=0.02)
    lengths = torch.tensor(rng.integers(1, 91, 12).astype(np.uint16))
    z, mask = tensor(p.z), torch.tensor(p.mask)
    model = p.filter(tracks=tracks)
    generators = [torch.Generator().manual_seed(b) for b in range(12)]
    out = model(z, mask, lengths=lengths, generator=generators)
    for b, n in enumerate(lengths.tolist()):
        alone = model(
            z[b : b + 1, :n], mask[b : b + 1, :n], generator=torch.Generator().manual_seed(b)
        )
        for name in ("mean", "log_weights", "log_evidence"):
            ours, theirs = getattr(out, name)[b, :n], getattr(alone, name)[0]
            torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-10)
        assert (out.log_evidence[b, n:] == 0).all()
        assert (out.mean[b, n:] == out.mean[b, n - 1]).all()


def test_noise_of_each_frame_overrides_the_filters_own():
    p = Problem(n_frames=6, batch=2)
    rng = np.random.default_rng(3)
    noise = np.stack([[random_covariance(rng, 2) for _ in range(6)] for _ in range(2)])
    single = Problem(n_components=1, n_frames=6, batch=2)
    out = single.filter()(tensor(p.z), torch.tensor(p.mask), measurement_cov=tensor(noise))
    for b in range(2):
        args = (single.means[0], single.covs[0], OBSERVED, noise[b])
        mean, _, evidence = dense_posterior(single.models() * 6, *args, p.z[b], p.mask[b])
        np.testing.assert_allclose(out.mean[b, -1], mean[-1], atol=1e-10)
        np.testing.assert_allclose(out.log_evidence[b].sum(), evidence, atol=1e-9)
    constant = noise[0, 0]
    shared = p.filter()(tensor(p.z), torch.tensor(p.mask), measurement_cov=tensor(constant))
    spelled = np.broadcast_to(constant, (2, 6, 2, 2))
    general = p.filter()(tensor(p.z), torch.tensor(p.mask), measurement_cov=tensor(spelled))
    torch.testing.assert_close(shared.mean, general.mean, rtol=1e-10, atol=1e-10)


def test_a_missing_dimension_is_the_same_as_a_filter_without_it():
    p = Problem(n_frames=8)
    p.mask[...] = [True, False]
    p.noise = np.diag(np.diag(p.noise))
    out = p.filter()(tensor(p.z), torch.tensor(p.mask))
    narrow = MixtureKalmanFilter(p.mixture(), tensor(p.process), tensor(p.noise[:1, :1]), [0])
    alone = narrow(tensor(p.z[..., :1]))
    torch.testing.assert_close(out.mean, alone.mean)
    torch.testing.assert_close(out.log_evidence, alone.log_evidence)


def test_evidence_is_zero_where_nothing_is_measured():
    p = Problem(n_frames=8)
    p.mask[:, 3:5] = False
    for tracks in ("fixed", "sampled", "split"):
        out = p.filter(tracks=tracks)(tensor(p.z), torch.tensor(p.mask))
        assert (out.log_evidence[:, 3:5] == 0).all()


def test_epsilon_lets_a_component_come_back():
    weights, means = tensor([0.5, 0.5]), tensor([[-5.0], [5.0]])
    prior = GaussianMixture(weights, means, tensor([[[0.5]], [[0.5]]]))
    z = torch.cat([torch.full((1, 60, 1), -5.0), torch.full((1, 8, 1), 5.0)], 1).double()
    kept = MixtureKalmanFilter(prior, tensor([0.1]), tensor([0.1]), [0], uniform_weight=1e-3)(z)
    lost = MixtureKalmanFilter(prior, tensor([0.1]), tensor([0.1]), [0], uniform_weight=0.0)(z)
    assert kept.log_weights[0, -1].exp()[1] > 0.99
    assert lost.log_weights[0, -1].exp()[1] < 1e-6


def test_transitions_take_one_rate_and_no_variances():
    _, means, covs = map(tensor, random_mixture(np.random.default_rng(2), 3, DIM))
    one, each = (
        make_transition("ou", means, covs, torch.eye(DIM).double(), gamma)
        for gamma in (0.9, torch.full((3,), 0.9).double())
    )
    torch.testing.assert_close(one, each)
    with pytest.raises(ShapeError, match=r"process_cov must have shape \[4, 4\], got \[4\]"):
        make_transition("paper", means, covs, torch.ones(DIM).double())
    with pytest.raises(ShapeError, match=r"gamma must have shape \[3\], got \[4\]"):
        make_transition("ou", means, covs, torch.eye(DIM).double(), torch.full((DIM,), 0.9))
    for options in ({"gamma": 0.9}, {"subspace": 2}):
        with pytest.raises(
            InputError, match=r"does not apply to transition 'paper'; it is of 'ou'"
        ):
            make_transition("paper", means, covs, torch.eye(DIM).double(), **options)


@pytest.mark.parametrize("kind", ["paper", "stationary", "ou", "subspace"])
def test_transitions_settle_where_they_say(kind):
    rng = np.random.default_rng(2)
    _, means, covs = random_mixture(rng, 3, DIM)
    process = np.diag(rng.uniform(0.2, 1.0, DIM))
    options = {"gamma": tensor([0.9, 0.8, 0.95])} if kind in ("ou", "subspace") else {}
    if kind == "subspace":
        options["subspace"] = 2
    name = "ou" if kind == "subspace" else kind
    model = make_transition(name, tensor(means), tensor(covs), tensor(process), **options)
    cov, mean = tensor(covs) * 3, tensor(means) + 1
    for _ in range(500):
        cov = model.matrix @ cov @ model.matrix.mT + model.noise
        mean = (model.matrix @ mean[..., None])[..., 0] + model.offset
    expected = covs
    if kind == "paper":  # Sigma (2 Sigma + Q)^-1 (Sigma + Q)
        expected = np.stack([c @ np.linalg.inv(2 * c + process) @ (c + process) for c in covs])
    np.testing.assert_allclose(cov, expected, atol=1e-9)
    np.testing.assert_allclose(mean, means, atol=1e-9)
    if kind == "paper":
        for i, c in enumerate(covs):
            matrix, offset, noise = paper_transition(means[i], c, process)
            np.testing.assert_allclose(model.matrix[i], matrix, atol=1e-10)
            np.testing.assert_allclose(model.offset[i], offset, atol=1e-10)
            np.testing.assert_allclose(model.noise[i], noise, atol=1e-10)


def test_gradients_reach_noise_gamma_and_prior():
    p = Problem(n_components=2, n_frames=3)
    factor = torch.linalg.cholesky(tensor(p.covs))
    leaves = [
        tensor(p.process.diagonal()).log().requires_grad_(),
        tensor(np.linalg.cholesky(p.noise)).requires_grad_(),
        tensor(p.weights).log().requires_grad_(),
        tensor(p.means).requires_grad_(),
        factor.requires_grad_(),
    ]

    def run(log_q, r, log_pi, means, chol):
        r = torch.tril(r)
        chol = torch.tril(chol)
        prior = GaussianMixture(log_pi.softmax(0), means, chol @ chol.mT)
        model = MixtureKalmanFilter(prior, log_q.exp(), r @ r.mT, OBSERVED)
        out = model(tensor(p.z), torch.tensor(p.mask))
        return out.log_evidence.sum(), out.mean

    assert torch.autograd.gradcheck(run, leaves, atol=1e-5)

    def run_gamma(gamma):
        model = p.filter(transition="ou", gamma=gamma.sigmoid())
        return model(tensor(p.z), torch.tensor(p.mask)).log_evidence.sum()

    assert torch.autograd.gradcheck(run_gamma, [tensor([0.5, 1.0]).requires_grad_()], atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("tracks", ["fixed", "sampled", "split"])
def test_float32_means_stay_close_to_float64(tracks, device):
    p = Problem(n_frames=50)
    z, mask = tensor(p.z).to(device), torch.tensor(p.mask).to(device)
    wide, narrow = (
        p.filter(tracks=tracks, dtype=dtype).to(device)(
            z, mask, generator=torch.Generator(device).manual_seed(0)
        )
        for dtype in (torch.float64, torch.float32)
    )
    assert narrow.mean.dtype == torch.float32
    if tracks != "sampled":  # whose resampling flips on rounding
        torch.testing.assert_close(narrow.mean.double(), wide.mean, rtol=1e-3, atol=1e-3)


def test_burn_in_starts_with_an_inflated_process_covariance():
    p = Problem(n_components=1, n_frames=4, missing=0.0)
    model = p.filter(burn_in=2, burn_in_scale=50.0)
    scaled = [50.0, 50.0**0.5, 1.0, 1.0]
    models = [paper_transition(p.means[0], p.covs[0], p.process * s) for s in scaled]
    args = (p.means[0], p.covs[0], OBSERVED, p.noise)
    mean, _, _ = dense_posterior(models, *args, p.z[0], p.mask[0])
    np.testing.assert_allclose(model(tensor(p.z)).mean[0, -1], mean[-1], atol=1e-9)


def test_a_degenerate_element_is_reported_and_the_others_finish():
    p = Problem(n_frames=10, batch=3, missing=0.0)
    z = tensor(p.z)
    good = p.filter()(z)
    z[1, 4] = 1e200  # its squared innovation is infinite
    with pytest.warns(DegenerateFilterWarning, match="element 1 at frame 4"):
        out = p.filter()(z)
    assert out.failed_at.tolist() == [-1, 4, -1]
    assert torch.isnan(out.mean[1, 4:]).all()
    torch.testing.assert_close(out.mean[[0, 2]], good.mean[[0, 2]])


def test_every_option_changes_what_it_is_said_to_change():
    """Each one that is taken moves the estimate: none is taken and then ignored."""
    p = Problem(n_frames=12)
    values = {
        "n_tracks": 7, "uniform_weight": 0.3, "likelihood_power": 0.2, "reset_below": 100.0,
        "weighting": "frame", "initial_cov": 40 * torch.eye(4), "burn_in": 4, "resample_threshold": 1.0,
        "transition": "stationary",
    }  # fmt: skip

    def estimate(tracks, **options):
        draws = torch.Generator().manual_seed(3)
        return p.filter(tracks=tracks, **options)(
            tensor(p.z), torch.tensor(p.mask), generator=draws
        ).mean

    for tracks in ("fixed", "sampled", "split"):
        plain = estimate(tracks)
        for name, value in values.items():
            if name in inspect.signature(KINDS[tracks]).parameters:
                assert (estimate(tracks, **{name: value}) - plain).abs().max() > 1e-6, (
                    tracks,
                    name,
                )
            else:
                with pytest.raises(InputError, match=name):
                    estimate(tracks, **{name: value})


@pytest.mark.parametrize("tracks", KINDS)
def test_the_class_of_the_tracks_is_what_the_name_of_the_tracks_makes(tracks):
    p = Problem(n_frames=9, batch=2)
    arguments = p.mixture(), tensor(p.process), tensor(p.noise), OBSERVED
    named = MixtureKalmanFilter(*arguments, tracks, burn_in=2)
    made = KINDS[tracks](*arguments, burn_in=2)
    assert type(named) is type(made) is KINDS[tracks]
    assert isinstance(made, MixtureKalmanFilter) and made.tracks == tracks
    options = {"generator": torch.Generator().manual_seed(2)}
    torch.testing.assert_close(
        made(tensor(p.z), **options).mean,
        named(tensor(p.z), generator=torch.Generator().manual_seed(2)).mean,
        rtol=0, atol=0,
    )  # fmt: skip
    others = {"fixed": "n_tracks", "sampled": "uniform_weight", "split": "resample_threshold"}
    with pytest.raises(TypeError, match=others[tracks]):
        KINDS[tracks](*arguments, **{others[tracks]: 0.5})


def test_fixed_tracks_may_be_counted_and_one_class_derives_from_that_of_its_tracks():
    arguments = good_arguments()
    assert MixtureKalmanFilter(**arguments, n_tracks=3).n_tracks == 3
    derived = type("Mine", (FixedTrackFilter,), {})
    assert derived(**arguments)(torch.zeros(1, 2, 2)).mean.shape == (1, 2, DIM)
    with pytest.raises(InputError, match="FixedTrackFilter, SampledTrackFilter, SplitTrackFilter"):
        type("Mine", (MixtureKalmanFilter,), {})(**arguments)


@pytest.mark.parametrize("tracks", KINDS)
def test_filters_pickled_as_the_one_class_that_there_was_become_those_of_their_tracks(tracks):
    p = Problem()
    model = p.filter(tracks=tracks)
    older = copyreg.__newobj__(MixtureKalmanFilter)  # what pickle calls
    older.__setstate__(model.__dict__ | {"tracks": tracks})
    assert type(older) is KINDS[tracks]
    draws = [torch.Generator().manual_seed(4) for _ in range(2)]
    outs = [f(tensor(p.z), generator=g).mean for f, g in zip((older, model), draws, strict=True)]
    torch.testing.assert_close(*outs, rtol=0, atol=0)


def test_a_tracker_written_for_the_former_name_of_its_step_runs_with_a_warning():
    class Former(RecursiveFilter):
        def init(self, batch_size, generator=None):
            return 0

    with pytest.warns(DeprecationWarning, match="filter_frame"):

        class Older(Former):
            def advance(self, state, frame, generator, return_cov):
                mean = frame.z.cumsum(-1)
                return state + 1, StepOutput(mean, mean[:, :1], mean[:, 0])

    model, z = Older(torch.ones(2), [0, 1], 2, torch.float64), torch.ones(3, 4, 2)
    assert (model(z).mean[..., 1] == 2).all()
    assert model.advance(model.init(3), z)[0] == 4 and model.step(0, z[:, 0])[0] == 1


def test_smoothing_refuses_settings_of_the_filter_alone():
    p = Problem()
    with pytest.raises(InputError, match="reset_below"):
        p.filter(reset_below=-50.0).smooth(tensor(p.z))


@pytest.mark.parametrize("base", [RecursiveFilter, SilhouetteParticleFilter])
def test_a_tracker_that_leaves_out_a_step_cannot_be_made(base):
    unfinished = type("Unfinished", (base,), {})
    with pytest.raises(TypeError, match="abstract"):
        unfinished(torch.ones(1), [0], 1, torch.float64)


def good_arguments():
    p = Problem()
    return {
        "gmm": p.mixture(),
        "process_cov": tensor(p.process),
        "measurement_cov": tensor(p.noise),
        "observed": OBSERVED,
    }


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"process_cov": torch.ones(3)}, ShapeError, "process_cov"),
        ({"process_cov": -torch.ones(4)}, CovarianceError, r"positive, got -1 at index \(0,\)"),
        ({"measurement_cov": torch.tensor([[1.0, 0.5], [0.0, 1.0]])}, CovarianceError, "symmetric"),
        ({"measurement_cov": torch.tensor([1.0, float("nan")])}, InputError, "finite"),
        ({"observed": [0, 4]}, InputError, r"\[0, 4\)"),
        ({"observed": [1, 1]}, InputError, "distinct"),
        ({"observed": []}, InputError, "distinct"),
        ({"tracks": "frozen"}, InputError, "fixed, sampled, split"),
        ({"n_tracks": 7}, InputError, "tracks='sampled' or 'split'"),
        ({"uniform_weight": -1.0}, InputError, "at least 0"),
        (
            {"tracks": "split", "n_tracks": 2.5},
            InputError,
            "n_tracks must be a whole number, got 2.5",
        ),
        ({"tracks": "sampled", "resample_threshold": 7}, InputError, "from 0 to 1"),
        ({"tracks": "sampled", "resample_threshold": -1}, InputError, "from 0 to 1"),
        ({"burn_in": -1}, InputError, "burn_in"),
        ({"burn_in": 2.5}, InputError, "burn_in"),
        ({"burn_in": 3, "burn_in_scale": 0.0}, InputError, "positive factor"),
        ({"burn_in": 3, "burn_in_scale": -1.0}, InputError, "positive factor"),
        ({"burn_in_scale": 50.0}, InputError, "burn_in = 0"),
        ({"transition": "ou", "gamma": 0.9, "burn_in": 3}, InputError, "burn_in inflates Q"),
        ({"gamma": 0.9}, InputError, "gamma does not apply to transition 'paper'"),
        ({"subspace": 2}, InputError, "subspace does not apply to transition 'paper'"),
        ({"tracks": "sampled", "likelihood_power": 0.5}, InputError, "tracks='fixed'"),
        ({"tracks": "split", "likelihood_power": 0.5}, InputError, "tracks='fixed'"),
        ({"tracks": "sampled", "reset_below": -9.0}, InputError, "tracks='fixed'"),
        ({"tracks": "split", "reset_below": -9.0}, InputError, "tracks='fixed'"),
        ({"tracks": "split", "uniform_weight": 1e-3}, InputError, "tracks='fixed'"),
        ({"tracks": "split", "resample_threshold": 0.5}, InputError, "tracks='sampled'"),
        ({"resample_threshold": 0.5}, InputError, "tracks='sampled'"),
        ({"medians": [0]}, InputError, "medians"),
        ({"transition": "walk"}, InputError, "paper, stationary, ou"),
        ({"transition": "ou"}, InputError, "needs gamma"),
        ({"transition": "ou", "gamma": 1.0}, InputError, r"\[0, 1\)"),
        ({"initial_cov": torch.zeros(4)}, CovarianceError, r"positive, got 0 at index \(0,\)"),
    ],
)
def test_bad_models_are_refused(change, error, message):
    with pytest.raises(error, match=message):
        MixtureKalmanFilter(**{**good_arguments(), **change})


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        ({"z": torch.zeros(5, 2)}, ShapeError, r"z must have shape"),
        ({"z": torch.zeros(1, 5, 3)}, ShapeError, r"z must have shape"),
        ({"z": torch.zeros(1, 0, 2)}, InputError, "at least one"),
        ({"z": torch.full((1, 5, 2), float("nan"))}, InputError, "mask=False"),
        ({"z": torch.full((1, 5, 2), float("inf"))}, InputError, "finite"),
        ({"mask": torch.ones(1, 5, 2)}, InputError, "bool"),
        ({"mask": torch.ones(1, 4, 2, dtype=torch.bool)}, ShapeError, "mask"),
        ({"lengths": torch.tensor([0])}, InputError, "from 1 to 5"),
        ({"lengths": torch.tensor([6])}, InputError, "from 1 to 5"),
        ({"lengths": torch.tensor([1.5])}, InputError, "integers"),
        ({"lengths": torch.tensor([2j])}, InputError, "integers"),
        ({"measurement_cov": -torch.eye(2)}, CovarianceError, "positive definite"),
        ({"measurement_cov": torch.eye(2).expand(1, 4, 2, 2)}, ShapeError, "measurement_cov"),
        ({"generator": [torch.Generator()] * 2}, InputError, "one for each"),
        ({"generator": 5}, InputError, r"must be a torch\.Generator, or a list of them, got 5"),
    ],
)
def test_bad_calls_are_refused(call, error, message):
    model = MixtureKalmanFilter(**good_arguments())
    with pytest.raises(error, match=message):
        model(**{"z": torch.zeros(1, 5, 2), **call})


def test_values_off_the_mask_may_be_anything():
    p = Problem(n_frames=6)
    z, mask = tensor(p.z), torch.tensor(p.mask)
    model = p.filter()
    expected = model(z, mask).mean
    torch.testing.assert_close(model(torch.where(mask, z, float("nan")), mask).mean, expected)
