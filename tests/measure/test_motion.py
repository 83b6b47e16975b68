"""Motion in windows: differences, running median and optical flow of drawn scenes."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from torchpose.measure._background import Motion, dense_flow
from torchpose.measure._body_window import CELLS, EVIDENCE, place_windows

pytest.importorskip("cv2")
SHAPE = (CELLS[0] * EVIDENCE, CELLS[1] * EVIDENCE)


def scene(x=60, y=80, seed=0, square=True):
    """Smooth noise with a brighter, textured square, in Lab and grey."""
    import cv2

    rng = np.random.default_rng(seed)
    back = cv2.GaussianBlur(rng.uniform(60, 120, SHAPE).astype(np.float32), (0, 0), 2)
    if square:
        front = cv2.GaussianBlur(rng.uniform(120, 250, (30, 30)).astype(np.float32), (0, 0), 1.5)
        back[y : y + 30, x : x + 30] = front
    lab = torch.from_numpy(np.stack([back, 128 + 0 * back, 128 + 0 * back]))[None]
    return lab, torch.from_numpy(back.astype(np.uint8))[None]


def test_differences_are_those_of_the_formula():
    motion = Motion(flow=False)
    state = motion.init(1)
    first, second, third = (scene(x)[0] for x in (60, 64, 70))
    for lab in (first, second, third):
        state, moving, unusual, _ = motion.step(state, lab, lab[:, 0].to(torch.uint8))
    weights = np.array([0.6, 1.0, 1.0])[:, None, None]
    difference = (np.abs(third[0].numpy() - second[0].numpy()) * weights).sum(0)
    np.testing.assert_allclose(moving[0], np.clip((difference - 2) / 20, 0, 1), atol=1e-5)
    median = first[0].numpy()
    for lab in (second, third):
        median = median + np.clip(lab[0].numpy() - median, -0.7, 0.7)
    difference = (np.abs(third[0].numpy() - median) * weights).sum(0)
    np.testing.assert_allclose(unusual[0], np.clip((difference - 4) / 30, 0, 1), atol=1e-5)


def test_the_first_frame_moves_nowhere():
    motion = Motion()
    lab, grey = scene()
    _, moving, unusual, flow = motion.step(motion.init(1), lab, grey)
    assert moving.max() == 0 and unusual.max() == 0 and flow.abs().max() == 0


def test_flow_points_back_to_where_things_were():
    motion = Motion()
    state, *_ = motion.step(motion.init(1), *scene(60, 80))
    _, _, _, flow = motion.step(state, *scene(64, 78))
    inner = flow[0, 42:52, 35:45].mean((0, 1)) * EVIDENCE
    np.testing.assert_allclose(inner, [-4, 2], atol=1.0)
    assert flow[0, :20].abs().max() < 0.3


def test_flow_in_two_threads_is_that_in_one():
    start, known = torch.zeros(1, *SHAPE, 2), torch.tensor([True])
    pairs = [(scene(64, 78, seed)[1], scene(60, 80, seed)[1]) for seed in (0, 1)]

    def flows(pair):
        return [dense_flow(*pair, start, known)[0] for _ in range(60)]

    alone = [dense_flow(*pair, start, known)[0] for pair in pairs]
    with ThreadPoolExecutor(2) as threads:
        for expected, found in zip(alone, threads.map(flows, pairs), strict=True):
            assert all(torch.equal(flow, expected) for flow in found)


def test_a_moved_window_keeps_what_it_knew():
    motion = Motion()
    state, *_ = motion.step(motion.init(1), *scene())
    old = place_windows(torch.tensor([[320.0, 150.0, 80.0]]))
    new = old + torch.tensor([[0.05 * 10 * 80, 0.0, 0.0]])  # ten pixels of the maps to the right
    moved = motion.move(state, old, new, torch.tensor([True]))
    torch.testing.assert_close(moved.last[..., :-10], state.last[..., 10:], atol=0.05, rtol=0)
    assert (moved.grey[..., :-10].int() - state.grey[..., 10:].int()).abs().max() <= 1
    same = motion.move(state, old, new, torch.tensor([False]))
    assert same.last is state.last


def test_a_batch_is_its_elements():
    motion = Motion()
    frames = [[scene(60, 80), scene(64, 80)], [scene(90, 50, 1), scene(90, 56, 1)]]
    both = motion.init(2)
    alone = [motion.init(1), motion.init(1)]
    for t in range(2):
        lab, grey = (torch.cat([f[t][i] for f in frames]) for i in (0, 1))
        both, *pair = motion.step(both, lab, grey)
        for n in range(2):
            alone[n], *own = motion.step(alone[n], *frames[n][t])
            for x, y in zip(pair, own, strict=True):
                torch.testing.assert_close(x[n], y[0])


def test_without_a_frame_before_there_is_no_flow():
    _, grey = scene()
    start = torch.zeros(1, *SHAPE, 2)
    flow, cells = dense_flow(grey, grey, start, torch.tensor([False]))
    assert flow.abs().max() == 0 and cells.shape == (1, *CELLS, 2)
