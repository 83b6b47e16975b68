"""The face's memory on drawn faces: what changes it, and what does not."""

import numpy as np
import pytest
import torch
import torch.nn.functional as functional

from torchpose.errors import ShapeError
from torchpose.measure._body_window import CELLS, EVIDENCE, place_windows
from torchpose.measure._head import FaceMemory, head_mask, head_part

FACE = torch.tensor([[320.0, 150.0, 76.0]], dtype=torch.float64)
ANCHOR = place_windows(FACE)
NO_HANDS = torch.zeros(1, *CELLS)


def texture(seed=0):
    """Smooth noise where heads can be, Lab in bytes [1, 3, 216, 192]."""
    noise = torch.rand(1, 3, 27, 24, generator=torch.Generator().manual_seed(seed))
    smooth = functional.interpolate(noise, scale_factor=8.0, mode="bicubic", align_corners=False)
    return (128 + 60 * (smooth - 0.5)).clamp(0, 255).to(torch.uint8)


def learnt(memory, lab, frames=12):
    state = memory.init(1)
    for _ in range(frames):
        state, hidden = memory.step(state, lab, FACE, ANCHOR, NO_HANDS)
    return state, hidden


def mean_over(hidden, x0, x1, y0, y1):
    """Mean over a rectangle, in B from the face."""
    from torchpose.measure._body_window import cell_centres

    place = cell_centres(EVIDENCE)[head_part(EVIDENCE)]
    inside = (
        (place[..., 0] > x0) & (place[..., 0] < x1) & (place[..., 1] > y0) & (place[..., 1] < y1)
    )
    return float(hidden[0][inside].mean())


def test_head_and_neck_are_hidden_and_nothing_else():
    _, hidden = learnt(FaceMemory(), texture())
    assert mean_over(hidden, -0.35, 0.35, -0.5, 0.5) > 0.99
    assert mean_over(hidden, -0.3, 0.3, 0.8, 0.95) > 0.95
    assert mean_over(hidden, 0.8, 2.0, -1.0, 1.5) == 0
    assert mean_over(hidden, -1.0, 1.0, 1.3, 2.5) == 0


def test_a_hand_before_the_face_is_seen():
    memory, lab = FaceMemory(), texture()
    state, _ = learnt(memory, lab)
    covered = lab.clone()
    covered[:, :, 90:130, 80:112] = 170  # from the face's centre to 1 B below it
    _, hidden = memory.step(state, covered, FACE, ANCHOR, NO_HANDS)
    assert mean_over(hidden, -0.2, 0.2, 0.1, 0.6) < 0.05
    assert mean_over(hidden, -0.3, 0.3, -0.6, -0.3) > 0.9


def test_a_face_that_moves_within_its_patch_is_no_change():
    lab = texture()
    moved = torch.roll(lab, (5, -4), (2, 3))  # 0.125 and 0.1 B
    aligned, fixed = FaceMemory(), FaceMemory(align=False)
    changes = []
    for memory in (aligned, fixed):
        state, _ = learnt(memory, lab)
        _, hidden = memory.step(state, moved, FACE, ANCHOR, NO_HANDS)
        changes.append(1 - mean_over(hidden, -0.3, 0.3, -0.4, 0.4))
    assert changes[0] < 0.1 < changes[1]


def test_the_memory_follows_slowly_and_more_slowly_under_a_hand():
    memory, lab = FaceMemory(), texture()
    state, _ = learnt(memory, lab)
    other = texture(1)
    free, _ = memory.step(state, other, FACE, ANCHOR, NO_HANDS)
    under, _ = memory.step(state, other, FACE, ANCHOR, torch.ones(1, *CELLS))
    assert float((free.mean - state.mean).abs().max()) == pytest.approx(0.15, abs=1e-4)
    assert float((under.mean - state.mean).abs().max()) == pytest.approx(0.05, abs=1e-4)


def test_without_memory_the_face_always_hides():
    memory, lab = FaceMemory(remember=False), texture()
    state, _ = learnt(memory, lab)
    _, hidden = memory.step(state, texture(3), FACE, ANCHOR, NO_HANDS)
    assert mean_over(hidden, -0.35, 0.35, -0.5, 0.5) > 0.99
    np.testing.assert_allclose(hidden.max(), head_mask().max(), atol=1e-6)


def test_a_batch_is_its_elements():
    memory = FaceMemory()
    labs = [texture(s) for s in range(3)]
    faces = FACE.repeat(2, 1) + torch.tensor([[0.0, 0, 0], [9.0, -6.0, 2.0]])
    anchors = ANCHOR.repeat(2, 1)
    both, alone = memory.init(2), [memory.init(1), memory.init(1)]
    for t in range(3):
        pair = torch.cat([labs[t], labs[2 - t]])
        both, hidden = memory.step(both, pair, faces, anchors, NO_HANDS.repeat(2, 1, 1))
        for n in range(2):
            alone[n], own = memory.step(
                alone[n], pair[n : n + 1], faces[n : n + 1], ANCHOR, NO_HANDS
            )
            torch.testing.assert_close(hidden[n], own[0])


def test_other_shapes_are_refused():
    memory = FaceMemory()
    with pytest.raises(ShapeError):
        memory.step(memory.init(1), texture()[:, :, 1:], FACE, ANCHOR, NO_HANDS)
