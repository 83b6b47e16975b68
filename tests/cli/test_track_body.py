from contextlib import ExitStack
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchpose.body import BODY_15, Body, fit_state
from torchpose.camera import CameraRig, PinholeCamera, load_cameras, save_cameras
from torchpose.camera._projection import intrinsics
from torchpose.cli import main
from torchpose.cli._body_overlays import draw, project_joints
from torchpose.cli._body_recordings import Recordings
from torchpose.cli._track_body_output import action_text
from torchpose.io import Keypoints, write_keypoints
from torchpose.learning import fit_action_space, fit_gplvm, fit_gplvm_noise, fit_limb_conditionals
from torchpose.priors import ActionBank, ManifoldInfo
from torchpose.priors._actions.postures import state_postures
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.video import VideoWriter, open_video
from torchpose.video._silhouettes import SilhouetteMeasurer, fit_views, read_silhouettes
from torchpose.whole_body import BodyTrack, BodyTracker, render

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
    start = BodyTrack(
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
    poses = BodyTrack.load(tmp_path / "a" / "body.npz")
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
    assert torch.equal(BodyTrack.load(tmp_path / "b" / "body.npz").state, poses.state)


def test_silhouettes_count_beside_keypoints(recorded, tmp_path):
    folder, body, states = recorded
    cameras = list(load_cameras(folder / "cameras.toml").values())
    rig = CameraRig(cameras)
    generator = torch.Generator().manual_seed(0)
    points = rig(body.joints(states)).pixels
    points = points + 0.5 * torch.randn(points.shape, generator=generator, dtype=points.dtype)
    longer = torch.cat([points, points[-1:]])
    for c, name in enumerate(rig.names):
        size = {"fps": 60.0, "image_size": (WIDTH, HEIGHT)}
        write_keypoints(tmp_path / f"{name}.npz", Keypoints(longer[:, c], BODY_15.names, **size))
    given = [
        "track-body", str(folder / "cameras.toml"), *(str(tmp_path / f"{n}.npz") for n in rig.names),
        "--videos", *(str(folder / f"{n}.mp4") for n in rig.names),
        "--method", "sir", "--n-particles", "100", "--seed", "3", "--overlay", "false",
        "--initial-pose", str(folder / "start.npz"), "--body", str(folder / "start.npz"),
    ]  # fmt: skip
    both = ["--silhouettes", "true", "--rows", "60"]
    both += ["--background", *(str(folder / f"{n}.png") for n in rig.names)]
    assert main([*given, "--out", str(tmp_path / "alone")]) == 0
    assert main([*given, *both, "--out", str(tmp_path / "both")]) == 0
    alone, poses = (BodyTrack.load(tmp_path / name / "body.npz") for name in ("alone", "both"))
    assert (len(alone), len(poses)) == (N + 1, N)
    assert any("keypoints have 9 frames and videos 8" in note for note in poses.notes)

    views = fit_views(cameras, [(WIDTH, HEIGHT)] * 3, 60)
    empty = [[cv2.imread(str(folder / f"{name}.png"))[..., ::-1]] for name in rig.names]
    measurers = [SilhouetteMeasurer(*pair) for pair in zip(views, empty, strict=True)]
    with ExitStack() as stack:
        sources = [stack.enter_context(open_video(folder / f"{n}.mp4")) for n in rig.names]
        masks = torch.stack(list(read_silhouettes(sources, measurers)))
    half = (points + 0.5) / 2 - 0.5
    tracker = BodyTracker(
        [view.camera for view in views], "sir", n_particles=100, body=body, fps=60.0, pixel_std=0.5
    )
    expected = tracker(
        masks, fit_state(tracker.body, body.joints(states[:1]))[0], keypoints=half,
        generator=torch.Generator().manual_seed(3),
    )  # fmt: skip
    torch.testing.assert_close(poses.joints3d, expected.joints3d)
    assert float((poses.joints3d - body.joints(states)).norm(dim=-1).mean()) < 0.08


def test_cameras_are_scaled_to_the_videos(recorded):
    folder = recorded[0]
    cameras = load_cameras(folder / "cameras.toml")
    videos = [str(folder / f"{name}.mp4") for name in cameras]
    larger = []
    for name, c in cameras.items():
        fx, fy, _, cx, cy = (2 * float(e) for e in intrinsics(c.matrix))
        pose = {"rotation": c.rotation.tolist(), "translation": c.translation.tolist()}
        size = (2 * WIDTH, 2 * HEIGHT)
        larger.append(PinholeCamera(fx, fy, cx + 0.5, cy + 0.5, *size, name, **pose))
    with Recordings(videos, list(cameras.values()), 60) as same:
        assert same.notes == []
    with Recordings(videos, larger, 60) as scaled:
        assert len(scaled.notes) == 3 and "front is scaled from 320 x 240" in scaled.notes[0]
    with Recordings(videos, larger, 60, fps=30.0) as slower:
        assert slower.notes == scaled.notes
        told = slower.all_notes
        assert len(told) == len(set(told)) and any("to 30 frames per second" in n for n in told)
    for one, other in zip(same.views, scaled.views, strict=True):
        torch.testing.assert_close(one.camera.matrix, other.camera.matrix)
        torch.testing.assert_close(one.source.matrix, other.source.matrix)
        assert one.source.image_size == other.source.image_size == (WIDTH, HEIGHT)


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
    assert (
        "no poses: nobody is seen by all cameras in any frame, and by front, left, behind in none"
        in (capsys.readouterr().err)
    )
    assert not (tmp_path / "body.npz").exists()


def test_a_video_that_ends_before_the_others_is_noted(recorded, tmp_path):
    folder = recorded[0]
    cameras = list(load_cameras(folder / "cameras.toml").values())
    videos = [str(folder / f"{camera.name}.mp4") for camera in cameras]
    with Recordings(videos, cameras, 60, delays=[0, 3, 1]) as late:
        (note,) = late.notes
    assert f"left.mp4 ends after {N - 3} frames and others after up to {N}" in note


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--method", "mrpf"], "needs manifold"),
        (["--method", "ekf"], "mrpf, apf, sir, root, constrained"),
        (["--method", "root"], "method root needs conditionals, limb conditionals"),
        (["--method", "constrained"], "needs action, an action space"),
        (["--method", "sir", "--action", "a"], "leave it out or take method constrained"),
        (["--method", "constrained", "--action", "a", "--conditionals", "b"], "take method root"),
        (["--manifold", "a", "--conditionals", "b"], "choose by method mrpf or root"),
        (["--conditionals", "a", "--sharpness", "9"], "'sharpness' does nothing for method root"),
        (["--conditionals", "walk", "--n-particles", "20"], "at least 21 for method root"),
        (["--n-particles", "19"], "at least 20 for method apf"),
        (["--conditionals", "nowhere.safetensors"], "nowhere.safetensors: no such file"),
        (["--action", "nowhere.safetensors"], "nowhere.safetensors: no such file"),
        (["--delays", "[1,2]"], "one for each camera, got 2"),
        (["--height", "-1"], "--height"),
        (["--height", "182"], "--height must lie between 0.5 and 2.6 m"),
        (["--camera-names", "[front,left]"], "a camera for each of the 3 inputs"),
        (["--facing", "[1,0]"], "three numbers"),
        (["--facing", "left"], "--facing must be three numbers, such as 1,0,0, got 'left'"),
        (["--facing", "[1,0,0]", "--initial-pose", "a.npz"], "does nothing with --initial-pose"),
        (["--sharpness", "9"], "does nothing for --method apf on silhouettes alone"),
        (["--delays", "[0,0,8]"], "got 8 for"),
        (["--delays", "[-1,0,0]"], "got -1 for"),
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
    manifold = fit_gplvm(trials[0], info=ManifoldInfo.of_body(body, name="arms"))
    return fit_gplvm_noise(manifold, trials[1], fps)


def test_a_manifold_of_the_motion(recorded, tmp_path, capsys):
    folder, body, states = recorded
    rising_arms_manifold(body).save(tmp_path / "arms.safetensors")
    rising_arms_manifold(body, 30.0).save(tmp_path / "slow.safetensors")
    given = ["--initial-pose", str(folder / "start.npz"), "--body", str(folder / "start.npz"),
             "--overlay", "false", "--pictures", "false", "--manifold"]  # fmt: skip
    out = tmp_path / "out"
    assert main(arguments(folder, out, *given, str(tmp_path / "arms.safetensors"))) == 0
    assert "mrpf" in capsys.readouterr().out
    poses = BodyTrack.load(out / "body.npz")
    errors = (poses.joints3d - body.joints(states)).norm(dim=-1)
    assert float(errors.mean()) < 0.08
    assert main(arguments(folder, out, *given, str(tmp_path / "slow.safetensors"))) == 0
    assert "noise was learnt at 30 frames per second and rescaled to 60" in capsys.readouterr().out
    old = rising_arms_manifold(body, 30.0)
    old.info = replace(old.info, extra={})  # as files from before say nothing about growth
    old.save(tmp_path / "old.safetensors")
    assert main(arguments(folder, out, *given, str(tmp_path / "old.safetensors"))) == 2
    assert "30 frames per second" in capsys.readouterr().err


def limbs_of_rising_arms(body, fps=60.0):
    """Conditionals of arms that rise faster or slower, with legs that move a little."""
    g = torch.Generator().manual_seed(0)
    recorded = []
    for pace in (1.0, 0.7):
        states = arms_rise(body)
        states[:, 6:] = pace * states[:, 6:] + 0.05 * torch.randn(
            N, body.dim - 6, generator=g, dtype=torch.float64
        )
        recorded.append(states)
    body, states = in_body_frame([(body, recorded)])
    return fit_limb_conditionals(body, states, fps, name="arms")


def bank_of_arms(body):
    """Arms that rise, and arms that swing forwards."""
    spaces = []
    for name, column, sway in (("rise", 2, 6), ("swing", 0, 7)):
        performances = []
        for person in range(4):
            phase = torch.linspace(0, np.pi, 30, dtype=torch.float64).sin()
            states = arms_rise(body)[:1].expand(30, -1).clone()
            states[:, sway] = 0.02 * (-1) ** person * phase.square()
            for side, sign in (("left", 1.0), ("right", -1.0)):
                part = 3 + 3 * body.skeleton.part(f"{side}_upper_arm")
                states[:, part : part + 3] = 0.0
                states[:, part + column] = (sign if column == 2 else -1.0) * (
                    0.05 + (0.4 + 0.02 * person) * phase
                )
            performances.append(state_postures(body, states))
        spaces.append(fit_action_space(performances, 2, name=name, fps=30.0))
    return ActionBank(spaces)


def cameras_of(recorded):
    return load_cameras(recorded[0] / "cameras.toml")


@pytest.mark.parametrize("fps", [60.0, 30.0, 20.0, 15.0])
@pytest.mark.parametrize("n_particles", [21, 140, 800])
def test_several_hypotheses_survive_a_frame_at_any_rate(recorded, fps, n_particles):
    body = recorded[1]
    filter_ = BodyTracker(
        cameras_of(recorded), body=body, conditionals=limbs_of_rising_arms(body, 30.0),
        n_particles=n_particles, fps=fps,
    ).filter  # fmt: skip
    assert filter_.n_particles == n_particles // 7
    assert filter_.survival_rate * filter_.n_particles >= 2 - 1e-9


def test_hypotheses_of_the_root(recorded, tmp_path, capsys):
    folder, body, states = recorded
    conditionals = limbs_of_rising_arms(body, 30.0)
    conditionals.save(tmp_path / "limbs.safetensors")
    given = ["--initial-pose", str(folder / "start.npz"), "--body", str(folder / "start.npz"),
             "--overlay", "false", "--n-particles", "140",
             "--conditionals", str(tmp_path / "limbs.safetensors")]  # fmt: skip
    assert main(arguments(folder, tmp_path / "out", *given)) == 0
    said = capsys.readouterr().out
    assert "root, 140 particles\n" in said
    assert "learnt at 30 frames per second and rescaled to 60" in said
    poses = BodyTrack.load(tmp_path / "out" / "body.npz")
    assert poses.body.frame == "body"
    assert torch.equal(poses.body.centres, conditionals.centres)
    torch.testing.assert_close(poses.body.joints(poses.state), poses.joints3d)
    errors = (poses.joints3d - body.joints(states)).norm(dim=-1)
    assert float(errors.mean()) < 0.08
    assert poses.notes[-1].endswith("rescaled to 60")
    assert (tmp_path / "out" / "overlay.png").exists()
    # a person whose body is in this frame is tracked by others in theirs
    plain = BodyTracker(cameras_of(recorded), body=tmp_path / "out" / "body.npz")
    assert plain.body.frame == "parent"
    assert not bool(plain.body.centres.any())


def test_the_constraint_of_actions_is_reported(recorded, tmp_path, capsys):
    folder, body, states = recorded
    bank_of_arms(body).save(tmp_path / "arms.safetensors")
    given = ["--initial-pose", str(folder / "start.npz"), "--body", str(folder / "start.npz"),
             "--overlay", "false", "--pictures", "false", "--action",
             str(tmp_path / "arms.safetensors")]  # fmt: skip
    assert main(arguments(folder, tmp_path / "out", *given)) == 0
    said = capsys.readouterr().out
    assert "constrained, 300 particles, sharpness 30" in said
    assert "rescaled to 60" in said and "of the first draws through" in said
    poses = BodyTrack.load(tmp_path / "out" / "body.npz")
    assert poses.body.frame == "parent"
    assert poses.action_names == ("rise", "swing", "none")
    assert poses.details["actions"].shape == (N, 3)
    torch.testing.assert_close(poses.details["actions"].sum(-1), torch.ones(N).double())
    assert {"acceptance", "clamped", "released"} <= poses.details.keys()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "first draws" in page
    errors = (poses.joints3d - body.joints(states)).norm(dim=-1)
    assert float(errors.mean()) < 0.08


def test_the_likeliest_actions_are_told_by_frames():
    states, T = torch.zeros(6, 36).double(), 6
    poses = BodyTrack(
        Body.of_height(BODY_15, 1.7), states, states, *(torch.zeros(T) for _ in range(6)),
        first_frame=10, action_names=("bend", "wave", "none"),
        details={"actions": torch.eye(3).double()[[0, 0, 1, 1, 1, 2]]},
    )  # fmt: skip
    assert action_text(poses) == "bend 10-11, wave 12-14, none 15-15"
    poses.details["actions"] = torch.eye(3).double()[[0, 1] * 5]
    assert action_text(poses).startswith("bend 50 % of the frames, wave 50 %")
    poses.details.clear()
    assert action_text(poses) == ""


def test_files_of_something_else_are_refused(recorded, tmp_path, capsys):
    folder, body, _ = recorded
    limbs, arms = limbs_of_rising_arms(body), tmp_path / "arms.safetensors"
    bank_of_arms(body).save(arms)
    assert main(arguments(folder, tmp_path, "--conditionals", str(arms))) == 2
    assert "torchpose-limb-conditionals" in capsys.readouterr().err
    limbs.info = replace(limbs.info, parts=("root", *limbs.info.parts[1:]))
    limbs.save(tmp_path / "limbs.safetensors")
    assert (
        main(arguments(folder, tmp_path, "--conditionals", str(tmp_path / "limbs.safetensors")))
        == 2
    )
    assert "expected limb conditionals of the parts pelvis" in capsys.readouterr().err
    assert main(arguments(folder, tmp_path, "--action", str(tmp_path / "limbs.safetensors"))) == 2
    assert "torchpose-action-space" in capsys.readouterr().err


# --- what is drawn ----------------------------------------------------------------------------------


@pytest.mark.parametrize("fisheye", [False, True])
def test_joints_are_drawn_where_the_lens_puts_them(fisheye):
    values = (0.1, -0.03, 0.01, 0.002) if fisheye else (-0.2, 0.05, 0.003, -0.002, 0.01, 0.02)
    points = torch.tensor([[0.3, -0.2, 1.0], [-0.4, 0.1, 2.0], [0.0, 0.2, -1.0]]).double()
    for length in range(len(values) + 1):
        camera = PinholeCamera(
            500, 510, 320, 240, 640, 480, skew=3.0, rotation=(0.1, 0.2, 0.3),
            translation=(0.1, 0.0, 0.5), distortions=values[:length], fisheye=fisheye,
        )  # fmt: skip
        found, straight = project_joints(points, camera), camera(points)[:2, :2]
        assert found[2].isnan().all()  # behind the camera
        again = CameraRig([camera]).undistort_points(found[None])[0]
        torch.testing.assert_close(again[:2], straight, rtol=0, atol=1e-4)
        moved = (found[:2] - straight).norm(dim=-1)
        assert bool(moved.max() > 1) == (length > 0 or fisheye)


@pytest.mark.parametrize("distortions", [(-0.3,), (-0.25, 0.05, 0, 0, -0.005)])
def test_joints_beside_the_image_are_not_folded_into_it(distortions):
    camera = PinholeCamera(900, 900, 959.5, 539.5, 1920, 1080, distortions=distortions)
    aside = torch.linspace(0.0, 6.0, 121).double()
    level = torch.zeros_like(aside)
    u = project_joints(torch.stack([aside, level, level + 1], -1), camera)[:, 0]
    there = int(u.isfinite().sum())
    assert aside[there] > 0.8 and u[there:].isnan().all()  # where the lens still tells them apart
    assert (u[:there].diff() > 0).all()


class Films:
    """Black videos of ten frames."""

    fps, read = 30.0, 0

    def __init__(self, *names):
        self.names, self.sizes = list(names), [(480, 320)] * len(names)

    def images(self):
        for _ in range(10):
            self.read += 1
            yield tuple(np.zeros((320, 480, 3), np.uint8) for _ in self.names)

    def drawn(self, people, t, images):
        return list(images)


class Poses:
    """Those of frames 2, 3 and 4."""

    first_frame = 2

    def __len__(self):
        return 3


def test_videos_are_not_read_past_the_last_pose(tmp_path):
    films = Films("a")
    assert draw(films, [Poses()], tmp_path, videos=False, picture=True)
    assert films.read == 6


def test_the_picture_of_several_cameras_names_them(tmp_path):
    def parts(*names):
        (path,), _ = draw(Films(*names), [Poses()], tmp_path, videos=False, picture=True)
        picture = cv2.imread(str(path))
        assert not picture[:, 480:].any(), "once for each camera"
        return picture[:320], picture[324:]

    first, second = parts("front", "left wall")
    assert first[:40].any() and second[:40].any() and not first[40:].any()
    ink = [int(np.flatnonzero(part.any((0, 2)))[-1]) for part in (first, second)]
    assert ink[0] < ink[1], "a longer name is wider"
    assert not parts("front")[0].any(), "one camera needs no name"
