"""Keypoints averaged over nearby frames: parabolas by NumPy, gaps, ends, and what is no noise."""

import numpy as np
import torch

from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._nearby_frames import averaged_over_frames, frames_of_reach


def seen(n_frames=20, noise=2.0):
    generator = torch.Generator().manual_seed(0)
    time = torch.arange(n_frames, dtype=torch.float64)[:, None, None]
    path = 300 + 4 * time - 0.2 * time.square() + torch.arange(16.0).view(8, 2)
    uv = path + noise * torch.randn(n_frames, 8, 2, generator=generator, dtype=torch.float64)
    mask = torch.ones(1, n_frames, 8, dtype=torch.bool)
    mask[0, 7:9, 3] = False
    cov = torch.linspace(4.0, 9.0, n_frames).double().view(1, -1, 1, 1, 1) * torch.eye(2).double()
    measured = MeasuredJoints(
        torch.where(mask[..., None], uv[None], 0.0), mask, cov.repeat(1, 1, 8, 1, 1)
    )
    return measured, path


def test_keypoints_are_put_on_the_weighted_parabola_of_the_frames_around():
    measured, path = seen()
    found = averaged_over_frames(measured, None, 4).uv[0]
    for t, joint in ((0, 0), (6, 3), (10, 3), (11, 5), (19, 7)):
        rows = [s for s in range(max(0, t - 4), min(20, t + 5)) if measured.mask[0, s, joint]]
        std = measured.cov[0, rows, joint, 0, 0].sqrt()
        z = measured.uv[0, rows, joint].numpy()
        fit = np.polynomial.polynomial.polyfit(np.array(rows) - t, z, 2, w=(1 / std).numpy())
        np.testing.assert_allclose(found[t, joint], fit[0], atol=1e-3)
    assert bool((found[7:9, 3] == 0).all())
    off = [(x - path)[measured.mask[0]].square().mean() for x in (found, measured.uv[0])]
    assert float(off[0]) < 0.5 * float(off[1])


def test_what_is_too_far_off_for_noise_is_moved_by_two_standard_deviations_at_most():
    measured, _ = seen(noise=0.0)
    jumped = measured.uv.clone()
    jumped[:, 10:] += 200.0
    found = averaged_over_frames(measured._replace(uv=jumped), None, 4).uv
    moved = (found - jumped).norm(dim=-1)[measured.mask]
    std = measured.cov[..., 0, 0].sqrt()[measured.mask]
    assert bool((moved <= 2 * std + 1e-9).all()) and float((moved / std).max()) > 1.99


def test_frames_past_the_end_are_not_used_and_a_lag_limits_the_reach():
    measured, _ = seen()
    whole = averaged_over_frames(measured, torch.tensor([12]), 4).uv[:, :12]
    short = MeasuredJoints(*(x[:, :12] for x in measured[:3]))
    torch.testing.assert_close(whole, averaged_over_frames(short, None, 4).uv)
    assert [frames_of_reach(30.0, s) for s in (None, 0, 2, 20, "full")] == [0, 0, 2, 4, 4]
    assert frames_of_reach(60.0, "full") == 8
