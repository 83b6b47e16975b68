"""Places of single parts against whole bodies, their counts against images, and the Gaussians."""

import math
from dataclasses import replace

import pytest
import torch

from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, walk, walker
from torchpose.body import BODY_15, Limbs, centres_of
from torchpose.errors import InputError, SkeletonError
from torchpose.math._unscented import sigma_points
from torchpose.whole_body import render
from torchpose.whole_body._filters.limb_observations import (
    count_positions,
    observation_gaussians,
    part_groups,
    part_log_likelihood,
    part_positions,
)
from torchpose.whole_body._silhouettes.limb_counts import PartCounts
from torchpose.whole_body._silhouettes.rendering import prepare_silhouettes, render_limbs

N_PARTS = len(BODY_15.parts) - 1


def body_in_its_frame():
    plain = walker()
    body = plain.altered(frame="body")
    states = plain.convert(walk(plain, 12), body)
    centred = body.altered(centres=centres_of(body, states))
    return centred, body.convert(states, centred)


def sigma_set(states, std=0.1):
    mean = states[..., 6:].unflatten(-1, (-1, 3))
    covariance = (std**2 * torch.eye(3, dtype=torch.float64)).expand(*mean.shape, 3)
    return mean, covariance, sigma_points(mean, covariance, centre=True)


def test_every_limb_belongs_to_one_part():
    owned = {p: own for g in part_groups(BODY_15) for p, own in zip(g.parts, g.limbs, strict=True)}
    assert sorted(owned) == list(range(N_PARTS))
    assert sorted(limb for own in owned.values() for limb in own) == list(range(17))
    named = {BODY_15.parts[p + 1]: {BODY_15.limbs[i].name for i in own} for p, own in owned.items()}
    assert named["left_shank"] == {"left_shank", "left_foot"}
    assert named["head"] == {"head", "neck"}
    assert named["torso"] == {"spine", "shoulders", "hips", "left_torso", "right_torso"}
    for group in part_groups(BODY_15):
        for part, other in zip(group.parts, group.opposing, strict=bool(group.opposing)):
            left, right = BODY_15.parts[part + 1], BODY_15.parts[group.parts[other] + 1]
            assert left.split("_", 1)[1] == right.split("_", 1)[1] and left != right


def test_a_part_turns_about_its_mean_place():
    body, states = body_in_its_frame()
    states = states[:6].view(2, 3, -1)
    _, _, points = sigma_set(states)
    for group in part_groups(BODY_15):
        limbs = part_positions(body, states, points, group)
        for place, part in enumerate(group.parts):
            for s in range(7):
                turned = states.clone()
                turned[..., 6 + 3 * part : 9 + 3 * part] = points[..., part, s, :]
                whole = body.limbs(turned)  # limbs above are where they were
                own = list(group.limbs[place])
                for mine, theirs in zip(limbs[:2], whole[:2], strict=True):
                    found = mine[..., place, s, :, :]
                    torch.testing.assert_close(found, theirs[..., own, :], rtol=0, atol=1e-12)


def test_counts_are_those_of_images():
    body, states = body_in_its_frame()
    states = states[:2]
    silhouettes = render(body, states[0], rig(), HEIGHT, WIDTH)
    _, _, points = sigma_set(states, 0.2)
    groups = part_groups(body.skeleton)
    counts = count_positions(body, states, points, rig(), prepare_silhouettes(silhouettes), groups)
    assert counts.weight.shape == (2, N_PARTS, 7, 3)
    names = list(BODY_15.parts[1:])
    for group in part_groups(BODY_15):
        limbs = part_positions(body, states, points, group)
        limbs = Limbs(*limbs[:2], limbs.radii.expand(*limbs.start.shape[:-1], 2))
        covered = render_limbs(limbs, rig(), HEIGHT, WIDTH)  # [2, G, 7, C, H, W]
        for place, part in enumerate(group.parts):
            image = silhouettes.double().expand(2, -1, -1, -1).clone()
            side, _, kind = names[part].partition("_")
            other = {"left": "right", "right": "left"}.get(side)
            if other is not None:
                where = group.parts.index(names.index(f"{other}_{kind}"))
                image[covered[:, where].any(1)] = 0.5 * image[covered[:, where].any(1)]
            weight = (covered[:, place] * image[:, None]).sum((-2, -1))
            assert torch.equal(counts.weight[:, part], weight)
            assert torch.equal(counts.area[:, part], covered[:, place].sum((-2, -1)))


def test_likelihoods_combine_cameras_as_said():
    weight = torch.tensor([[10.0, 40.0], [0.0, 50.0], [0.0, 0.0]], dtype=torch.float64)
    area = torch.tensor([[20, 80], [10, 50], [10, 20]])
    counts = PartCounts(weight[None], area[None])
    by_sum = part_log_likelihood(counts, cameras="sum", normalisation="published").exp()
    assert by_sum.tolist() == [[pytest.approx(50), pytest.approx(50), 0.0]]
    shares = part_log_likelihood(counts, cameras="sum", normalisation="share").exp()
    assert shares.tolist() == [[pytest.approx(1.0), pytest.approx(1.0), 0.0]]
    product = part_log_likelihood(counts, normalisation="share").exp()
    assert product.tolist() == [[pytest.approx(0.25), pytest.approx(0.01), 0.0]]
    with pytest.raises(InputError, match="normalisation must be one of"):
        part_log_likelihood(counts, normalisation="area")


def test_shares_do_not_change_with_the_scale_of_the_image():
    body, states = body_in_its_frame()
    states, shares, pixels = states[:1], [], []
    _, _, points = sigma_set(states)
    for factor in (6, 12):
        size = (factor * HEIGHT, factor * WIDTH)
        cameras = rig().scaled(*size)
        silhouettes = prepare_silhouettes(render(body, states[0], cameras, *size))
        counts = count_positions(
            body, states, points, cameras, silhouettes, part_groups(body.skeleton)
        )
        shares.append(part_log_likelihood(counts, normalisation="share"))
        pixels.append(part_log_likelihood(counts, normalisation="published"))
    torch.testing.assert_close(shares[0], shares[1], rtol=0, atol=0.06)
    change = (pixels[1] - pixels[0]).mean()
    assert float(change) == pytest.approx(3 * math.log(4), abs=0.05)  # three cameras


def test_equal_weights_change_nothing_and_unequal_ones_pull():
    _, states = body_in_its_frame()
    mean, covariance, points = sigma_set(states[:2])
    level = torch.full(points.shape[:-1], -3.0, dtype=torch.float64)
    same = observation_gaussians(points, level, mean, covariance)
    torch.testing.assert_close(same[0], mean, rtol=0, atol=1e-12)
    torch.testing.assert_close(same[1], covariance, rtol=0, atol=1e-12)
    pulled = level.clone()
    pulled[..., 3] += math.log(2.0)
    weights = pulled.softmax(-1)[..., None]
    expected = (weights * points).sum(-2)
    found = observation_gaussians(points, pulled, mean, covariance)
    torch.testing.assert_close(found[0], expected, rtol=0, atol=1e-12)


def test_two_points_alone_have_a_floor_and_no_points_no_say():
    _, states = body_in_its_frame()
    mean, covariance, points = sigma_set(states[:1])
    two = torch.full(points.shape[:-1], -math.inf, dtype=torch.float64)
    two[..., 1] = two[..., 2] = 5.0
    two[:, 0] = -math.inf
    found_mean, found = observation_gaussians(points, two, mean, covariance, least_std=0.02)
    values = torch.linalg.eigvalsh(found[:, 1:])
    torch.testing.assert_close(values[..., :2], torch.full_like(values[..., :2], 0.02**2))
    assert bool((values[..., 2] > 0.05**2).all())
    assert torch.equal(found_mean[:, 0], mean[:, 0])
    torch.testing.assert_close(found[:, 0], covariance[:, 0])


def test_a_part_without_limbs_is_refused():
    bare = replace(BODY_15, limbs=tuple(x for x in BODY_15.limbs if "forearm" not in x.name))
    with pytest.raises(SkeletonError, match="left_forearm, right_forearm"):
        part_groups(bare)
