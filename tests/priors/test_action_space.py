"""The action space: against a plain PCA, its gate against sampling, files, and what is refused."""

import copy
import math
import warnings

import pytest
import torch

from tests.data import data_dir_or_skip
from tests.priors.performances import performances
from torchpose.body import BODY_15, Body, body_joints
from torchpose.errors import FileFormatError, InputError, PriorError, ShapeError, SkeletonError
from torchpose.learning import fit_action_space
from torchpose.learning._action_spaces import fit_synchronised
from torchpose.learning._performances import repetition_axis, split_repetitions
from torchpose.priors import ActionSpace
from torchpose.priors._actions.action_file import ActionInfo
from torchpose.priors._actions.gate import match_postures
from torchpose.priors._actions.polar_limbs import LIMBS_12
from torchpose.priors._actions.postures import normalise_postures, posture_angles, state_postures


@pytest.fixture(scope="module")
def space() -> ActionSpace:
    return fit_action_space(performances(30), 6, name="bend", fps=30.0)


def test_the_axes_are_those_of_a_principal_component_analysis(space):
    given = performances(30)
    every = torch.cat(given)
    moves = every - every.mean(0)
    _, sizes, axes = torch.linalg.svd(moves, full_matrices=False)
    along = (space.basis.mT @ axes[:6].mT).abs()
    torch.testing.assert_close(along, torch.eye(6).double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(space.variances, sizes[:6].square() / len(every))
    rest = sizes[6:].square().sum() / len(every)
    torch.testing.assert_close(space.lost_variance, rest)
    assert space.info.explained == pytest.approx(
        float(1 - rest / (sizes.square().sum() / len(every)))
    )
    torch.testing.assert_close(space.project(every), moves @ space.basis)
    # the nearest point of the subspace: what is left stands at right angles to it
    left = every - space.reconstruct(space.project(every))
    torch.testing.assert_close(
        left @ space.basis, torch.zeros(len(every), 6).double(), atol=1e-9, rtol=0
    )


def test_mean_performance_and_deviation_are_those_of_the_synchronised_ones():
    one, found = fit_synchronised(performances(30), 6)
    torch.testing.assert_close(one.performance, found.after.mean(0))
    off = found.after - one.performance
    torch.testing.assert_close(one.match_std, off.square().mean((0, 1)).sqrt())
    std = (off.square().sum(0) / 29).sqrt()
    torch.testing.assert_close(one.std, torch.maximum(std, 0.1 * one.match_std))
    median = sorted(len(p) for p in performances(30))[14]
    assert one.n_postures == median and one.info.key_frames == found.key_frames


def test_with_dimensions_is_the_fit_of_as_many(space):
    small = fit_action_space(performances(30), 3, name="bend", fps=30.0)
    cut = space.with_dimensions(3)
    for name, value in small.state_dict().items():
        torch.testing.assert_close(cut.state_dict()[name], value, msg=name)
    assert cut.info == small.info


def test_matched_postures_are_drawn_from_their_gaussians(space):
    generator = torch.Generator().manual_seed(0)
    z = space.performance[7] + 0.3 * space.match_std
    density = torch.distributions.Normal(space.performance, space.match_std).log_prob(z).sum(-1)
    drawn = torch.bincount(space.match(z.expand(50_000, -1), generator), minlength=space.n_postures)
    share = density.softmax(0)
    error = (drawn / 50_000 - share).abs() / (share * (1 - share) / 50_000).sqrt().clamp_min(1e-5)
    assert float(error.max()) < 4.5
    assert int(space.best_match(z)) == int(density.argmax())
    torch.testing.assert_close(space.log_match(z).softmax(-1), share)


def test_a_draw_by_the_inverse_distribution_function():
    log = torch.tensor([0.1, 0.0, 0.6, 0.3]).log().expand(4, 4) + 7.0
    uniform = torch.tensor([0.0999, 0.1001, 0.6999, 0.7001])
    assert match_postures(log, uniform).tolist() == [0, 2, 2, 3]


def test_the_gate(space):
    j = torch.tensor([0, 5, 11])
    centre, std = space.performance[j], space.std[j]
    assert space.inside(centre, j).all()
    for sign in (-1.0, 1.0):
        edge = centre.clone()
        edge[:, 4] += sign * 1.99 * std[:, 4]
        assert space.inside(edge, j).all()
        edge[:, 4] += sign * 0.02 * std[:, 4]
        assert not space.inside(edge, j).any() and space.inside(edge, j, width=3.0).all()
        assert space.inside(space.clamp(edge, j), j).all()
    far = centre + 50 * torch.randn(3, 6, dtype=torch.float64)
    assert space.inside(space.clamp(far, j), j).all()
    torch.testing.assert_close(space.clamp(centre, j), centre)
    # clamped postures keep what the subspace does not see
    postures = performances(1)[0][:3] + 30 * torch.randn(3, 36, dtype=torch.float64)
    clamped = space.clamp_postures(postures, j, rounds=0)
    assert space.inside(space.project(clamped), j).all()
    step = clamped - postures
    torch.testing.assert_close(step @ space.basis @ space.basis.mT, step, atol=1e-9, rtol=0)


def test_clamped_postures_are_postures_of_a_body():
    body = Body.of_height(BODY_15, 1.75)
    moves = [torch.nn.functional.pad(0.004 * p[:, :30], (6, 0)) for p in performances(12)]
    one = fit_action_space([state_postures(body, states) for states in moves], 6)
    generator = torch.Generator().manual_seed(0)
    shaken = torch.cat(moves[:5])
    shaken = shaken + 0.04 * torch.randn(shaken.shape, generator=generator, dtype=torch.float64)
    postures = state_postures(body, shaken)
    j = one.best_match(one.project(postures))
    before = one.inside(one.project(postures), j)
    clamped = one.clamp_postures(postures, j)
    torch.testing.assert_close(normalise_postures(clamped), clamped, atol=1e-5, rtol=0)
    assert torch.equal(clamped[before], postures[before])
    after = one.inside(one.project(clamped), j)
    assert float(before.double().mean()) < 0.5 < 0.9 < float(after.double().mean())


@pytest.mark.parametrize("d", [1, 13])
def test_perfectly_matched_postures_pass_as_often_as_gaussians_do(d):
    generator = torch.Generator().manual_seed(1)
    eye = torch.eye(36, dtype=torch.float64)[:, :d]
    g = 1e4 * torch.arange(5, dtype=torch.float64)[:, None].expand(5, d)  # no match can go wrong
    one = ActionSpace(
        torch.zeros(36).double(), eye, g, torch.ones(5, d).double(), torch.ones(d).double(),
        torch.ones(d).double(), torch.tensor(1.0).double(),
    )  # fmt: skip
    j = torch.randint(5, (20_000,), generator=generator)
    z = g[j] + torch.randn(20_000, d, generator=generator, dtype=torch.float64)
    found = one.acceptance(one.reconstruct(z), generator=generator)
    assert found.drawn == found.best == found.any
    assert found.drawn == pytest.approx(math.erf(2 / 2**0.5) ** d, abs=0.015)  # 0.55 for d = 13


def test_any_batch_shape_and_dtype(space):
    z = torch.randn(2, 3, 4, 6)
    single = fit_action_space(performances(30), 6).float()
    j = single.match(z, torch.Generator().manual_seed(0))
    assert j.shape == (2, 3, 4) and single.clamp(z, j).dtype == torch.float32
    assert single.inside(z, j).shape == (2, 3, 4)
    assert single.reconstruct(z).shape == (2, 3, 4, 36)


def test_files(space, tmp_path):
    path = tmp_path / "bend.safetensors"
    space.save(path)
    back = ActionSpace.load(path)
    assert back.info == space.info and back.info.name == "bend"
    for name, value in space.state_dict().items():
        assert torch.equal(back.state_dict()[name], value)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FileFormatError, match=r"bend.safetensors"):
        ActionSpace.load(path)
    with pytest.raises(InputError, match="no_such"):
        ActionSpace.load(tmp_path / "no_such.safetensors")


def test_files_of_single_precision_are_read_in_double(space, tmp_path):
    narrow = copy.deepcopy(space).float()
    narrow.save(tmp_path / "space.safetensors")
    back = ActionSpace.load(tmp_path / "space.safetensors")
    assert {value.dtype for value in back.buffers() if value.is_floating_point()} == {torch.float64}
    torch.testing.assert_close(back.std, narrow.std.double(), rtol=0, atol=0)


def test_limbs_of_other_names(space):
    names = [limb.name for limb in LIMBS_12]
    space.check_for(names)
    with pytest.raises(PriorError, match="'bend' is of the limbs torso"):
        space.check_for(names[::-1])
    given = {**dict(space.named_buffers()), "info": ActionInfo(limbs=("wing", *names[1:]))}
    with pytest.raises(SkeletonError, match="wing"):
        ActionSpace(**given)


def test_fewer_dimensions_than_asked_for_are_said():
    flat = [p @ torch.diag(torch.tensor([1.0] * 4 + [0.0] * 32)).double() for p in performances(5)]
    with pytest.warns(UserWarning, match="bend span 4 dimensions, fewer than the 13"):
        found = fit_action_space(flat, 13, name="bend")
    assert found.n_dimensions == 4
    with pytest.warns(UserWarning, match="fewer than the 99"):
        assert fit_action_space(performances(5), 99).n_dimensions == 36


def test_deviations_have_a_floor():
    one = performances(1, noise=0.0)[0]
    nearly = [one, one + 1e-9, one - 1e-9]
    found = fit_action_space(nearly, 2)
    assert float(found.std.min()) >= 0.01 and float(found.match_std.min()) == 0.1


def test_bad_input(space):
    good = performances(4)
    for bad, message in (
        (good[:1], "expected two or more, got 1"),
        ([], "expected two or more, got 0"),
        ([good[0][:3], good[1]], "performance 0 has 3 frames, and key frames need at least 8"),
        ([good[0], good[1] * torch.nan], "performance 1 must be finite"),
        ([good[0], good[0].clone()], "all performances are one and the same"),
        ([0 * good[0] + 3, 0 * good[1] + 3], "all postures of each performance are one and"),
        ([0 * good[0] + 3, 0 * good[1] + 4], "all postures of each performance are one and"),
        ([good[0], good[1].numpy()], "performance 1 must be a tensor, got ndarray"),
        ([good[0][:3], good[1][:3]], "performance 0 has 3 frames"),  # not that D is reduced
    ):
        with pytest.raises(InputError, match=message):
            fit_action_space(bad)
    with pytest.raises(ShapeError, match="performance 1"):
        fit_action_space([good[0], good[1][:, :30]])
    for count in (0, -2):
        with pytest.raises(InputError, match=f"n_dimensions must be at least 1, got {count}"):
            fit_action_space(good, count)
    for fps in (0.0, math.inf):
        with pytest.raises(InputError, match="fps must be positive"):
            fit_action_space(good, fps=fps)
    for count in (0, 7):
        with pytest.raises(InputError, match="from 1 to 6 dimensions"):
            space.with_dimensions(count)
    with pytest.raises(ShapeError, match="36"):
        space.project(torch.zeros(2, 35).double())
    with pytest.raises(InputError, match="width"):
        space.inside(torch.zeros(6).double(), torch.tensor(0), width=0.0)
    with pytest.raises(InputError, match="rounds must be 0 or more"):
        space.clamp_postures(good[0], torch.zeros(len(good[0])).long(), rounds=-1)
    with pytest.raises(InputError, match="at least one posture"):
        space.acceptance(torch.zeros(0, 36).double())
    with pytest.raises(InputError, match="postures must be finite"):
        space.acceptance(torch.full((2, 36), torch.nan).double())
    buffers = dict(space.named_buffers())
    with pytest.raises(InputError, match="std must be positive"):
        ActionSpace(**{**buffers, "std": 0 * buffers["std"]})
    with pytest.raises(InputError, match="a performance of none"):
        none = {name: buffers[name][:0] for name in ("performance", "std")}
        ActionSpace(**{**buffers, **none})
    with pytest.raises(ShapeError, match="match_std"):
        ActionSpace(**{**buffers, "match_std": buffers["match_std"][:2]})


@pytest.mark.data
def test_bends_of_an_unseen_person_pass_the_gate_about_as_often_as_they_should():
    from torchpose.io import read_recordings

    folder = data_dir_or_skip("mocap_berkeley_mhad")
    persons = ("s02", "s03", "s05", "s06", "s09", "s11")
    files = [f for p in persons for f in sorted(folder.glob(f"{p}_a03_bend_r[123].npz"))]
    recordings = read_recordings(files)
    postures = [posture_angles(body_joints(r.joints, r.names)) for r in recordings]
    axis = repetition_axis(postures)
    cut = [[p[s] for s in split_repetitions(p, 30.0, axis)] for p in postures]
    assert [len(parts) for parts in cut] == [5] * len(files)  # each was asked for five
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fit_action_space([p for parts in cut[3:] for p in parts], 13, name="bend", fps=30.0)
    assert len(found.info.key_frames) == 5 and 60 < found.n_postures < 95
    one = found.acceptance(torch.cat([p for parts in cut[3:] for p in parts]))
    other = found.with_dimensions(8).acceptance(torch.cat(cut[0]), width=3.0)
    assert 0.5 < one.drawn < one.best < one.any < 0.95
    assert other.drawn > 0.5
