"""The signer protocol: densities against a plain Kalman filter, tiny videos, and the real ones."""

import numpy as np
import pytest
import torch

from benchmarks import signer
from benchmarks._signer_models import OBSERVED
from tests.data import data_dir_or_skip
from torchpose.errors import FileFormatError
from torchpose.filters import MixtureKalmanFilter
from torchpose.priors import GaussianMixture


def write_videos(folder, n_videos=3, n_frames=36, seed=0):
    """Annotations, a prior of two components and a reference of our own tracker."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    videos = {}
    for i in range(n_videos):
        walk = rng.normal(0, 3, (n_frames - i, 3, 2)).cumsum(0)
        home = np.array([[150, 150], [60, 150], [105, 60]])
        videos[f"video_{i:03d}"] = (home + 0.5 * walk).round().astype(np.int16)
    videos["video_000"][7, 0] = 0  # not annotated
    np.savez(folder / "rwth_annotations.npz", **videos)
    arrays = {}
    for side, x in (("left", 150), ("right", 60)):
        mean = np.zeros((2, 21))
        mean[:, 0:15:3] = [x, (x + 105) / 2, 105 + (x - 105) / 3, 105, 105]
        mean[:, 1:15:3] = [150, 170, 120, 60, 105]
        mean[:, 2:15:3] = 4.5
        mean[1, 1] = 100
        root = 5 * rng.normal(size=(2, 21, 21))
        arrays |= {
            f"{side}_weights": np.array([0.6, 0.4]), f"{side}_means": mean,
            f"{side}_covariances": root @ root.transpose(0, 2, 1) / 4 + np.eye(21),
        }  # fmt: skip
    np.savez(folder / "released_prior_Training20_02.npz", **arrays)
    reference = {}
    for side in ("left", "right"):
        parts = (
            torch.from_numpy(arrays[f"{side}_{k}"]) for k in ("weights", "means", "covariances")
        )
        z = torch.from_numpy(np.concatenate([rng.normal(100, 20, (20, 8))], 1))
        out = signer.released_filter(GaussianMixture(*parts))(z[None])
        reference |= {
            f"{side}_measurements": z.numpy(), f"{side}_mean": out.mean[0].numpy(),
            f"{side}_weights": out.log_weights[0].exp().numpy(),
        }  # fmt: skip
    reference["right_mean"] = reference["right_mean"] + 1e-3  # one arm that does not agree
    np.savez(folder / "reference_fixed_tracks_video_000.npz", **reference)
    return folder


def test_hand_density_against_a_plain_kalman_filter():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(21, 21))
    sigma, mean = root @ root.T + np.eye(21), rng.normal(size=21)
    q, r = np.diag(rng.uniform(0.5, 2, 21)), np.diag(rng.uniform(0.5, 2, 6))
    model = MixtureKalmanFilter(
        GaussianMixture(torch.ones(1).double(), torch.from_numpy(mean)[None], torch.from_numpy(sigma)[None]),
        torch.from_numpy(q), torch.from_numpy(r), OBSERVED[:6], uniform_weight=0.0,
    )  # fmt: skip
    z = rng.normal(size=(9, 6)) * 3
    z[4, 2:4] = np.nan
    hidden = np.zeros(9, bool)
    hidden[2:6] = True
    found = signer.hand_log_density(
        model, torch.from_numpy(z)[None], torch.from_numpy(hidden)[None]
    )[0]

    observe = np.eye(21)[list(OBSERVED[:6])]
    f = sigma @ np.linalg.inv(q + sigma)
    noise = f @ q
    m, p = mean.copy(), sigma.copy()
    for t in range(9):
        m, p = mean + f @ (m - mean), f @ p @ f.T + noise
        hand = slice(2, 4)
        s = observe[hand] @ p @ observe[hand].T + r[hand, hand]
        d = z[t, hand] - observe[hand] @ m
        expected = -0.5 * (d @ np.linalg.solve(s, d) + np.log(np.linalg.det(2 * np.pi * s)))
        if t == 0 or np.isnan(expected):
            assert torch.isnan(found[t])
        else:
            assert float(found[t]) == pytest.approx(expected, rel=1e-9)
        rows = [0, 1, 4, 5] if hidden[t] else list(range(6))
        h, rr = observe[rows], r[np.ix_(rows, rows)]
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + rr)
        m, p = m + gain @ (z[t, rows] - h @ m), p - gain @ h @ p


@pytest.mark.slow
def test_protocol_on_tiny_videos(tmp_path, monkeypatch):
    monkeypatch.setattr(signer, "GAPS", (0.0, 1.0))
    folder = write_videos(tmp_path / "signer")
    report = signer.run(tmp_path, tmp_path / "out", progress=False, learning_steps=2)
    parity = report["parity"]
    assert parity["video_000, left", "within 1e-6"] == "yes"
    assert parity["video_000, right", "within 1e-6"] == "NO"
    assert "1 of 2 arms" in report.findings[0]
    for gap in ("0", "1"):
        table = report[f"prediction_{gap}"]
        assert table["released", "against released"] == 0
        assert np.isfinite([row[0] for row in table.rows.values()]).all()
    assert report["noise"]["paper", "gain (nats/frame)"] > 0
    assert 0 < report["noise"]["ou", "gamma"] < 1
    assert (tmp_path / "out" / "hidden-hand-prediction.png").stat().st_size > 1000
    assert len(signer.read_videos(folder).names) == 3


def test_videos(tmp_path):
    folder = write_videos(tmp_path / "signer")
    videos = signer.read_videos(folder)
    assert videos.z.shape == (2, 3, 36, 6) and videos.lengths.tolist() == [36, 35, 34]
    torch.testing.assert_close(videos.z[0, :, 0, 5], videos.z[0, :, 0, 1] + 45)
    assert bool(videos.z[0, 0, 7, 2:4].isnan().all()) and bool(videos.z[1, 0, 7].isfinite().all())
    np.savez(folder / "rwth_annotations.npz", video_000=np.zeros((4, 2)))
    with pytest.raises(FileFormatError, match=r"\[T, 3, 2\]"):
        signer.read_videos(folder)
    np.savez(folder / "rwth_annotations.npz", other=np.zeros(1))
    with pytest.raises(FileFormatError, match="video_NNN"):
        signer.read_videos(folder)


@pytest.mark.data
@pytest.mark.slow
def test_released_tracker(tmp_path, monkeypatch):
    monkeypatch.setattr(signer, "GAPS", (0.5,))  # the tiny videos have none, and whole ones
    folder = data_dir_or_skip("signer")
    report = signer.run(folder, tmp_path, progress=False, quick=True, learning_steps=2)
    assert [row[2] for row in report["parity"].rows.values()] == ["yes"] * 4
    table = report["prediction_0.5"]
    assert table["learnt noise, ou", "mean"] > table["released", "mean"]
