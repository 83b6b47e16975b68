"""Edges, segments and their votes, on drawn images and against a loop over pairs."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from tests.data import data_dir_or_skip
from tests.measure.drawn_arms import drawing, pose
from torchpose.errors import InputError, ShapeError
from torchpose.measure._edges import (
    ARM_LIMBS,
    Segments,
    edge_map,
    find_segments,
    limb_votes,
    segments_of_arms,
)

cv2 = pytest.importorskip("cv2")


def some_segments(n=40, seed=0):
    rng = np.random.default_rng(seed)
    return Segments(
        torch.from_numpy(rng.uniform(0, 100, (n, 2))),
        torch.from_numpy(rng.uniform(0, math.pi, n)),
        torch.from_numpy(rng.uniform(5, 30, n)),
    )


def distance_to(edges):
    return cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5)


@pytest.mark.parametrize("source", ["drawing", "video"])
def test_kornia_and_opencv_find_the_same_edges(source):
    if source == "drawing":
        image = drawing(pose())
    else:
        video = cv2.VideoCapture(str(data_dir_or_skip("video_asl") / "again.mkv"))
        image = cv2.resize(cv2.cvtColor(video.read()[1], cv2.COLOR_BGR2GRAY), (320, 240))
    ours = edge_map(image, backend="opencv").numpy()
    theirs = edge_map(torch.from_numpy(image).float(), backend="kornia").numpy()
    assert ours.sum() > 200
    assert (distance_to(theirs)[ours] <= 1.5).mean() > 0.95
    assert (distance_to(ours)[theirs] <= 1.5).mean() > 0.95


def test_auto_takes_kornia_where_a_gradient_is_wanted():
    image = torch.from_numpy(drawing(pose())).float()
    plain = edge_map(image)
    assert torch.equal(plain, edge_map(image, backend="opencv"))
    leaf = image.clone().requires_grad_(True)
    assert torch.equal(edge_map(leaf), edge_map(image, backend="kornia"))


@pytest.mark.parametrize("backend", ["opencv", "kornia"])
@pytest.mark.parametrize("degrees", [0, 25, 60, 90, 130, 170])
def test_a_drawn_bar_has_segments_along_it(backend, degrees):
    image, centre = np.full((120, 160), 150, np.uint8), np.array([80, 60])
    step = 40 * np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
    first, second = (tuple(int(c) for c in centre + s * step) for s in (-1, 1))
    cv2.line(image, first, second, 40, 12)
    found = find_segments(image, backend)
    long = found.length > 30
    assert long.any() and (found.length[long] < 100).all()
    turn = (found.angle[long] - math.radians(degrees) + math.pi / 2).remainder(
        math.pi
    ) - math.pi / 2
    assert turn.abs().max() < 0.1
    normal = np.array([-step[1], step[0]]) / 40
    offset = (found.midpoint[long].numpy() - centre) @ normal
    assert (np.abs(np.abs(offset) - 6.5) < 2).all()
    assert ((found.angle >= 0) & (found.angle < math.pi)).all()


def test_an_even_image_has_no_segments():
    found = find_segments(np.full((40, 50), 90, np.uint8))
    assert found.midpoint.shape == (0, 2) and found.angle.shape == (0,)
    votes = limb_votes(found, torch.zeros(3, 2), torch.ones(3, 2), 2.0)
    assert votes.tolist() == [0, 0, 0]


def test_votes_as_published_are_densities_above_a_threshold():
    segments = some_segments()
    rng = np.random.default_rng(1)
    starts, ends = (torch.from_numpy(rng.uniform(0, 100, (5, 4, 2))) for _ in range(2))
    std, angle_std, threshold = 20.0, 0.4, 0.2
    votes = limb_votes(segments, starts, ends, std, angle_std, threshold, along=False)
    cov = np.diag([std**2, std**2, angle_std**2])
    tau = threshold * multivariate_normal(np.zeros(3), cov).pdf(np.zeros(3))
    for index in np.ndindex(5, 4):
        a, b = starts[index].numpy(), ends[index].numpy()
        limb = math.atan2(b[1] - a[1], b[0] - a[0])
        count = 0
        for point, angle in zip(segments.midpoint.numpy(), segments.angle.numpy(), strict=True):
            turn = min((angle - limb + k * math.pi for k in range(-3, 4)), key=abs)
            x = np.array([*(point - (a + b) / 2), turn])
            count += multivariate_normal(np.zeros(3), cov).pdf(x) > tau
        assert votes[index] == count
    assert votes.sum() > 5


def test_votes_along_the_limb_measure_the_distance_to_it():
    segments = some_segments(30)
    start, end = torch.tensor([20.0, 30.0]).double(), torch.tensor([70.0, 60.0]).double()
    votes = limb_votes(segments, start, end, 15.0, 10.0, 0.3)  # any angle
    way = np.linspace(0, 1, 2001)[:, None]
    line = start.numpy() + way * (end - start).numpy()
    distance = [np.hypot(*(line - m).T).min() for m in segments.midpoint.numpy()]
    turn = (segments.angle - math.atan2(30, 50) + math.pi / 2).remainder(math.pi) - math.pi / 2
    squared = (np.array(distance) / 15) ** 2 + (turn.numpy() / 10) ** 2
    assert votes == (squared < -2 * math.log(0.3)).sum()


def test_limbs_that_are_not_known_get_no_votes():
    votes = limb_votes(some_segments(), torch.full((2, 2), math.nan), torch.zeros(2, 2), 50.0, 3.0)
    assert votes.tolist() == [0, 0]


def test_a_turn_of_pi_changes_nothing():
    segments = some_segments()
    starts, ends = torch.rand(2, 6, 2, generator=torch.Generator().manual_seed(0)) * 100
    forth = limb_votes(segments, starts, ends, 20.0)
    back = limb_votes(segments, ends, starts, 20.0)
    assert torch.equal(forth, back)


def test_segments_are_looked_for_about_the_arms_and_come_in_pixels_of_the_frame():
    image = drawing(pose())
    large = cv2.resize(image, None, fx=2, fy=2)
    cv2.rectangle(large, (0, 0), (40, 300), 0, 3)  # far from the arms
    found = segments_of_arms(large, 2 * pose()[None], 80.0)
    joints = 2 * pose()
    votes = sum(limb_votes(found, joints[a], joints[b], 20.0) for a, b in ARM_LIMBS)
    assert votes >= 0.6 * len(found.midpoint) and len(found.midpoint) >= 6
    again = segments_of_arms(large, 2 * pose()[None], 80.0)
    assert all(torch.equal(a, b) for a, b in zip(found, again, strict=True))
    nobody = segments_of_arms(large, torch.full((1, 8, 2), math.nan), 80.0)
    assert len(nobody.midpoint) == 0


def test_bad_input_is_refused():
    segments = some_segments()
    with pytest.raises(InputError, match="backend"):
        edge_map(np.zeros((5, 5), np.uint8), backend="scipy")
    with pytest.raises(InputError, match="grey"):
        edge_map(np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(InputError, match="threshold"):
        limb_votes(segments, torch.zeros(2), torch.ones(2), 1.0, threshold=2.0)
    with pytest.raises(ShapeError, match="ends"):
        limb_votes(segments, torch.zeros(3, 2), torch.ones(2, 2), 1.0)
