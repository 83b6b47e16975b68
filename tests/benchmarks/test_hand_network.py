"""The training of the network of hands: what is changed goes with its labels."""

import math

import pytest
import torch

pytest.importorskip("cv2")
from benchmarks.hand_network import training
from benchmarks.hand_network.changes import bare_skin, bordered, exchanged, lit, mirrored, moved
from benchmarks.hand_network.clips import BURN_IN, FOLDS, PEOPLE, SIGNERS, Labels, Windows
from benchmarks.hand_network.failures import Found, draw_failures, failures
from benchmarks.hand_network.training import _loss, fit
from torchpose.measure._body_window import CELL, CELLS, cell_centres
from torchpose.measure._hand_network import COARSE, HandPlaces


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
    lab = torch.zeros(count, 3, 176, 192)
    faces = torch.tensor([[0.0, 0.0, 1.0]]).expand(count, -1)
    return Windows(lab, maps, faces, places, torch.ones(count, 2, dtype=torch.long))


def brightest(maps):
    flat = maps.flatten(2).argmax(-1)
    return torch.stack([flat % CELLS[1], flat // CELLS[1]], -1)


def test_labels_move_with_their_windows():
    torch.manual_seed(0)
    changed = mirrored(moved(windows(12)), torch.arange(12) < 6)
    spots = brightest(changed.maps[:, :2])
    away = (spots[6:] - changed.places[6:]).norm(dim=-1)
    mirrored_away = (spots[:6].flip(1) - changed.places[:6]).norm(dim=-1)
    assert float(away.amax()) < 3.0 and float(mirrored_away.amax()) < 3.0
    assert float((changed.faces[:, 2] - 1).abs().amax()) > 0.05


def test_mirrored_twice_is_as_it_was():
    every = torch.ones(6, dtype=torch.bool)
    for once, twice in zip(windows(), mirrored(mirrored(windows(), every), every), strict=True):
        torch.testing.assert_close(once, twice)


def half_gone(count):
    """Windows of which every second one shows no hand."""
    batch = windows(count)
    seen = (torch.arange(count) % 2)[:, None].expand(-1, 2).clone()
    maps = batch.maps.clone()
    maps[:, :2] *= seen[..., None, None]
    return batch._replace(maps=maps, seen=seen)


def test_exchanged_hands_are_where_the_labels_say():
    torch.manual_seed(0)
    before = half_gone(200)
    after = exchanged(before)
    highest = after.maps[:, :2].flatten(2).amax(-1)
    away = (brightest(after.maps[:, :2]) - after.places).norm(dim=-1)
    assert bool((highest[after.seen == 0] < 0.8).all())
    assert bool((away[after.seen == 1] < 1.5).all() and (highest[after.seen == 1] > 0.7).all())
    came, left = (after.seen == 1) & (before.seen == 0), (after.seen == 0) & (before.seen == 1)
    assert int(came.sum()) > 20 and int(left.sum()) > 20


def test_bare_skin_leaves_hands_and_faces_as_they_are():
    torch.manual_seed(0)
    before = windows(20)
    after = bare_skin(before)
    places = before.places * CELL + cell_centres()[0, 0]
    for at in (*places.unbind(1), before.faces[:, :2]):
        near = (cell_centres(2) - at[:, None, None]).norm(dim=-1) < 0.5
        assert not bool((after.lab != before.lab)[near[:, None].expand(-1, 3, -1, -1)].any())
    changed = (after.lab != before.lab).flatten(1).any(1)
    assert 4 < int(changed.sum()) < 16
    assert bool((after.maps[changed, 0] - before.maps[changed, 0] > 0.2).flatten(1).any(1).all())


def test_hands_beyond_a_new_border_are_gone():
    torch.manual_seed(0)
    after = bordered(windows(200))
    column, row = after.places.round().long().unbind(-1)
    image = after.maps[torch.arange(200)[:, None], 3, row, column]
    assert bool((image[after.seen == 0] == 0).all()) and bool((image[after.seen == 1] == 1).all())
    assert int((after.seen == 0).sum()) > 10 and int((after.seen == 1).sum()) > 200
    outside = after.maps[:, 3] == 0
    assert not bool(after.maps[:, 1:3].movedim(1, 0)[:, outside].any())


def test_light_changes_colours_and_no_labels():
    torch.manual_seed(0)
    before = windows()
    after = lit(before)
    assert float(after.lab.std()) > 0.2
    for kept in ("faces", "places", "seen"):
        assert getattr(after, kept) is getattr(before, kept)
    torch.testing.assert_close(after.maps[:, 3], before.maps[:, 3])


def test_the_loss_is_least_at_the_label():
    batch = windows(1)
    at = (batch.places / 2).long()[0]

    def loss(column, row):
        logits = torch.zeros(1, 2, math.prod(COARSE) + 1)
        logits[0, :, row * COARSE[1] + column] = 5.0
        return float(_loss(logits, batch.places, batch.seen))

    right = batch._replace(seen=torch.tensor([[1, -1]]))
    batch = right
    assert loss(*at[0].tolist()) < loss(*(at[0] + 6).tolist())
    batch = batch._replace(seen=torch.tensor([[0, 0]]))
    gone = torch.zeros(1, 2, math.prod(COARSE) + 1)
    gone[..., -1] = 12.0
    assert float(_loss(gone, batch.places, batch.seen)) < 0.05 < loss(3, 3)


@pytest.mark.slow
def test_a_fit_is_a_network_that_is_ready_and_the_same_again(monkeypatch):
    monkeypatch.setattr(training, "BATCH", 4)
    hands = windows(2)
    both = {name: torch.cat([getattr(hands, name)] * 2, 1) for name in ("places", "seen")}
    own = hands._replace(lab=torch.zeros(2, 3, 176, 192, dtype=torch.uint8), **both)
    clips = [("anna", own)]
    one, two = (fit(clips, steps=2, progress=False) for _ in range(2))
    assert not one.training
    lab, maps = clips[0][1].lab, torch.rand(2, 3, *CELLS)
    found = [net.find(lab, maps, torch.ones(2, 176, 192), clips[0][1].faces) for net in (one, two)]
    assert isinstance(found[0], HandPlaces)
    torch.testing.assert_close(found[0].log_prob, found[1].log_prob)


def test_every_person_is_left_out_once():
    left_out = [person for fold in FOLDS for person in fold]
    assert sorted(left_out) == sorted({*PEOPLE.values(), *SIGNERS.values()})


def test_failures_are_named_and_drawn(tmp_path):
    n_frames = BURN_IN + 7
    left, right, face = (100.0, 300.0), (300.0, 300.0), (200.0, 100.0, 60.0)
    centres = torch.tensor([[left, right, left, right]], dtype=torch.float64).repeat(n_frames, 1, 1)
    seen = torch.ones(n_frames, 4, dtype=torch.long)
    points = centres.unflatten(1, (2, 2)).clone()
    measured = torch.ones(n_frames, 2, 2, dtype=torch.bool)
    first = BURN_IN + 1
    measured[first, 0, 0] = False
    points[first + 1, 0, 0] = torch.tensor(right)
    points[first + 2, 0, 0] = torch.tensor(face[:2])
    points[first + 3, 0, 0] += 100
    seen[first + 4, 1], seen[first + 5, 0] = 0, -1
    points[first + 5, 0, 0] += 100
    faces = torch.tensor([face], dtype=torch.float64).repeat(n_frames, 1)
    found = Found(points, measured, faces, (640, 480))
    labels = Labels(centres, seen, centres[:, 0], 120.0)
    kinds = ["missed", "at the other hand", "on the face", "elsewhere", "invented"]
    assert list(failures(found, labels)) == [(first + i, kind) for i, kind in enumerate(kinds)]
    drawn = list(draw_failures(tmp_path / "sheets", {"clip": (found, labels)}))
    assert [(kind, count) for kind, count, _ in drawn] == [(kind, 1) for kind in sorted(kinds)]
    assert all(path.is_file() for *_, path in drawn)
