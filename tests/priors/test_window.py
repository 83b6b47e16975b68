"""Window states: which pixels they hold, how they are measured, and that mirrors and files keep them."""

import pytest
import torch

from tests.learning.test_samplers import FRONT, LAYOUT, MATRIX, sequence
from torchpose.camera._virtual_camera import BodyPath
from torchpose.errors import PriorError
from torchpose.learning._samplers import PoseFrames, WindowSource, all_samples
from torchpose.priors import GaussianMixture
from torchpose.priors._arm_state import mirror_arm_state
from torchpose.priors._window import WindowLayout, WindowPrior, augment_bodies, window_measurements


def states(layout=LAYOUT, n_samples=12, views=FRONT, **bodies):
    """Window states of both arms, the first of every frame in the order of the frames."""
    frames = PoseFrames.join([sequence()], [30.0])
    centres, found = frames.complete(layout), {}
    for side in ("left", "right"):
        source = WindowSource(
            MATRIX, views, "zxy", n_samples, 0, False, frames, centres, layout, side, **bodies
        )
        found[side] = all_samples(source).states
    return {
        side: values[source._poses(0, len(centres)).argsort()] for side, values in found.items()
    }


def pixels(point):
    return point[..., :2] / (point[..., 2:] + 2.0) * 525.0 + torch.tensor([319.5, 239.5])


def test_windows_hold_the_hands_at_their_lags_and_ends_are_held():
    body, found = sequence(), states()
    assert found["left"].shape == (12, LAYOUT.dim) == (12, 27)
    t = torch.arange(12)
    for side, own, other in (("left", 0, 7), ("right", 7, 0)):
        extra = found[side][:, 21:].view(12, 3, 2)
        torch.testing.assert_close(extra[:, 0], pixels(body[(t - 2).clamp_min(0), own]))
        torch.testing.assert_close(extra[:, 1], pixels(body[(t + 1).clamp_max(11), own]))
        torch.testing.assert_close(extra[:, 2], pixels(body[t, other]))
        torch.testing.assert_close(found[side][:, :2], pixels(body[t, own]))


def still_path(layout=LAYOUT, n=12):
    """A body that stays where it is."""
    neck = pixels(torch.zeros(3)).expand(1, n, len(layout.lags), 2).double()
    return BodyPath(layout.lags, neck, torch.tensor([0.0, -50.0]).double().expand_as(neck))


def test_measurements_of_a_projected_sequence_are_the_window_states():
    uv = pixels(sequence())[None]
    mask = torch.ones(1, 12, 8, dtype=torch.bool)
    for side in ("left", "right"):
        values, known = window_measurements(uv, mask, LAYOUT, [side], still_path())
        inner = slice(2, 11)
        torch.testing.assert_close(values[0, inner].flatten(1), states()[side][inner, 21:])
        assert known[0, inner].all()
        assert not known[0, :2, 0].any() and not known[0, 11, 1].any()
        late, seen = window_measurements(
            uv,
            mask,
            LAYOUT,
            [side],
            BodyPath(*(LAYOUT.lags, *(x[:, 5:] for x in still_path()[1:]))),
            5,
        )
        torch.testing.assert_close(late, values[:, 5:])
        assert torch.equal(seen, known[:, 5:])


def test_a_walking_body_has_the_same_window_as_one_that_stands():
    uv = pixels(sequence())[None]
    mask = torch.ones(1, 12, 8, dtype=torch.bool)
    walk = torch.linspace(0, 90, 12, dtype=torch.float64)[None, :, None] * torch.tensor([1.0, 0])
    still, _ = window_measurements(uv, mask, LAYOUT, ["left"], still_path())
    places = torch.stack([walk.roll(lag, 1) for lag in LAYOUT.lags], 2)
    path = still_path()._replace(neck=still_path().neck + places)
    moving, known = window_measurements(uv + walk[:, :, None], mask, LAYOUT, ["left"], path)
    expected = still + walk[:, :, None]
    torch.testing.assert_close(moving[known], expected[known])


def test_hidden_hands_are_missing_in_every_window_that_holds_them():
    uv = pixels(sequence())[None]
    mask = torch.ones(1, 12, 8, dtype=torch.bool)
    mask[0, 5, 0] = False
    _, known = window_measurements(uv, mask, LAYOUT, ["left"], still_path())
    assert not known[0, 7, 0] and not known[0, 4, 1] and known[0, 5, 2]
    _, known = window_measurements(uv, mask, LAYOUT, ["right"], still_path())
    assert not known[0, 5, 2]


def test_lags_follow_the_frame_rate():
    assert LAYOUT.at_rate(60.0).own == (4, -2)
    assert LAYOUT.ahead == 1 and WindowLayout((4,), (0,)).ahead == 0


@pytest.mark.parametrize(
    ("fps", "repeated"),
    [(30.0, ()), (10.0, ()), (3.0, (0,)), (2.0, (0, 2)), (1.0, (0, 1, 4))],
)
def test_lags_of_one_frame_are_measured_once(fps, repeated):
    """Own hands of the present frame are measured as the arm's own, and of others the nearest is taken."""
    layout = WindowLayout((4, 10, 20), (0, 10)).at_rate(fps)
    assert layout.repeated == repeated
    uv, mask = pixels(sequence(24))[None], torch.ones(1, 24, 8, dtype=torch.bool)
    _, known = window_measurements(uv, mask, layout, ["left"], still_path(layout, 24))
    assert known[0, -1].tolist() == [i not in repeated for i in range(5)]


def test_of_lags_of_one_frame_the_nearest_is_measured():
    assert WindowLayout((4, 8, 16, -4, -8, -16), (0, 8, -8)).at_rate(4.0).repeated == (0, 3)


def test_augmented_bodies_keep_their_angles_and_their_symmetry():
    body = sequence()[:, None]
    other = augment_bodies(body, torch.Generator().manual_seed(0), size=0.2, bones=0.1)
    for parent, child in ((2, 1), (1, 0), (4, 3)):
        before = body[:, 0, child] - body[:, 0, parent]
        after = other[:, 0, child] - other[:, 0, parent]
        torch.testing.assert_close(torch.cosine_similarity(before, after), torch.ones(12).double())
        assert ((after.norm(dim=1) / before.norm(dim=1) - 1).abs() < 0.33).all()
    left = (other[:, 0, 1] - other[:, 0, 2]).norm(dim=1) / (body[:, 0, 1] - body[:, 0, 2]).norm(
        dim=1
    )
    right = (other[:, 0, 6] - other[:, 0, 5]).norm(dim=1) / (body[:, 0, 6] - body[:, 0, 5]).norm(
        dim=1
    )
    torch.testing.assert_close(left, right)
    same = augment_bodies(body, torch.Generator().manual_seed(0), size=0.0, bones=0.0)
    torch.testing.assert_close(same, body)


def test_mirrored_windows_are_windows_of_the_mirrored_person():
    plain, mirrored = states(), states(mirror_share=1.0)
    flip = torch.tensor([-1.0, 1.0]).repeat(3)
    shift = torch.tensor([639.0, 0.0]).repeat(3)
    expected = torch.cat(
        [mirror_arm_state(plain["left"][:, :21], 319.5), plain["left"][:, 21:] * flip + shift], 1
    )
    torch.testing.assert_close(mirrored["right"], expected)


def prior():
    g = torch.Generator().manual_seed(0)
    arms = []
    for _ in range(2):
        factor = torch.randn(2, 27, 27, generator=g, dtype=torch.float64)
        cov = factor @ factor.mT + torch.eye(27)
        means = 100 * torch.randn(2, 27, generator=g, dtype=torch.float64)
        arms.append(GaussianMixture(torch.tensor([0.3, 0.7], dtype=torch.float64), means, cov))
    return WindowPrior(*arms, LAYOUT, {"hand_std": 3.0})


def test_mirroring_a_prior_twice_gives_it_back():
    first = prior()
    twice = first.mirrored(319.5).mirrored(319.5)
    torch.testing.assert_close(twice.left.means, first.left.means)
    torch.testing.assert_close(twice.right.covariances, first.right.covariances)
    x = torch.randn(5, 27, dtype=torch.float64) * 50
    flip, shift = torch.tensor([-1.0, 1.0]).repeat(3), torch.tensor([639.0, 0.0]).repeat(3)
    mirrored = torch.cat([mirror_arm_state(x[:, :21], 319.5), x[:, 21:] * flip + shift], 1)
    torch.testing.assert_close(
        first.mirrored(319.5).right.log_prob(mirrored), first.left.log_prob(x)
    )


def test_bad_windows_are_refused():
    good = prior()
    with pytest.raises(PriorError, match="27 dimensions"):
        WindowPrior(good.left.marginal(range(21)), good.right, LAYOUT, {})
