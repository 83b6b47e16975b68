"""The effective sample size in what trackers return, and the note on particles that collapsed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchpose.camera import PinholeCamera, project
from torchpose.camera._projection import backproject
from torchpose.demo import performer
from torchpose.priors import load_prior
from torchpose.priors._upper_body_prior import released_process_cov
from torchpose.skeleton import LEFT_ARM, RIGHT_ARM, UPPER_BODY
from torchpose.upper_body import PoseTrack, UpperBodyTracker
from torchpose.upper_body._reading import note_collapse
from torchpose.video._recording import PoseSpool

NAMES = ["head", "neck", "hand_left", "hand_right"]
N_FRAMES = 24


@pytest.fixture(scope="module")
def prior():
    return load_prior("kinect-upper-body-small")


@pytest.fixture(scope="module")
def scene(prior):
    """Poses of the demonstration's performer 2 m away, and their keypoints with noise of 3 pixels."""
    body = performer(60 + N_FRAMES, fps=30.0, seed=1).body[60:].double()
    body = body - body[:, UPPER_BODY.index("neck")][:, None]
    place = torch.tensor([0.0, -0.2, 2.0], dtype=torch.float64)
    uv = project(body, prior.info.matrix, torch.eye(3).double(), place)[..., :2]
    noise = torch.randn(uv.shape, generator=torch.Generator().manual_seed(0)).double()
    return body + place, (uv + 3 * noise)[None, :, [UPPER_BODY.index(name) for name in NAMES]]


def mean_pose(prior):
    """The mean of the prior [1, 8, 3]: both arms' mean pixels and depths, back in space."""
    pose = torch.zeros(1, 8, 3, dtype=torch.float64)
    for arm, mixture in ((LEFT_ARM, prior.left), (RIGHT_ARM, prior.right)):
        pose[0, list(arm)] = backproject(mixture.moments()[0][:15].view(5, 3), prior.info.matrix)
    return pose


def from_neck(joints, truth):
    """Mean distance of joints from where they are, both seen from their neck."""
    neck = UPPER_BODY.index("neck")
    own, wanted = (x - x[:, neck : neck + 1] for x in (joints, truth))
    return (own - wanted).norm(dim=-1).mean()


def tracked(prior, keypoints, method, **options):
    tracker = UpperBodyTracker(prior, prior.camera, method, **options)
    return tracker(keypoints, names=NAMES, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("method", ["pf-walk", "pf-walk-unscaled"])
def test_walks_follow_with_what_a_shipped_prior_brings_and_collapse_with_the_released_q(
    method, prior, scene
):
    truth, keypoints = scene
    own = tracked(prior, keypoints, method, n_particles=1500)
    error = from_neck(own.joints3d[0], truth)
    assert error < 0.8 * from_neck(mean_pose(prior), truth)
    assert own.effective_sample_size.shape == (1, N_FRAMES, 2)
    assert not any("collapsed" in note for note in own.notes)
    forced = tracked(
        prior,
        keypoints,
        method,
        n_particles=1500,
        process_cov=released_process_cov(),
        start="prior",
    )
    assert (forced.effective_sample_size < 2).double().mean() > 0.5
    assert any("particles collapsed" in note for note in forced.notes)
    assert from_neck(forced.joints3d[0], truth) > 1.5 * error


def test_sample_size_is_that_of_the_weights(prior, scene):
    _, keypoints = scene
    tracker = UpperBodyTracker(prior, prior.camera, "mkf-split", n_tracks=4)
    track = tracker(keypoints, names=NAMES)
    left = tracker.estimator.filter("left", ("hand", "head", "neck"))
    weights = left(keypoints[:, :, [2, 0, 1]].flatten(2)).log_weights.double().exp()
    torch.testing.assert_close(track.effective_sample_size[..., 0], 1 / weights.square().sum(-1))
    state = tracker.init(1, NAMES)
    for t in range(3):
        state, pose = tracker.step(state, keypoints[:, t])
        torch.testing.assert_close(pose.effective_sample_size, track.effective_sample_size[:, t])
    assert track.notes == ()


def example(sizes, method="pf-walk", lengths=None):
    """A track of [B, T, 2] sample sizes."""
    batch, frames = sizes.shape[:2]
    zeros = torch.zeros(batch, frames, 8, 3, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(batch, frames, 8, 3, 3)
    return PoseTrack(
        joints2d=zeros[..., :2], joints3d=zeros, covariance2d=eye[..., :2, :2], covariance3d=eye,
        observed=torch.ones(batch, frames, 8, dtype=torch.bool),
        log_evidence=torch.zeros(batch, frames, 2, dtype=torch.float64),
        lengths=torch.full((batch,), frames) if lengths is None else lengths,
        matrix=PinholeCamera(525.0, 525.0, 320.0, 240.0).matrix, failed_at=torch.full((batch,), -1),
        method=method, effective_sample_size=sizes,
    )  # fmt: skip


def test_one_arm_of_one_sequence_is_enough_and_a_quarter_of_the_frames_is_not():
    sizes = torch.full((3, 8, 2), 40.0, dtype=torch.float64)
    sizes[:, :2] = 1.0
    assert note_collapse(example(sizes)).notes == ()
    sizes[1, :5, 1] = 1.2
    (note,) = note_collapse(example(sizes)).notes
    assert "(right arm of 1 of 3 sequences)" in note and "62 %" in note
    assert note_collapse(example(sizes, "mkf-fixed")).notes == ()  # a bank that is sure
    short = example(sizes, lengths=torch.tensor([8, 8, 2]))
    (note,) = note_collapse(short).notes
    assert "2 of 3 sequences" in note and "left arm and right arm" in note


def test_files_hold_the_sample_size_and_older_ones_are_read_without(tmp_path):
    sizes = torch.rand(2, 5, 2, generator=torch.Generator().manual_seed(0)).double() + 1
    track = example(sizes)
    track.save(tmp_path / "poses.npz")
    assert torch.equal(PoseTrack.load(tmp_path / "poses.npz").effective_sample_size, sizes)
    assert torch.equal(track.sequence(1).effective_sample_size, sizes[1:])
    with np.load(tmp_path / "poses.npz") as arrays:
        older = {key: arrays[key] for key in arrays if key != "effective_sample_size"}
    np.savez(tmp_path / "older.npz", **older)
    loaded = PoseTrack.load(tmp_path / "older.npz")
    assert loaded.effective_sample_size.isnan().all()
    assert loaded.effective_sample_size.shape == (2, 5, 2)


def test_a_spool_joins_sample_sizes_and_notes_a_collapse_of_the_whole(tmp_path):
    fine, bad = (torch.full((1, 4, 2), size, dtype=torch.float64) for size in (50.0, 1.0))
    spool = PoseSpool(tmp_path)
    for sizes in (fine, bad):
        spool.append(replace(example(sizes), notes=("kept",)))
    track = spool.track()
    assert torch.equal(track.effective_sample_size, torch.cat([fine, bad], 1))
    assert track.notes[0] == "kept" and "50 %" in track.notes[1]
