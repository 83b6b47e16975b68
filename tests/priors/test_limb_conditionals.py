"""Limb conditionals against SciPy's rotations and synthetic walks, and knees of recorded walkers."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.data import data_dir_or_skip
from torchpose.body import BODY_15, Body, centres_of, fit_body, fit_state
from torchpose.errors import (
    CovarianceError,
    FileFormatError,
    InputError,
    PriorError,
    ShapeError,
    SkeletonError,
)
from torchpose.learning import fit_limb_conditionals
from torchpose.math import compose, gaussian_rotate, rotate_gaussian
from torchpose.math._rotation_gaussians import turn_gaussian
from torchpose.math._rotations import within_unit_ball
from torchpose.math._tree_messages import propagate
from torchpose.priors._limb_conditionals import PART_TREE, LimbConditionals, in_body_frame

N_PARTS = len(BODY_15.parts)


def normal(g, *sizes):
    return torch.randn(*sizes, generator=g, dtype=torch.float64)


def random_states(g, body, n_frames, std=0.1):
    states = 0.1 * normal(g, body.dim) + std * normal(g, n_frames, body.dim)
    states[:, 3:] = within_unit_ball(states[:, 3:].unflatten(-1, (-1, 3))).flatten(-2)
    return states


@pytest.fixture(scope="module")
def body():
    g = torch.Generator().manual_seed(1)
    centres = 0.3 * normal(g, N_PARTS, 3)
    centres[0] = 0
    return Body.of_height(BODY_15, 1.7, frame="body").altered(centres=centres)


@pytest.fixture(scope="module")
def sequences(body):
    g = torch.Generator().manual_seed(2)
    return [random_states(g, body, n) for n in (40, 1, 25)]


@pytest.fixture(scope="module")
def conditionals(body, sequences):
    return fit_limb_conditionals(body, sequences, 50.0, name="noise", persons=("a", "b"))


def scipy_turns(body, states, part):
    """Rotation of a part in the root's axes."""
    rotations = body.part_rotations(states)
    turn = rotations[:, 0].mT @ rotations[:, part]
    return Rotation.from_matrix(turn.numpy())


def vectors(rotations):
    quaternion = rotations.as_quat()
    return quaternion[:, :3] * np.where(quaternion[:, 3:] < 0, -1, 1)


def test_the_tree_is_the_papers():
    assert len(PART_TREE) == N_PARTS - 2  # every part hangs on one, but the torso and the root
    assert {below for _, below in PART_TREE} == set(BODY_15.parts) - {"pelvis", "torso"}


def test_conditionals_are_the_moments_of_the_relative_rotations(body, sequences, conditionals):
    states = torch.cat(sequences)
    for edge, (above, below) in enumerate(conditionals.edges.tolist()):
        assert (BODY_15.parts[above], BODY_15.parts[below]) == PART_TREE[edge]
        between = scipy_turns(body, states, above).inv() * scipy_turns(body, states, below)
        centre = conditionals.edge_centres[edge].numpy()
        w = np.sqrt(1 - (centre**2).sum())
        x = vectors(Rotation.from_quat([*centre, w]).inv() * between)
        np.testing.assert_allclose(conditionals.mean[edge], x.mean(0), atol=1e-9)
        np.testing.assert_allclose(conditionals.covariance[edge], np.cov(x.T, bias=True), atol=1e-9)


def test_states_of_single_precision_are_fitted_in_that_of_the_body(body, sequences, conditionals):
    single = fit_limb_conditionals(body, [states.float() for states in sequences], 50.0)
    torch.testing.assert_close(single.covariance, conditionals.covariance, rtol=1e-4, atol=1e-6)


def test_diffusion_is_of_steps_within_sequences(body, sequences, conditionals):
    for part in range(N_PARTS):
        steps = []
        for states in sequences:
            turns = (
                scipy_turns(body, states, part)
                if part
                else Rotation.from_matrix(body.part_rotations(states)[:, 0].numpy())
            )
            if len(states) > 1:
                steps.append(vectors(turns[:-1].inv() * turns[1:]))
        steps = np.concatenate(steps)
        expected = steps.T @ steps / len(steps)
        np.testing.assert_allclose(conditionals.diffusion[part], expected, atol=1e-9)


def test_transport_is_f_in_both_directions(conditionals):
    g = torch.Generator().manual_seed(3)
    a = 0.1 * normal(g, 2, 3, 3, 3)
    mean, cov, edges = 0.1 * normal(g, 2, 3, 3), a @ a.mT, torch.tensor([6, 0, 4])
    i, j = conditionals.edges[edges].unbind(-1)
    above, below = conditionals.centres[i], conditionals.centres[j]
    centre, own = conditionals.edge_centres[edges], conditionals.mean[edges]
    spread, turn = conditionals.covariance[edges], compose(centre, own)

    predicted, first = rotate_gaussian(
        compose(above, mean), own, spread, centre=centre, new_centre=below
    )
    _, second = gaussian_rotate(mean, cov, turn, centre=above, new_centre=below)
    ours = conditionals.transport(mean, cov, edges, False)
    torch.testing.assert_close(ours, (predicted, first + second))

    left = compose(-above, compose(below, mean))
    predicted, first = turn_gaussian(-own, spread, left=left, right=-centre)
    _, second = gaussian_rotate(mean, cov, -turn, centre=below, new_centre=above)
    ours = conditionals.transport(mean, cov, edges, True)
    torch.testing.assert_close(ours, (predicted, first + second))


def test_diffuse_inflates_about_the_same_mean(conditionals):
    """q R(d) near q: the step turned into the space of the part, to first order J Sigma' J^T."""
    g = torch.Generator().manual_seed(4)
    mean = 0.3 * normal(g, 2, N_PARTS - 1, 3)
    cov = torch.eye(3).double() * 0.01
    still, inflated = conditionals.diffuse(mean, cov.expand(2, N_PARTS - 1, 3, 3))
    assert torch.equal(still, mean)
    draws = np.random.default_rng(0).multivariate_normal(
        np.zeros(3), conditionals.diffusion[4].numpy(), 100_000
    )
    moved = compose(mean[1, 3], within_unit_ball(torch.as_tensor(draws)))
    expected = torch.cov(moved.mT)
    torch.testing.assert_close(inflated[1, 3] - cov, expected, atol=1e-3, rtol=0)


def walks(growth, n_frames=4000):
    """One state per frame; parts wander (1) or swing on (2)."""
    body = Body.of_height(BODY_15, 1.7, frame="body")
    g = torch.Generator().manual_seed(5)
    if growth == 1:
        offsets = (0.002 * normal(g, n_frames, body.dim)).cumsum(0)
    else:
        t = torch.arange(n_frames).double()[:, None]
        offsets = 0.1 * (0.05 * t + torch.arange(body.dim)).sin()
    return body, offsets


@pytest.mark.parametrize("growth", [1, 2])
def test_the_growth_of_diffusion_is_learnt_and_rescales_it(growth):
    body, states = walks(growth)
    learnt = fit_limb_conditionals(body, states, 60.0)
    np.testing.assert_allclose(learnt.growth, growth, atol=0.1)
    slow = fit_limb_conditionals(body, states[::4], 15.0)
    size = torch.func.vmap(torch.trace)
    ratio = size(learnt.at_rate(15.0).diffusion) / size(slow.diffusion)
    np.testing.assert_allclose(ratio, 1, atol=0.2)


def test_another_rate_is_said(conditionals):
    other = conditionals.at_rate(25.0, growth=1.0)
    torch.testing.assert_close(other.diffusion, 2 * conditionals.diffusion)
    assert (other.info.fps, other.info.fitted_fps) == (25.0, 50.0)
    assert "25 frames per second, rescaled from 50" in repr(other)
    back = other.at_rate(50.0, growth=1.0)
    torch.testing.assert_close(back.diffusion, conditionals.diffusion)
    assert "rescaled" not in repr(back)


def test_several_persons_in_one_frame():
    g = torch.Generator().manual_seed(6)
    people = [Body.of_height(BODY_15, height) for height in (1.5, 1.9)]
    states = [random_states(g, person, 12) for person in people]
    body, joined = in_body_frame([(p, [s[:5], s[5:]]) for p, s in zip(people, states, strict=True)])
    assert body.frame == "body" and [len(s) for s in joined] == [5, 7, 5, 7]
    own = people[1].altered(frame="body", centres=body.centres)
    torch.testing.assert_close(
        own.joints(torch.cat(joined[2:])), people[1].joints(states[1]), atol=1e-9, rtol=0
    )
    torch.testing.assert_close(centres_of(body, torch.cat(joined)), body.centres, atol=1e-9, rtol=0)
    fit_limb_conditionals(body, joined, 60.0).check_for(own)


def test_a_file_and_a_state_dict_bring_it_back(conditionals, tmp_path):
    path = tmp_path / "limbs.safetensors"
    conditionals.save(path)
    loaded = LimbConditionals.load(path)
    assert loaded.info == conditionals.info
    other = conditionals.at_rate(5.0)
    other.mean.zero_()
    other.load_state_dict(conditionals.state_dict())
    g = torch.Generator().manual_seed(7)
    mean, cov = 0.1 * normal(g, 10, 3), 0.01 * torch.eye(3).double().expand(10, 3, 3)
    expected = propagate(mean, cov, conditionals.tree, conditionals.transport)
    for again in (loaded, other):
        torch.testing.assert_close(propagate(mean, cov, again.tree, again.transport), expected)
    single = conditionals.at_rate(50.0).float()
    ours = propagate(mean.float(), cov.float(), single.tree, single.transport)
    torch.testing.assert_close(ours[0].double(), expected[0], atol=1e-3, rtol=0)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(FileFormatError, match="limb-conditionals"):
        LimbConditionals.load(path)


def test_a_file_keeps_the_directions_of_sigma_points(conditionals, tmp_path):
    path, tensors = tmp_path / "limbs.safetensors", conditionals._tensors()
    cholesky = LimbConditionals(conditionals.info, **tensors, directions="cholesky")
    cholesky.save(path)
    loaded = LimbConditionals.load(path)
    assert loaded.directions == "cholesky" and loaded.info == conditionals.info
    conditionals.save(path)
    assert LimbConditionals.load(path).directions == "eigen"
    with pytest.raises(InputError, match="directions must be one of eigen, cholesky"):
        LimbConditionals(conditionals.info, **tensors, directions="other")
    extra = {"sigma_point_directions": ["eigen"]}
    other = LimbConditionals(replace(conditionals.info, extra=extra), **tensors)
    other.save(path)
    with pytest.raises(FileFormatError, match="sigma_point_directions must be one of"):
        LimbConditionals.load(path)


def test_knees_of_recorded_walkers_bend_about_the_knee():
    """Across the thigh, from left to right: x of the part's axes; 80 % of the variance or more."""
    folder = data_dir_or_skip("mocap_cmu_walk")
    from torchpose.io._mocap import read_mocap

    persons = []
    for trials in (("s07_07_01", "s07_07_02"), ("s08_08_01", "s08_08_02")):
        clips = read_mocap([folder / f"{trial}_walk.npz" for trial in trials])
        person = fit_body(torch.cat([clip.joints for clip in clips]))
        persons.append((person, [fit_state(person, clip.joints) for clip in clips]))
    body, sequences = in_body_frame(persons)
    limbs = fit_limb_conditionals(body, sequences, 60.0)
    assert bool((limbs.growth[1:] > 1.3).all())  # limbs swing on
    for side in ("left", "right"):
        edge = PART_TREE.index((f"{side}_thigh", f"{side}_shank"))
        shank = body.skeleton.part(f"{side}_shank")
        # the shank predicted from a thigh at rest and from one raised by 60 degrees
        raised = torch.tensor([-math.sin(math.pi / 6), 0, 0]).double()
        for rotation in (torch.zeros(3).double(), raised):
            mean, cov = rotate_gaussian(
                rotation, limbs.mean[edge], limbs.covariance[edge],
                centre=limbs.edge_centres[edge], new_centre=body.centres[shank],
            )  # fmt: skip
            values, axes = torch.linalg.eigh(cov)
            assert float(values[-1] / values.sum()) > 0.8
            # the ends of the longest axis, as rotations of the shank: they differ about its x
            ends = mean + values[-1].sqrt() * axes[:, -1] * torch.tensor([[1.0], [-1.0]]).double()
            turn = compose(-ends[1], ends[0])
            assert abs(float(turn[0] / turn.norm())) > math.cos(math.radians(10))


def test_bad_input(body, sequences, conditionals):
    fit = fit_limb_conditionals
    with pytest.raises(PriorError, match="frame='body', got a body with 'parent'"):
        fit(body.altered(frame="parent"), sequences, 60.0)
    with pytest.raises(PriorError, match="root part 'pelvis' conditions all"):
        fit(body, sequences, 60.0, edges=[("pelvis", "torso")])
    with pytest.raises(SkeletonError, match="no part 'tail'"):
        fit(body, sequences, 60.0, edges=[("torso", "tail")])
    with pytest.raises(SkeletonError, match="cycle"):
        fit(body, sequences, 60.0, edges=[("torso", "head"), ("head", "torso")])
    with pytest.raises(InputError, match="two frames in a row"):
        fit(body, [states[:1] for states in sequences], 60.0)
    with pytest.raises(InputError, match="two frames in a row"):
        fit(body, [], 60.0)
    buffers = {name: value.clone() for name, value in conditionals.named_buffers()}
    for name, value, said in (
        ("covariance", -buffers["covariance"], "covariance must be positive definite"),
        ("diffusion", -buffers["diffusion"], "diffusion must be positive definite"),
        ("covariance", buffers["covariance"] + torch.ones(3, 3).triu(1), "must be symmetric"),
    ):
        with pytest.raises(CovarianceError, match=said):
            LimbConditionals(conditionals.info, **{**buffers, name: value})
    flat = {**buffers, "diffusion": buffers["diffusion"] * torch.tensor([1.0, 1.0, 0.0]).diag()}
    LimbConditionals(conditionals.info, **flat)
    with pytest.raises(InputError, match="limbs that move"):
        fit(body, [states[:1].expand(9, -1) for states in sequences], 60.0)
    with pytest.raises(InputError, match="least_std must be zero or more"):
        fit(body, sequences, 60.0, least_std=-0.01)
    with pytest.raises(InputError, match="states must be a tensor, got ndarray"):
        fit(body, [sequences[0].numpy()], 60.0)
    with pytest.raises(ShapeError, match=r"states must have shape \[T, 36\], got \[36\]"):
        in_body_frame([(body, sequences[0])])
    with pytest.raises(InputError, match="fps must be positive"):
        fit(body, sequences, 0.0)
    with pytest.raises(ShapeError, match="states must have shape"):
        fit(body, sequences[0][:, :-3], 60.0)
    with pytest.raises(InputError, match="end the sequence where"):
        fit(body, sequences[0] * math.nan, 60.0)
    with pytest.raises(InputError, match="fps must be positive"):
        conditionals.at_rate(-1.0)
    with pytest.raises(PriorError, match="centred elsewhere"):
        conditionals.check_for(body.altered(centres=0 * body.centres))
    with pytest.raises(PriorError, match="frame='body'"):
        conditionals.check_for(body.altered(frame="parent"))
    with pytest.raises(InputError, match="at least one person"):
        in_body_frame([])
