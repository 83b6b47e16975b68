"""The histogram filter on a tiny grid, against sums written out cell by cell."""

import math

import numpy as np
import torch

from torchpose.measure._grid_filter import exclude, predict, read_out, without_jumps

H, W = 7, 9
RNG = np.random.default_rng(0)


def beliefs(seed=0):
    belief = torch.rand(2, 2, H, W, generator=torch.Generator().manual_seed(seed))
    return belief / belief.sum((2, 3), keepdim=True)


def gaussian_weight(target, source, size, sigma, shift=0.0):
    """Share of `source` that goes to `target` along a row of cells."""
    weights = [math.exp(-0.5 * ((i - source - shift) / sigma) ** 2) for i in range(size)]
    return weights[target] / sum(weights)


def brute_blur(belief, sigma, shift=(0.0, 0.0)):
    out = np.zeros((H, W))
    for y in range(H):
        for x in range(W):
            for v in range(H):
                for u in range(W):
                    down = gaussian_weight(y, v, H, sigma, shift[1])
                    out[y, x] += belief[v, u] * down * gaussian_weight(x, u, W, sigma, shift[0])
    return out


def bilinear(belief, x, y):
    total, x0, y0 = 0.0, math.floor(x), math.floor(y)
    for v in (y0, y0 + 1):
        for u in (x0, x0 + 1):
            if 0 <= u < W and 0 <= v < H:
                total += belief[v, u] * (1 - abs(x - u)) * (1 - abs(y - v))
    return total


def test_prediction_is_the_sum_over_all_ways():
    belief, rebirth = beliefs(), beliefs(1)
    speed = torch.tensor([[[0.5, -0.3], [0.0, 1.2]], [[-1.0, 0.0], [0.2, 0.2]]])
    flow = torch.rand(2, H, W, 2, generator=torch.Generator().manual_seed(2)) * 2 - 1
    moves = torch.tensor([1.0, 0.4])
    found = predict(
        belief, rebirth, speed, flow, moves,
        near=0.8, far=2.0, near_share=0.7, flow_share=0.4, flow_blur=0.6, jump=0.1, rest=0.35,
    )  # fmt: skip
    for n in range(2):
        for k in range(2):
            p = belief[n, k].double().numpy()
            spread = 0.7 * brute_blur(p, 0.8, speed[n, k].tolist()) + 0.3 * brute_blur(p, 2.0)
            soft, carried = brute_blur(p, 0.6), np.zeros((H, W))
            for y in range(H):
                for x in range(W):
                    dx, dy = flow[n, y, x].tolist()
                    carried[y, x] = bilinear(soft, x + dx, y + dy)
            out = 0.9 * (0.6 * spread + 0.4 * carried) + 0.1 * rebirth[n, k].numpy()
            m = float(moves[n])
            expected = m * out + (1 - m) * brute_blur(p, 0.35)
            np.testing.assert_allclose(found[n, k], expected, atol=2e-6)


def brute_exclude(base, exclusion, radius, crossing, soft, rounds, present=(1, 1)):
    base = [b / b.sum() for b in base]
    message = [np.ones((H, W)), np.ones((H, W))]
    for turn in range(2 * rounds):
        k = turn % 2
        other = base[1 - k] * message[1 - k]
        other = other / other.sum()
        taken = np.clip(brute_blur(other, radius) * 1.2 * 2 * math.pi * radius**2, 0, 1)
        wrong = np.zeros(W)
        for x in range(W):
            left_of = sum(
                gaussian_weight(x, c, W, soft) * other[:, : c + 1].sum() for c in range(W)
            )
            wrong[x] = 1 - left_of if k == 0 else left_of
        message[k] = (1 - (1 - math.exp(-exclusion)) * present[1 - k] * taken) * (
            1 - (1 - math.exp(-crossing)) * present[1 - k] * wrong
        )
    out = [b * m for b, m in zip(base, message, strict=True)]
    return np.stack([o / o.sum() for o in out])


def test_exclusion_is_the_sum_over_the_other_hand():
    base = beliefs(3).square()
    found = exclude(base, 2.5, 1.4, 2.8, 0.9, torch.ones(2, 2), rounds=2)
    for n in range(2):
        expected = brute_exclude(base[n].double().numpy(), 2.5, 1.4, 2.8, 0.9, 2)
        np.testing.assert_allclose(found[n], expected, atol=2e-6)


def test_a_hand_excludes_the_other_as_far_as_it_is_visible():
    base, present = beliefs(3).square(), torch.tensor([[0.9, 0.2], [0.0, 1.0]])
    found = exclude(base, 2.5, 1.4, 2.8, 0.9, present)
    for n in range(2):
        own = base[n].double().numpy(), 2.5, 1.4, 2.8, 0.9, 2, present[n].tolist()
        np.testing.assert_allclose(found[n], brute_exclude(*own), atol=2e-6)
    right = base[1, 1] / base[1, 1].sum()  # the left hand is gone
    torch.testing.assert_close(found[1, 1], right, atol=1e-7, rtol=1e-5)


def test_two_hands_do_not_take_one_place():
    peak = torch.full((1, 2, 20, 30), 1e-4)
    peak[:, :, 10, 8], peak[:, :, 10, 22] = 1.0, 0.8
    found = exclude(peak, 2.5, 3.0, 2.8, 1.5, torch.ones(1, 2))
    assert found[0, 0, 10, 22] > 0.8 and found[0, 1, 10, 8] > 0.8  # the left hand is on the right


def test_a_jump_to_the_other_hand_is_the_product_over_cells():
    predicted, present = beliefs(5).square(), torch.tensor([[0.9, 0.6], [1.0, 0.3]])
    predicted = predicted / predicted.sum((2, 3), keepdim=True)
    found = without_jumps(predicted, 5.0, 1.4, 0.9, present)
    for n in range(2):
        seen = present[n].tolist()
        near, taken = (
            [
                np.clip(brute_blur(p, size) * 1.2 * 2 * math.pi * size**2, 0, 1)
                for p in predicted[n].double().numpy()
            ]
            for size in (1.4, 0.9)
        )
        for k in range(2):
            jump = 1 - np.exp(-5.0 * seen[k] * (near[k].max() - near[k]))
            expected = predicted[n, k].numpy() * (1 - seen[1 - k] * taken[1 - k] * jump)
            np.testing.assert_allclose(found[n, k], expected, atol=2e-6)


def test_a_hand_jumps_to_the_other_one_only_if_its_place_was_unknown():
    there = torch.full((4, 2, 20, 30), 1e-4)
    there[:, 0, 10, 8] = there[:2, 1, 10, 22] = 1.0  # the second one is hidden
    there[3, 1, 10, 9] = 1.0  # it was here, nobody knows where the third right hand was
    there = there / there.sum((2, 3), keepdim=True)
    present = torch.tensor([[1.0, 1.0], [1.0, 0.0], [1.0, 1.0], [1.0, 1.0]])
    kept = (without_jumps(there, 5.0, 3.0, 3.0, present) / there)[:, 1, 10, 8]
    assert kept[0] < 0.02
    assert (kept[1:] > 0.9).all()


def test_read_out_is_mean_covariance_and_mass_near_the_mode():
    belief = beliefs(4)
    belief[0, 0, 2, 6] += 3.0
    belief[1, 1, 5, 1] += 2.0
    belief = belief / belief.sum((2, 3), keepdim=True)
    found = read_out(belief, smooth=0.5, within=2.3)
    for n in range(2):
        for k in range(2):
            p = belief[n, k].double().numpy()
            smooth = brute_blur(p, 0.5)
            row, column = np.unravel_index(smooth.argmax(), smooth.shape)
            y, x = np.mgrid[:H, :W]
            near = (x - column) ** 2 + (y - row) ** 2 < 2.3**2
            mass = p[near].sum()
            mean = np.array([(p * near * x).sum(), (p * near * y).sum()]) / mass
            points = np.stack([x[near], y[near]], 1) - mean
            covariance = (points * p[near][:, None]).T @ points / mass
            assert found.mode[n, k].tolist() == [column, row]
            np.testing.assert_allclose(found.mass[n, k], mass, rtol=1e-6)
            np.testing.assert_allclose(found.place[n, k], mean, rtol=1e-6)
            np.testing.assert_allclose(found.covariance[n, k], covariance, atol=1e-6)
