"""Blocks of poses on disk are the poses."""

from dataclasses import replace

import pytest
import torch

import torchpose.video._recording
from torchpose.errors import InputError, OutputError
from torchpose.upper_body import PoseTrack
from torchpose.upper_body._outlier_notes import outlier_notes
from torchpose.video._recording import PoseSpool

FIELDS = ("joints2d", "joints3d", "covariance2d", "covariance3d", "observed", "log_evidence")


def poses(n_frames, seed=0, failed_at=-1):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(1, n_frames, *shape, generator=generator, dtype=torch.float64)

    def spread(dim):
        factor = draw(8, dim, dim)
        return factor @ factor.mT

    return PoseTrack(
        draw(8, 2),
        draw(8, 3),
        spread(2),
        spread(3),
        draw(8) > 0,
        draw(2),
        torch.tensor([n_frames]),
        torch.eye(3, dtype=torch.float64),
        torch.tensor([failed_at]),
        fps=25.0,
        notes=("a note",),
        method="pf-walk",
    )


def test_blocks_come_back_as_one_track_that_can_be_cut_saved_and_outlives_the_spool(tmp_path):
    blocks = [poses(3, 1), poses(1, 2), poses(32, 3)]
    spool = PoseSpool(tmp_path)
    for block in blocks:
        spool.append(block)
    assert len(spool) == 36
    track, part = spool.track(), spool.track(5)
    del spool
    assert list(tmp_path.iterdir()) == []
    for name in FIELDS:
        whole = torch.cat([getattr(block, name) for block in blocks], 1)
        assert torch.equal(getattr(track, name), whole)
        assert torch.equal(getattr(part, name), whole[:, :5])
    assert (track.fps, track.notes, int(track.lengths)) == (25.0, ("a note",), 36)
    assert track.method == "pf-walk"
    track.save(tmp_path / "poses.npz")
    assert torch.equal(PoseTrack.load(tmp_path / "poses.npz").joints3d, track.joints3d)


def test_single_poses_are_written_together_and_read_at_any_time(tmp_path):
    frames, spool, sizes = [poses(1, seed) for seed in range(40)], PoseSpool(tmp_path), []
    for frame in frames:
        spool.append(frame)
        sizes.append(sum(file.stat().st_size for file in tmp_path.glob("*/*.bin")))
    assert sizes[30] == 0 and 0 < sizes[31] == sizes[39]
    for count in (40, 41):
        whole = torch.cat([frame.joints3d for frame in frames], 1)
        assert torch.equal(spool.track().joints3d, whole)
        frames.append(poses(1, count))
        spool.append(frames[-1])


def test_the_first_failure_is_known():
    spool = PoseSpool()
    for block in (poses(4), poses(4, failed_at=2), poses(4, failed_at=0)):
        spool.append(block)
    assert spool.track().failed_at.tolist() == [6]


def test_misuse_is_refused(tmp_path):
    spool = PoseSpool()
    with pytest.raises(InputError, match="poses"):
        spool.track()
    spool.append(poses(2))
    with pytest.raises(InputError, match="1 to 2"):
        spool.track(3)
    with pytest.raises(OutputError, match="cannot be kept"):
        PoseSpool(tmp_path / "missing")


def test_outliers_of_all_blocks_are_in_one_note():
    spool = PoseSpool()
    for seed, exchanged in ((1, 2), (2, 0), (3, 4)):
        block = poses(4, seed)
        block.inlier_probability[0, 1, 3] = 0.1
        own = outlier_notes(block.inlier_probability, exchanged)
        spool.append(replace(block, notes=("a note", *own)))
    note, found = spool.track().notes
    assert note == "a note"
    assert found.startswith("3 keypoints taken as outliers") and "head 3; " in found
    assert found.endswith("exchanged back in 6 frames")


def test_notes_of_later_blocks_are_kept_and_said_once():
    spool = PoseSpool()
    for notes in ((), ("a note",), ("another",), ("a note",)):
        spool.append(replace(poses(4), notes=notes))
    assert spool.track().notes == ("a note", "another")


def test_poses_that_a_full_disk_did_not_take_are_written_once_there_is_room(tmp_path, monkeypatch):
    spool, taken = PoseSpool(tmp_path), []

    def full(values):
        if len(taken) == 3:
            raise OSError(28, "No space left on device")
        taken.append(values)
        return array(values)

    array = torchpose.video._recording._array
    with monkeypatch.context() as disk:
        disk.setattr("torchpose.video._recording._array", full)
        with pytest.raises(OutputError, match="No space left"):
            spool.append(poses(40, 1))
    spool.append(poses(2, 2))
    track = spool.track()
    for name in FIELDS:
        whole = torch.cat([getattr(poses(*given), name) for given in ((40, 1), (2, 2))], 1)
        assert torch.equal(getattr(track, name), whole)
