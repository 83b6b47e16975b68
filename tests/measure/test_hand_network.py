"""The network that tells hands in a window, and hands that are gone."""

import pytest
import torch

import torchpose
from tests.measure.test_hands import follow, scene
from torchpose.errors import FileFormatError
from torchpose.measure import HandTracker, UpperBodyMeasurer
from torchpose.measure._body_window import (
    CELLS,
    cell_centres,
    cells_to_pixels,
    halve,
    pixels_to_cells,
)
from torchpose.measure._hand_layers import for_inference
from torchpose.measure._hand_likelihood import HandSettings
from torchpose.measure._hand_network import (
    HandNetwork,
    HandNetworkInfo,
    HandPlaces,
    relative_colours,
    shipped_hand_network,
)
from torchpose.measure._hand_prior import HandPrior

FACE = torch.tensor([[0.1, -0.05, 1.02]])
PERSON = [(320.0, 120.0, 76.0)]


def windows(count=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    lab = torch.randint(0, 255, (count, 3, 176, 192), dtype=torch.uint8, generator=generator)
    maps = torch.rand(count, 3, *CELLS, generator=generator)
    return lab, maps, torch.ones(count, 176, 192), FACE.expand(count, -1)


def inputs(count=1):
    """Return what the network itself takes: relative colours, maps of coarse cells, faces."""
    lab, maps, inside, faces = windows(count)
    every = halve(torch.cat([maps, halve(inside)[:, None]], 1))
    return relative_colours(lab, faces), every, faces


BIAS = HandSettings().gone_bias
CLOSE = {"rtol": 1e-5, "atol": 1e-5}


class Says(HandNetwork):
    """Stands for a network after whose bias hands are gone with these log-odds; it says nothing of places.

    Both elbows are at cells (x, y) with these weights, and gone without any.
    """

    def __init__(self, *gone, elbows=()):
        super().__init__()
        self.said = iter(odds - BIAS for odds in gone)
        self.elbow = torch.full(CELLS, 1e-9)
        for (x, y), weight in elbows:
            self.elbow[y - 1 : y + 2, x - 1 : x + 2] = weight
        self.elbow_gone = -9.0 if elbows else 9.0

    def find(self, lab, maps, inside, faces, elbows=True, seen=None):
        count = len(maps)
        return HandPlaces(
            maps.new_zeros(count, 2, *CELLS),
            torch.full((count, 2), next(self.said)),
            (self.elbow / self.elbow.sum()).log().expand(count, 2, -1, -1),
            torch.full((count, 2), self.elbow_gone),
        )


def tracked(network, fps=30.0, frames=12):
    prior = HandPrior.from_prior(torchpose.load_prior("kinect-upper-body"))
    tracker = HandTracker(prior, fps=fps, network=network)
    return tracker, follow(tracker, [scene(t) for t in range(frames)], PERSON)


@torch.inference_mode()
def test_places_and_absence_are_one_distribution():
    network = shipped_hand_network()
    found = network.find(*windows(2))
    assert found.log_prob.shape == (2, 2, *CELLS) and found.gone.shape == (2, 2)
    mass = torch.cat([found.log_prob, found.elbows], 1).exp().sum((2, 3))
    torch.testing.assert_close(mass, torch.ones_like(mass), atol=0.15, rtol=0)  # of resized maps
    share = torch.softmax(network(*inputs(2)), -1)[..., -1]
    both = torch.cat([found.gone, found.elbows_gone], 1)
    torch.testing.assert_close(torch.sigmoid(both), share, atol=1e-5, rtol=1e-5)


@torch.inference_mode()
def test_only_places_tell_that_a_hand_is_there():
    network = shipped_hand_network()
    logits = network(*inputs(3))
    evidence = torch.logsumexp(logits[..., :-1], -1)
    found = network.find(*windows(3))
    constant = torch.cat([found.gone, found.elbows_gone], 1) + evidence
    torch.testing.assert_close(constant, constant[:1].expand(3, -1), atol=1e-4, rtol=0)
    assert float(evidence.std()) > 0.1


@torch.inference_mode()
def test_colours_beyond_the_image_do_not_count():
    network = shipped_hand_network()
    lab, maps, inside, faces = windows()
    inside[:, 120:] = 0
    other = lab.clone()
    other[:, :, 120:] = 90
    one, two = (network.find(colours, maps, inside, faces) for colours in (lab, other))
    torch.testing.assert_close(one.log_prob, two.log_prob, rtol=0, atol=0)
    inside[:, 120:] = 1
    assert not torch.equal(one.log_prob, network.find(lab, maps, inside, faces).log_prob)


@torch.inference_mode()
def test_persons_do_not_depend_on_each_other():
    network = shipped_hand_network()
    both = network.find(*windows(2))
    alone = network.find(*(x[1:] for x in windows(2)))
    torch.testing.assert_close(both.log_prob[1:], alone.log_prob, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(both.gone[1:], alone.gone, atol=1e-4, rtol=1e-4)


def test_colours_are_relative_to_the_face():
    lab = windows()[0].clamp(30, 200)
    brighter = lab + torch.tensor([20, 7, 3], dtype=torch.uint8)[:, None, None]
    plain = relative_colours(lab, FACE)
    torch.testing.assert_close(relative_colours(brighter, FACE), plain, atol=1e-4, rtol=0)
    away = (cell_centres(2) - FACE[0, :2]) / FACE[0, 2]
    face = (away / torch.tensor([0.35, 0.4])).square().sum(-1) < 1
    lab[0, :, face] = torch.tensor([120, 140, 150], dtype=torch.uint8)[:, None]
    inside = relative_colours(lab, FACE)[0, :, face]
    torch.testing.assert_close(inside, torch.zeros_like(inside), atol=1e-4, rtol=0)


@pytest.mark.parametrize("interleaved", [False, True])
def test_colours_are_differences_from_the_mean_of_the_face(interleaved):
    """Of faces in the middle, at the border of the window, and outside."""
    faces = torch.tensor([[0.1, -0.05, 1.02], [-4.7, -3.0, 0.9], [9.0, 0.0, 1.0]])
    lab = windows(3)[0]
    if interleaved:
        lab = lab.contiguous(memory_format=torch.channels_last)
    found = relative_colours(lab, faces)
    for pixels, face, relative in zip(lab.double(), faces, found, strict=True):
        away = ((cell_centres(2) - face[:2]) / face[2] / torch.tensor([0.35, 0.4])).square().sum(-1)
        own = pixels[:, away < 1]
        mean = own.mean(1) if own.numel() else torch.zeros(3).double()
        difference = (pixels - mean[:, None, None]) / torch.tensor([40.0, 12, 12])[:, None, None]
        torch.testing.assert_close(relative.double(), difference.clamp(-4, 4), atol=1e-5, rtol=0)


@torch.no_grad()
def test_a_file_gives_the_same_network(tmp_path):
    info = HandNetworkInfo("own", ("a", "b"), ("anna",), "MIT", "fit")
    network = HandNetwork(info).half().float().eval()  # as a file holds it
    network.save(tmp_path / "own.safetensors")
    again = HandNetwork.load(tmp_path / "own.safetensors")
    assert again.info == info and not again.training
    torch.testing.assert_close(
        again.find(*windows()).log_prob, network.find(*windows()).log_prob, rtol=0, atol=0
    )
    (tmp_path / "own.safetensors").write_bytes(b"nothing")
    with pytest.raises(FileFormatError):
        HandNetwork.load(tmp_path / "own.safetensors")


def test_the_network_that_comes_along_says_what_it_knows():
    info = shipped_hand_network().info
    assert (
        info.name == "hands" and {"P02", "P40", "A"} <= set(info.persons) and "MIT" in info.licence
    )


def test_hands_that_are_gone_are_not_seen_and_come_back():
    _, (state, out) = tracked(Says(*[-3.0] * 5, *[3.0] * 8, *[-3.0] * 8), frames=21)
    seen = [bool(hands.seen.all()) for hands in out]
    assert all(seen[3:5]) and not any(seen[8:13]) and all(seen[16:])
    assert 0 < float(state.beliefs.gone.amax()) < 0.05
    assert torch.equal(out[-1].absent.float(), state.beliefs.gone.float())
    assert float(out[12].absent.amin()) > 0.9


def test_how_long_a_hand_stays_gone_does_not_depend_on_the_frame_rate():
    found = []
    for fps, frames in ((30.0, 8), (15.0, 4)):
        tracker, _ = tracked(None, fps, 1)
        gone = torch.full((1, 2), 0.9)
        for _ in range(frames):
            gone = tracker._gone(gone, torch.full((1, 2), -BIAS))
        found.append(gone)
    torch.testing.assert_close(found[0], found[1])
    assert 0.5 < float(found[0][0, 0]) < 0.9


def test_what_is_unsure_of_being_there_has_a_larger_covariance():
    sure, unsure = (tracked(Says(*[odds] * 6), frames=6)[1][1][-1] for odds in (-4.0, -0.1))
    ratio = unsure.covariance.diagonal(dim1=-2, dim2=-1) / sure.covariance.diagonal(
        dim1=-2, dim2=-1
    )
    assert bool((ratio > 1.2).all())


def test_elbows_are_where_the_network_has_them():
    cell = (60, 45)
    _, (state, out) = tracked(Says(*[-5.0] * 3, elbows=[(cell, 1.0)]), frames=3)
    place = cells_to_pixels(
        torch.tensor([[cell, cell]], dtype=torch.float64), state.windows.anchors
    )
    assert bool(out[-1].elbow_seen.all())
    assert float((out[-1].elbows - place).norm(dim=-1).amax()) < 0.05 * PERSON[0][2]
    _, (_, out) = tracked(Says(*[-5.0] * 3), frames=3)
    assert not bool(out[-1].elbow_seen.any())


def test_of_two_places_the_elbow_is_where_the_hand_lets_it_be():
    """The farther place has half as much weight again, but no arm reaches from there to the hand."""
    _, (state, out) = tracked(Says(*[-5.0] * 6, elbows=[((60, 40), 1.0)]), frames=6)
    hand = pixels_to_cells(out[-1].points, state.windows.anchors)[0, 0]
    near, far = (int(hand[0]), int(hand[1]) - 10), (int(hand[0]), int(hand[1]) - 35)
    network = Says(*[-5.0] * 6, elbows=[(near, 1.0), (far, 1.5)])
    _, (state, out) = tracked(network, frames=6)
    found = pixels_to_cells(out[-1].elbows, state.windows.anchors)[0, 0]
    assert float((found - torch.tensor(near)).norm()) < 3


@torch.inference_mode()
def test_elbows_that_are_not_asked_for_are_not_computed():
    network = shipped_hand_network()
    both, hands = network.find(*windows(2)), network.find(*windows(2), elbows=False)
    assert hands.elbows.shape == (2, 0, *CELLS) and hands.elbows_gone.shape == (2, 0)
    torch.testing.assert_close(hands.log_prob, both.log_prob, rtol=0, atol=0)
    torch.testing.assert_close(hands.gone, both.gone, rtol=0, atol=0)


@pytest.mark.parametrize("elbows", [False, True])
def test_a_measurer_computes_the_elbows_that_it_returns(monkeypatch, elbows):
    asked = []

    def count(network, features):
        asked.append(features)
        return logits_of_elbows(network, features)

    logits_of_elbows = HandNetwork.logits_of_elbows
    monkeypatch.setattr(HandNetwork, "logits_of_elbows", count)
    prior = torchpose.load_prior("kinect-upper-body")
    measurer = UpperBodyMeasurer(prior, elbows=elbows)
    _, out = follow(measurer.hand_tracker, [scene(0), scene(1)], PERSON)
    assert len(asked) == (2 if elbows else 0)
    assert bool(out[-1].elbows.isnan().all()) != elbows


@torch.no_grad()
def test_what_is_kept_for_inference_follows_the_parameters():
    network = shipped_hand_network()
    before = network.find(*windows())
    network.places.weight.mul_(2)
    network.low[0][1].running_var.mul_(0.5)
    torch.testing.assert_close(network(*inputs()), for_inference(network)(*inputs()), **CLOSE)
    assert not torch.equal(before.log_prob, network.find(*windows()).log_prob)
    assert for_inference(network.train()) is network


def test_what_learns_is_not_folded():
    network = shipped_hand_network().requires_grad_(True)
    network.find(*windows()).log_prob.sum().backward()
    assert network.colours[0][0].weight.grad is not None


@pytest.mark.parametrize("change", ["train", "half", "double"])
def test_models_that_hold_a_measurer_leave_its_network_as_it_is(change):
    prior = torchpose.load_prior("kinect-upper-body-small")
    measurer, other = (UpperBodyMeasurer(prior).hand_tracker for _ in range(2))
    frames = [scene(t) for t in range(3)]
    _, expected = follow(other, frames, PERSON)
    getattr(torch.nn.Sequential(measurer), change)()
    for tracker in (measurer, other):
        _, out = follow(tracker, frames, PERSON)
        torch.testing.assert_close(out, expected, rtol=0, atol=0, equal_nan=True)


def test_measurers_share_no_tensors():
    prior = torchpose.load_prior("kinect-upper-body-small")
    measurers = [UpperBodyMeasurer(prior) for _ in range(2)]
    one, other = (
        {x.data_ptr() for x in measurer.state_dict().values() if x.numel()}
        for measurer in measurers
    )
    assert one.isdisjoint(other)


def test_without_a_network_no_hand_is_gone():
    _, (state, out) = tracked(None, frames=2)
    assert not bool(state.beliefs.gone.any())
    assert bool(out[-1].absent.isnan().all())


def test_an_even_network_leaves_places_to_the_other_cues():
    _, (_, plain) = tracked(None, frames=6)
    _, (_, even) = tracked(Says(*[-5.0] * 6), frames=6)
    assert float((plain[-1].points - even[-1].points).norm(dim=-1).amax()) < 0.3 * PERSON[0][2]
