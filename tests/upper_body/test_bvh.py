"""BVH files, read back by a reader of the tests' own and posed node by node."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.upper_body.bvh_reader import pose, read_bvh
from torchpose import PinholeCamera
from torchpose.demo import performer
from torchpose.errors import InputError, OutputError, ShapeError
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack
from torchpose.upper_body._pose_files import joints_to_bvh, write_bvh

Y_UP = np.array([1.0, -1.0, -1.0])
LEFT_ARM = ("shoulder_left", "elbow_left", "hand_left")


def track_of(joints: torch.Tensor, fps: float | None = 30.0) -> PoseTrack:
    T = len(joints)
    return PoseTrack(
        joints2d=torch.zeros(1, T, 8, 2),
        joints3d=joints[None],
        covariance2d=torch.zeros(1, T, 8, 2, 2),
        covariance3d=torch.zeros(1, T, 8, 3, 3),
        observed=torch.ones(1, T, 8, dtype=torch.bool),
        log_evidence=torch.zeros(1, T, 2),
        lengths=torch.tensor([T]),
        matrix=torch.eye(3),
        failed_at=torch.tensor([-1]),
        fps=fps,
    )


def read_joints(path, frames) -> np.ndarray:
    """[T, 8, 3], metres, camera axes."""
    motion = read_bvh(path)
    places = [pose(motion, frame) for frame in frames]
    return np.stack([[p[name] for name in UPPER_BODY] for p in places]) / 100 * Y_UP


def test_a_body_of_fixed_bones_comes_back_exactly(tmp_path):
    joints = performer(n_frames=600).joints
    write_bvh(track_of(joints), tmp_path / "poses.bvh")
    frames = range(0, 600, 9)
    back = read_joints(tmp_path / "poses.bvh", frames)
    # six decimals of degrees over a chain of 80 cm
    assert np.abs(back - joints[list(frames)].numpy()).max() < 1e-7


def test_poses_of_a_tilted_camera_are_written_upright(tmp_path):
    camera = PinholeCamera(525, 525, 320, 240).tilted(0.4, 0.1)
    joints = performer(n_frames=30).joints
    tilted = replace(track_of(joints @ camera.level_rotation), up=camera.up)
    write_bvh(tilted, tmp_path / "poses.bvh")
    back = read_joints(tmp_path / "poses.bvh", range(30))
    assert np.abs(back - joints.numpy()).max() < 1e-7
    write_bvh(replace(tilted, frame="body"), tmp_path / "body.bvh")
    back = read_joints(tmp_path / "body.bvh", range(30))
    assert np.abs(back - tilted.joints3d[0].numpy()).max() < 1e-7


def test_other_bodies_come_back_within_the_variation_of_their_bones(tmp_path):
    g = torch.Generator().manual_seed(0)
    joints = performer(n_frames=60).joints
    noisy = joints + 0.01 * torch.randn(joints.shape, generator=g, dtype=joints.dtype)
    write_bvh(track_of(noisy), tmp_path / "poses.bvh")
    back = read_joints(tmp_path / "poses.bvh", range(60))
    chain = torch.stack([noisy[:, UPPER_BODY.index(n)] for n in ("neck", *LEFT_ARM)], 1)
    lengths = chain.diff(dim=1).norm(dim=-1)
    bound = (lengths - lengths.median(0).values).abs().cumsum(-1).numpy()
    for i, name in enumerate(LEFT_ARM):
        j = UPPER_BODY.index(name)
        gap = np.linalg.norm(back[:, j] - noisy[:, j].numpy(), axis=-1)
        assert (gap <= bound[:, i] + 1e-7).all()
    assert np.abs(back[:, 4] - noisy[:, 4].numpy()).max() < 1e-7  # the root is the neck itself


def test_the_file_is_a_t_pose_facing_forward_in_centimetres(tmp_path):
    joints = performer(n_frames=30, fps=25.0).joints
    write_bvh(track_of(joints, fps=25.0), tmp_path / "poses.bvh")
    motion = read_bvh(tmp_path / "poses.bvh")
    nodes = {node.name: node for node in motion.nodes}
    assert motion.frame_time == pytest.approx(1 / 25)
    assert len(motion.frames) == 30
    assert nodes["hand_left"].offset == pytest.approx([30.5, 0, 0])  # forearm and palm
    assert nodes["elbow_right"].offset == pytest.approx([-28, 0, 0])
    assert nodes["head"].offset[1] == pytest.approx(18.84, abs=0.01)
    assert nodes["neck"].channels[:3] == ("Xposition", "Yposition", "Zposition")
    start = pose(motion, 0)
    assert start["head"][1] > start["neck"][1] > start["hand_left"][1]  # y up
    assert start["shoulder_left"][0] > start["shoulder_right"][0]
    towards = np.cross(start["shoulder_left"] - start["shoulder_right"], [0, 1, 0])
    assert towards[2] > 0  # the person faces +z


def test_frames_without_a_pose_repeat_the_last_one(tmp_path):
    joints = performer(n_frames=12).joints
    holes = joints.clone()
    holes[0] = torch.nan
    holes[5:8, 3] = torch.nan  # one joint is enough
    holes[11] = torch.inf
    write_bvh(track_of(holes), tmp_path / "poses.bvh")
    back = read_joints(tmp_path / "poses.bvh", range(12))
    expected = joints[[1, 1, 2, 3, 4, 4, 4, 4, 8, 9, 10, 10]].numpy()
    assert np.abs(back - expected).max() < 1e-7


def test_arms_that_point_against_their_direction_at_rest_are_no_trouble():
    """Half a turn has no unique axis."""
    neck = torch.tensor([0.0, 0.0, 2.0])
    shoulder, other = torch.tensor([0.2, 0.0, 0.0]), torch.tensor([-0.2, 0.0, 0.0])
    back = torch.tensor([-0.3, 0.0, 0.0])
    joints = torch.stack(
        [neck + shoulder + 2 * back, neck + shoulder + back, neck + shoulder,
         neck + torch.tensor([0.0, 0.2, 0.0]), neck, neck + other, neck + other - back,
         neck + other - 2 * back]
    )[None].double()  # fmt: skip
    motion = joints_to_bvh(joints)
    assert bool(motion.angles.isfinite().all())
    assert motion.lengths.tolist() == pytest.approx([20, 20, 20, 30, 30, 30, 30])


def test_angles_do_not_jump_by_a_whole_turn():
    angle = torch.linspace(0, 4 * torch.pi, 200, dtype=torch.float64)  # the person spins twice
    turn = torch.stack([angle.cos(), 0 * angle, -angle.sin()], -1)
    joints = performer(n_frames=1).joints.expand(200, 8, 3).clone()
    neck = joints[:, 4]
    joints[:, 2], joints[:, 5] = neck + 0.2 * turn, neck - 0.2 * turn
    yaw = joints_to_bvh(joints).angles[:, 0, 2]
    assert float(yaw.diff().abs().max()) < 5
    assert abs(float(yaw[-1] - yaw[0])) == pytest.approx(720, abs=1e-6)


def test_one_who_lies_on_the_side_has_a_root_too(tmp_path):
    joints = performer(n_frames=4).joints
    lying = torch.stack([joints[..., 1], -joints[..., 0], joints[..., 2]], -1)
    flat = lying[:, 2:6] - lying[:, 4:5]
    flat[..., [0, 2]] *= torch.tensor([1.0, 1.0])
    lying[:, 2, [0, 2]] = lying[:, 5, [0, 2]]  # shoulders exactly above each other
    write_bvh(track_of(lying), tmp_path / "poses.bvh")
    back = read_joints(tmp_path / "poses.bvh", range(4))
    assert np.isfinite(back).all()
    assert np.abs(back - lying.numpy()).max() < 0.02  # the collar bones are no longer rigid


def test_wrong_input_is_refused(tmp_path):
    joints = performer(n_frames=2).joints
    several = track_of(joints)
    several = replace(several, joints3d=joints.expand(2, 2, 8, 3))
    with pytest.raises(InputError, match="one sequence"):
        write_bvh(several, tmp_path / "poses.bvh")
    with pytest.raises(InputError, match="finite"):
        write_bvh(track_of(joints * torch.nan), tmp_path / "poses.bvh")
    with pytest.raises(ShapeError):
        joints_to_bvh(joints[:, :5])
    with pytest.raises(OutputError):
        write_bvh(track_of(joints), tmp_path / "nowhere" / "poses.bvh")
    assert list(tmp_path.iterdir()) == []
