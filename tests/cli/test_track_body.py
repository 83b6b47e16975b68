import cv2
import numpy as np
import pytest
import torch

from torchpose.body import BODY_15, Body
from torchpose.body.silhouette import render
from torchpose.body_poses import BodyPoses
from torchpose.camera import PinholeCamera, save_cameras
from torchpose.camera_rig import CameraRig
from torchpose.cli import main
from torchpose.priors import BackConstrainedGPLVM, ManifoldInfo
from torchpose.video import VideoWriter

HEIGHT, WIDTH, N = 120, 160, 8


def looking_at(name, place, target=(0.0, 0.0, 0.9)):
    """A camera at a place that looks at a target, z up."""
    ahead = torch.tensor(target).double() - torch.tensor(place).double()
    ahead = ahead / ahead.norm()
    right = torch.linalg.cross(ahead, torch.tensor([0.0, 0.0, 1.0]).double())
    right = right / right.norm()
    R = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
    rotation = cv2.Rodrigues(R.numpy())[0].ravel()
    translation = -R @ torch.tensor(place).double()
    return PinholeCamera(150, 150, 79.5, 59.5, WIDTH, HEIGHT, name, rotation=rotation.tolist(),
                         translation=translation.tolist())  # fmt: skip


def arms_rise(body):
    """States of somebody who stands, z up, faces +y, and raises both arms a little."""
    states = torch.zeros(N, body.dim, dtype=torch.float64)
    states[:, 2] = 0.95
    turn = cv2.Rodrigues(np.array([np.pi / 2, 0, 0]))[0]  # y up to z up
    turn = cv2.Rodrigues(np.array([0, 0, np.pi]))[0] @ turn
    rotvec = cv2.Rodrigues(turn)[0].ravel()
    angle = np.linalg.norm(rotvec)
    states[:, 3:6] = torch.from_numpy(rotvec / angle * np.sin(angle / 2))
    raised = torch.linspace(0.1, 0.35, N, dtype=torch.float64)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        part = body.skeleton.part(f"{side}_upper_arm")
        states[:, 3 + 3 * part + 2] = sign * raised
    return states


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Videos of three cameras, pictures of the empty scene, and the truth."""
    folder = tmp_path_factory.mktemp("cameras")
    body = Body.of_height(BODY_15, 1.75)
    states = arms_rise(body)
    places = {"front": (0.3, 3.2, 1.2), "left": (-3.0, 0.4, 1.4), "behind": (1.6, -2.7, 1.3)}
    cameras = [looking_at(name, place) for name, place in places.items()]
    save_cameras(cameras, folder / "cameras.toml")
    masks = render(body, states, CameraRig(cameras), HEIGHT, WIDTH)
    rng = np.random.default_rng(0)
    for c, name in enumerate(places):
        coarse = rng.integers(100, 200, (6, 8, 3)).astype(np.uint8)
        empty = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{name}.png"), empty[..., ::-1])
        with VideoWriter(folder / f"{name}.mp4", 60.0, (WIDTH, HEIGHT), crf=8) as writer:
            for mask in masks[:, c].numpy():
                frame = empty.copy()
                frame[mask] = (30, 20, 160)
                writer.write(frame)
    start = BodyPoses(
        body, states[:1], torch.zeros(1, body.dim), body.joints(states[:1]),
        torch.zeros(1, 15, 3, 3), *(torch.zeros(1) for _ in range(2)),
        *(torch.zeros(1, dtype=torch.bool) for _ in range(2)),
    )  # fmt: skip
    start.save(folder / "start.npz")
    return folder, body, states


def arguments(folder, out, *more):
    names = ("front", "left", "behind")
    return [
        "track-body", str(folder / "cameras.toml"), *(str(folder / f"{n}.mp4") for n in names),
        "--background", *(str(folder / f"{n}.png") for n in names),
        "--n-particles", "300", "--rows", "60", "--out", str(out), *more,
    ]  # fmt: skip


def test_poses_from_videos(recorded, tmp_path, capsys):
    folder, body, states = recorded
    given = ["--initial-pose", str(folder / "start.npz"), "--body", str(folder / "start.npz")]
    assert main(arguments(folder, tmp_path / "a", *given)) == 0
    said = capsys.readouterr().out
    assert "apf" in said
    poses = BodyPoses.load(tmp_path / "a" / "body.npz")
    assert len(poses) == N
    assert poses.fps == 60
    errors = (poses.joints3d - body.joints(states)).norm(dim=-1)
    assert float(errors.mean()) < 0.08
    assert bool((torch.linalg.eigvalsh(poses.covariance3d) > -1e-12).all())
    assert not bool(poses.coasting.any())
    rows = (tmp_path / "a" / "joints.csv").read_text().splitlines()
    assert len(rows) == N + 1
    assert rows[0].startswith("frame,pelvis_x,")
    for name in ("overlay_front.mp4", "overlay_left.mp4", "overlay.png", "report.html"):
        assert (tmp_path / "a" / name).stat().st_size > 1000
    picture = cv2.imread(str(tmp_path / "a" / "overlay.png"))
    assert picture.shape[0] == 3 * 324
    again = [*given, "--overlay", "false", "--pictures", "false"]
    assert main(arguments(folder, tmp_path / "b", *again)) == 0
    assert torch.equal(BodyPoses.load(tmp_path / "b" / "body.npz").state, poses.state)


def test_nobody_there_is_said(recorded, tmp_path, capsys):
    folder, _, _ = recorded
    line = arguments(folder, tmp_path)
    line[2:5] = [str(folder / f"{n}.png") for n in ("front", "left", "behind")]
    for i, name in enumerate(("front", "left", "behind")):
        empty = cv2.imread(str(folder / f"{name}.png"))[..., ::-1]
        path = tmp_path / f"{name}-empty.mp4"
        with VideoWriter(path, 60.0, (WIDTH, HEIGHT), crf=8) as writer:
            for _ in range(3):
                writer.write(np.ascontiguousarray(empty))
        line[2 + i] = str(path)
    assert main(line) == 1
    assert "nobody was seen" in capsys.readouterr().err
    assert not (tmp_path / "body.npz").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--method", "mrpf"], "needs --manifold"),
        (["--method", "ekf"], "mrpf, apf, sir"),
        (["--delays", "[1,2]"], "one entry for each"),
        (["--height", "-1"], "--height"),
        (["--camera-names", "[front,left]"], "a camera for each of the 3 videos"),
        (["--facing", "[1,0]"], "three numbers"),
    ],
)
def test_bad_options_are_refused(recorded, tmp_path, capsys, more, said):
    assert main(arguments(recorded[0], tmp_path, *more)) == 2
    assert said in capsys.readouterr().err


def rising_arms_manifold(body, fps=60.0):
    """Of arms that rise and fall, and of others that were not fitted for the noise."""
    phase = torch.linspace(0.1, 6.1, 60, dtype=torch.float64)
    trials = []
    for height in (0.15, 0.13):
        states = arms_rise(body)[:1].expand(60, -1).clone()
        for side, sign in (("left", 1.0), ("right", -1.0)):
            part = body.skeleton.part(f"{side}_upper_arm")
            states[:, 3 + 3 * part + 2] = sign * (0.2 + height * phase.sin())
            states[:, 3 + 3 * part] = 0.1 * phase.cos()
        trials.append(body.relative(states))
    manifold = BackConstrainedGPLVM.fit(trials[0], info=ManifoldInfo.of_body(body, name="arms"))
    return manifold.fit_noise(trials[1], fps)


def test_a_manifold_of_the_motion(recorded, tmp_path, capsys):
    folder, body, states = recorded
    rising_arms_manifold(body).save(tmp_path / "arms.safetensors")
    rising_arms_manifold(body, 30.0).save(tmp_path / "slow.safetensors")
    given = ["--initial-pose", str(folder / "start.npz"), "--body", str(folder / "start.npz"),
             "--overlay", "false", "--pictures", "false", "--manifold"]  # fmt: skip
    out = tmp_path / "out"
    assert main(arguments(folder, out, *given, str(tmp_path / "arms.safetensors"))) == 0
    assert "mrpf" in capsys.readouterr().out
    poses = BodyPoses.load(out / "body.npz")
    errors = (poses.joints3d - body.joints(states)).norm(dim=-1)
    assert float(errors.mean()) < 0.08
    assert main(arguments(folder, out, *given, str(tmp_path / "slow.safetensors"))) == 2
    assert "30 frames per second" in capsys.readouterr().err
