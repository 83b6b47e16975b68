"""The training of the network of hands: what is changed goes with its labels."""

import pytest
import torch

pytest.importorskip("cv2")
from benchmarks.hand_network.clips import FOLDS, PEOPLE, SIGNERS, Windows
from benchmarks.hand_network.training import _changed, _loss, _mirrored, fit
from torchpose.measure._body_window import CELLS
from torchpose.measure._hand_network import HandPlaces


def windows(count=6, seed=0):
    """Windows with a bright spot at each hand: left in the first map, right in the second."""
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(count, 2, 2, generator=generator) * torch.tensor([50.0, 40.0]) + 20
    rows, columns = torch.arange(CELLS[0])[:, None], torch.arange(CELLS[1])
    spots = [
        (
            -0.5 * (((columns - at[:, :1, None]) / 2) ** 2 + ((rows - at[:, 1:, None]) / 2) ** 2)
        ).exp()
        for at in places.unbind(1)
    ]
    maps = torch.stack([*spots, torch.zeros(count, *CELLS), torch.ones(count, *CELLS)], 1)
    lab = torch.zeros(count, 3, 160, 192)
    faces = torch.tensor([[0.0, 0.0, 1.0]]).expand(count, -1)
    return Windows(lab, maps, faces, places, torch.ones(count, 2, dtype=torch.long))


def brightest(maps):
    flat = maps.flatten(2).argmax(-1)
    return torch.stack([flat % CELLS[1], flat // CELLS[1]], -1)


def test_labels_move_with_their_windows():
    torch.manual_seed(0)
    moved = _changed(windows(12))
    spots = brightest(moved.maps[:, :2])
    as_they_are = (spots - moved.places).norm(dim=-1).amax(1) < 3.0
    exchanged = (spots.flip(1) - moved.places).norm(dim=-1).amax(1) < 3.0
    assert (
        bool((as_they_are | exchanged).all()) and bool(as_they_are.any()) and bool(exchanged.any())
    )
    assert float((moved.faces[:, 2] - 1).abs().amax()) > 0.05


def test_mirrored_twice_is_as_it_was():
    every = torch.ones(6, dtype=torch.bool)
    for once, twice in zip(windows(), _mirrored(_mirrored(windows(), every), every), strict=True):
        torch.testing.assert_close(once, twice)


def test_the_loss_is_least_at_the_label():
    batch = windows(1)
    at = (batch.places / 2).long()[0]

    def loss(column, row):
        logits = torch.zeros(1, 2, 40 * 48 + 1)
        logits[0, :, row * 48 + column] = 5.0
        return float(_loss(logits, batch))

    right = batch._replace(seen=torch.tensor([[1, -1]]))
    batch = right
    assert loss(*at[0].tolist()) < loss(*(at[0] + 6).tolist())
    batch = batch._replace(seen=torch.tensor([[0, 0]]))
    gone = torch.zeros(1, 2, 40 * 48 + 1)
    gone[..., -1] = 12.0
    assert float(_loss(gone, batch)) < 0.05 < loss(3, 3)


def test_a_fit_is_a_network_that_is_ready_and_the_same_again():
    clips = [("anna", windows(2)._replace(lab=torch.zeros(2, 3, 160, 192, dtype=torch.uint8)))]
    one, two = (fit(clips, steps=2, progress=False) for _ in range(2))
    assert not one.training
    lab, maps = clips[0][1].lab, torch.rand(2, 3, 160, 192)
    found = [net.find(lab, maps, torch.ones(2, 160, 192), clips[0][1].faces) for net in (one, two)]
    assert isinstance(found[0], HandPlaces)
    torch.testing.assert_close(found[0].log_prob, found[1].log_prob)


def test_every_person_is_left_out_once():
    left_out = [person for fold in FOLDS for person in fold]
    assert sorted(left_out) == sorted({*PEOPLE.values(), *SIGNERS.values()})
