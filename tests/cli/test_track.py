"""`torchpose track`: files, options, cameras, and what it refuses."""

import csv
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.cli.conftest import GAP, N_FRAMES, keypoints
from torchpose.camera import PinholeCamera, save_cameras
from torchpose.cli import _track_output as track_output
from torchpose.io import read_keypoints, write_keypoints
from torchpose.priors import load_prior
from torchpose.skeleton import SKELETONS, UPPER_BODY
from torchpose.upper_body import METHODS, PoseTrack, UpperBodyTracker

SMALL = "kinect-upper-body-small"  # a prior with windows
KEYS = ("joints2d", "joints3d", "covariance3d", "observed", "log_evidence")


@pytest.fixture
def track(torchpose, files, tmp_path):
    """track(*options) -> Result, PoseTrack; without pictures, into tmp_path / "out"."""

    def run(*options, clip=files / "keypoints.npz"):
        out = tmp_path / "out"
        base = ("--out", out, "--prior", files / "prior.safetensors", "--pictures", "false")
        done = torchpose("track", clip, *base, *options)
        assert done.code == 0, done.err
        return done, PoseTrack.load(out / "poses.npz")

    return run


def expected(files, clip=None, camera=None, **options) -> PoseTrack:
    """The same by the library."""
    clip = clip or read_keypoints(files / "keypoints.npz")
    camera = camera or PinholeCamera.from_matrix(clip.K)
    prior = options.pop("prior", None) or load_prior(files / "prior.safetensors")
    tracker = UpperBodyTracker(prior, camera, fps=30.0, **options)
    generator = torch.Generator().manual_seed(0)
    return tracker(clip.keypoints[None], clip.confidence, clip.names, generator=generator)


def same(one: PoseTrack, other: PoseTrack) -> None:
    for key in KEYS:
        a, b = getattr(one, key), getattr(other, key)
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12, equal_nan=True)


# --- files ----------------------------------------------------------------------------------------


def test_poses_are_those_of_the_library(track, files, tmp_path):
    done, poses = track()
    same(poses, expected(files))
    with np.load(tmp_path / "out" / "poses.npz") as stored:
        arrays = dict(stored)
    shapes = {"joints2d": (8, 2), "joints3d": (8, 3), "covariance3d": (8, 3, 3), "observed": (8,)}
    for key, shape in shapes.items():
        assert arrays[key].shape == (N_FRAMES, *shape)
    assert arrays["log_evidence"].shape == (N_FRAMES,)
    assert tuple(arrays["names"]) == UPPER_BODY
    assert float(arrays["fps"]) == 30
    hand = UPPER_BODY.index("hand_right")
    assert np.flatnonzero(~arrays["observed"][:, hand]).tolist() == list(range(N_FRAMES))[GAP]
    assert "frames   24 (0.8 s at 30 fps)" in done.out
    assert "hand_right 87.5 %" in done.out
    assert "inferred elbow_left" in done.out


def test_table_holds_the_same(track, tmp_path):
    _, poses = track()
    lines = (tmp_path / "out" / "poses.csv").read_text().splitlines()
    assert lines[0].startswith("# ") and "camera axes" in lines[0]
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    assert [int(r["frame"]) for r in rows] == list(range(N_FRAMES))
    assert float(rows[15]["time"]) == 0.5
    std = poses.covariance3d[0].diagonal(dim1=-2, dim2=-1).sqrt()
    columns = {
        "x2d": poses.joints2d[0, ..., 0], "y2d": poses.joints2d[0, ..., 1],
        "x": poses.joints3d[0, ..., 0], "y": poses.joints3d[0, ..., 1],
        "z": poses.joints3d[0, ..., 2], "std_x": std[..., 0], "std_y": std[..., 1],
        "std_z": std[..., 2], "observed": poses.observed[0].double(),
    }  # fmt: skip
    for suffix, values in columns.items():
        for j, name in enumerate(UPPER_BODY):
            read = np.array([float(r[f"{name}_{suffix}"]) for r in rows])
            atol = 6e-4 if suffix in ("x2d", "y2d") else 6e-7
            np.testing.assert_allclose(read, values[:, j], rtol=0, atol=atol)
    assert len(rows[0]) == 2 + 8 * len(columns) + 1
    read = [float(r["log_evidence"]) for r in rows]
    np.testing.assert_allclose(read, poses.log_evidence[0].sum(-1), atol=6e-7)


def test_a_tilt_is_told_by_degrees_a_file_or_the_axis_that_points_up(track, files, tmp_path):
    clip = read_keypoints(files / "keypoints.npz")
    camera = PinholeCamera.from_matrix(clip.K)
    tilted = camera.tilted(math.radians(-15), math.radians(4))
    done, poses = track("--tilt=-15", "--roll", "4")
    assert "looking down by 15 degrees and rolled by 4 degrees" in done.out
    wanted = expected(files, camera=tilted)
    same(poses, wanted)
    torch.testing.assert_close(poses.up, tilted.up)
    save_cameras([tilted], tmp_path / "up.toml")
    same(track("--camera", tmp_path / "up.toml")[1], wanted)
    fx, fy, cx, cy = (float(clip.K[row]) for row in ((0, 0), (1, 1), (0, 2), (1, 2)))
    forward = (math.pi / 2 + 0.2, 0.0, 0.0)  # in a world with z up: along y, and down by 0.2
    save_cameras([PinholeCamera(fx, fy, cx, cy, rotation=forward)], tmp_path / "rig.toml")
    _, poses = track("--camera", tmp_path / "rig.toml", "--up", "z")
    torch.testing.assert_close(poses.joints3d, expected(files, camera=camera.tilted(-0.2)).joints3d)


def test_pictures(torchpose, files, tmp_path):
    pytest.importorskip("matplotlib")
    prior = files / "prior.safetensors"
    done = torchpose("track", files / "keypoints.npz", "--out", tmp_path, "--prior", prior)
    assert done.code == 0, done.err
    for name in ("pose_strip.png", "joint_curves.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        assert f"wrote    {tmp_path / name}" in done.out
    assert {p.name for p in tmp_path.iterdir()} == {
        "poses.npz", "poses.csv", "poses.bvh", "pose_strip.png", "joint_curves.png",
        ".torchpose-track.json",
    }  # fmt: skip


def test_pictures_have_the_times_of_the_recording(files):
    pytest.importorskip("matplotlib")
    from torchpose.cli._track_output import track_pictures

    late = replace(expected(files), first_frame=45)
    figures = {name: draw() for name, draw in track_pictures(late).items()}
    second = 45 / late.fps
    side, first, *_ = figures["pose_strip.png"].axes[0].texts
    assert (side.get_text(), first.get_text()) == ("front", f"{second:.1f} s")
    assert figures["joint_curves.png"].axes[0].get_lines()[0].get_xdata()[0] == second


def test_without_matplotlib_it_says_how_to_get_pictures(torchpose, files, tmp_path, monkeypatch):
    monkeypatch.setattr("torchpose.cli._common.find_spec", lambda name: None)
    prior = files / "prior.safetensors"
    done = torchpose("track", files / "keypoints.npz", "--out", tmp_path, "--prior", prior)
    assert done.code == 0
    assert "pip install matplotlib" in done.out
    assert not list(tmp_path.glob("*.png"))


# --- options --------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_methods(track, files, method):
    options = ("--n-particles", 50) if method.startswith("pf-") else ()
    more = {"n_particles": 50} if options else {}
    if method in ("window-mixture", "multiple-model"):
        options, more = ("--prior", SMALL), {"prior": load_prior(SMALL)}
    done, poses = track("--method", method, *options)
    same(poses, expected(files, method=method, **more))
    assert poses.method == method and f"method   {method}, filtered" in done.out


def test_options_reach_the_tracker(track, files):
    stds = (5.0, 6.0, 6.0, 2.0, 3.0)
    text = ",".join(str(s) for s in stds)
    same(
        track("--smoothing", "full", "--frame", "body", "--measurement-std", text)[1],
        expected(files, smoothing="full", frame="body", measurement_std=stds),
    )
    same(track("--smoothing", 3)[1], expected(files, smoothing=3))
    for none in (0, "none"):
        done, poses = track("--prior", SMALL, "--smoothing", none)
        assert "method   multiple-model, filtered" in done.out
        same(poses, expected(files, prior=load_prior(SMALL)))
    windows = load_prior(SMALL)  # others have nothing that is steady
    same(
        track("--prior", SMALL, "--steady", "false")[1],
        expected(files, prior=windows, steady=False),
    )
    given, lengths = "upper_arm=0.3,forearm=0.25", {"upper_arm": 0.3, "forearm": 0.25}
    same(
        track("--method", "articulated", "--bone-lengths", given)[1],
        expected(files, method="articulated", bone_lengths=lengths),
    )
    same(track("--height", 1.6)[1], expected(files, height=1.6))
    same(track("--static-camera", "true")[1], expected(files, static_camera=True))


def test_the_summary_says_what_ran_where_no_method_was_given(track):
    done, poses = track("--prior", SMALL)
    assert poses.method == "multiple-model" and "method   multiple-model, filtered" in done.out
    done, poses = track()
    assert poses.method == "mkf-fixed" and "method   mkf-fixed, filtered" in done.out
    assert "note" not in done.out
    done, poses = track("--prior", SMALL, "--smoothing", 2)
    assert poses.method == "mkf-fixed" and "method   mkf-fixed, smoothed with 2" in done.out
    assert "note     single poses are tracked (mkf-fixed), since the prior's windows" in done.out


@pytest.mark.parametrize("method", ["mkf-fixed", "mkf-split"])
@pytest.mark.parametrize("window", ["true", "false"])
def test_config_files_of_older_releases_mean_what_they_meant(
    torchpose, files, tmp_path, method, window
):
    (tmp_path / "older.yaml").write_text(f"method: {method}\nwindow: {window}\nsteady: true\n")
    line = (files / "keypoints.npz", "--out", tmp_path, "--prior", SMALL)
    done = torchpose("track", *line, "--pictures", "false", "--config", tmp_path / "older.yaml")
    assert done.code == 0 and "--window is deprecated" in done.err
    windows = method == "mkf-fixed" and window == "true"
    same(
        PoseTrack.load(tmp_path / "poses.npz"),
        expected(files, prior=load_prior(SMALL), method="window-mixture" if windows else method),
    )


def test_another_neck_is_not_measured(track):
    done, poses = track("--neck", "low-neck")
    assert not poses.observed[..., UPPER_BODY.index("neck")].any()
    assert "note     the keypoints' neck (low-neck) is not the prior's (neck): not" in done.out
    done, poses = track("--neck", "mid-shoulder")
    assert poses.observed[..., UPPER_BODY.index("neck")].any()
    assert "note     the keypoints' neck (mid-shoulder) is not the prior's (neck): put" in done.out


def test_nose_as_head(track, tmp_path):
    path = tmp_path / "nose.npz"
    write_keypoints(path, keypoints(names=("nose", "neck", "lwrist", "rwrist")))
    done, poses = track(clip=path)
    assert not poses.observed[..., UPPER_BODY.index("head")].any()
    assert "note     there is no head among the keypoints; --nose-as-head" in done.out
    done, poses = track("--nose-as-head", "true", clip=path)
    assert poses.observed[..., UPPER_BODY.index("head")].all()
    assert "note     the nose stands for the head" in done.out
    assert any("nose" in note for note in poses.notes)


def test_frame_rate(track, tmp_path, files):
    clip = keypoints(fps=None)
    write_keypoints(tmp_path / "clip.npz", clip)
    done, poses = track(clip=tmp_path / "clip.npz")
    assert "note     the keypoint file states no frame rate: 30 fps assumed" in done.out
    same(poses, expected(files))
    done, poses = track("--fps", 15, clip=tmp_path / "clip.npz")
    assert poses.fps == 15 and "note" not in done.out
    done, poses = track("--fps", 15)
    assert (
        poses.fps == 15 and "note     keypoints of 30 fps are taken at the given 15 fps" in done.out
    )
    assert "note" not in track("--fps", 30)[0].out


# --- cameras --------------------------------------------------------------------------------------


def test_camera_comes_from_the_first_source_that_has_one(track, files, tmp_path):
    other = PinholeCamera(600, 610, 330, 250, name="other")
    wanted = expected(files, camera=other)
    same(track("--camera", "600,610,330,250")[1], wanted)
    other.save(tmp_path / "camera.toml")
    same(track("--camera", tmp_path / "camera.toml")[1], wanted)
    save_cameras([other, PinholeCamera(1, 1, 0, 0, name="x")], tmp_path / "two.toml")
    same(track("--camera", tmp_path / "two.toml", "--camera-name", "other")[1], wanted)

    clip = keypoints(K=None, image_size=(1280, 960))
    write_keypoints(tmp_path / "guess.npz", clip)
    done, poses = track(clip=tmp_path / "guess.npz")
    same(poses, expected(files, clip, PinholeCamera.from_image_size(1280, 960)))
    assert "1050 pixels (525/640 of the longer side of the image) was assumed" in done.out
    assert any("was assumed" in note for note in poses.notes)


def test_a_camera_is_scaled_to_the_images(track, tmp_path):
    PinholeCamera(1050, 1050, 639.5, 479.5, 1280, 960).save(tmp_path / "large.toml")
    done, poses = track("--camera", tmp_path / "large.toml")
    assert "scaled from 1280 x 960 pixels to the 640 x 480 pixels of" in done.out
    torch.testing.assert_close(poses.matrix[0], torch.tensor([525.0, 0.0, 319.5]).to(poses.matrix))


def test_distortions_are_not_applied_silently(track, tmp_path):
    PinholeCamera(525, 525, 319.5, 239.5, distortions=(0.1, 0, 0, 0)).save(tmp_path / "c.toml")
    assert "distortions are not applied" in track("--camera", tmp_path / "c.toml")[0].out


# --- config ---------------------------------------------------------------------------------------


def test_config_file_round_trip(torchpose, files, tmp_path):
    out, prior = tmp_path / "out", files / "prior.safetensors"
    line = ("track", files / "keypoints.npz", "--out", out, "--prior", prior, "--smoothing", "5",
            "--measurement-std", "5,6,6,2,3", "--pictures", "false")  # fmt: skip
    printed = torchpose(*line, "--print_config")
    assert printed.code == 0 and not out.exists()
    (tmp_path / "track.yaml").write_text(printed.out)
    assert torchpose(*line).code == 0
    first = PoseTrack.load(out / "poses.npz")
    (out / "poses.npz").unlink()
    assert torchpose("track", "--config", tmp_path / "track.yaml").code == 0
    same(PoseTrack.load(out / "poses.npz"), first)
    changed = torchpose(
        "track", "--config", tmp_path / "track.yaml", "--smoothing", "full", "--out", tmp_path / "b"
    )
    assert changed.code == 0 and (tmp_path / "b" / "poses.npz").exists()
    same(
        PoseTrack.load(tmp_path / "b" / "poses.npz"),
        expected(files, smoothing="full", measurement_std=(5.0, 6.0, 6.0, 2.0, 3.0)),
    )


def test_smoothing_of_a_config_can_be_taken_back(track, files, tmp_path):
    (tmp_path / "smooth.yaml").write_text("smoothing: full\n")
    same(track("--config", tmp_path / "smooth.yaml", "--smoothing", "none")[1], expected(files))


def test_help_lists_every_method(torchpose):
    text = "".join(torchpose("track", "--help").out.split())
    assert all(method in text for method in METHODS)


# --- doubts ---------------------------------------------------------------------------------------


def test_keypoints_that_count_upwards_are_noted(track, files, tmp_path):
    clip = keypoints()
    clip.keypoints[..., 1] = 480 - clip.keypoints[..., 1]
    shoulders = clip.keypoints[:, :2] + torch.tensor([[-40.0, -30.0], [40.0, -90.0]])
    names = (*clip.names, "shoulder_left", "shoulder_right")
    more = torch.cat([clip.keypoints, shoulders], 1)
    write_keypoints(tmp_path / "up.npz", replace(clip, keypoints=more, names=names))
    assert "rows of pixels count downwards" in track(clip=tmp_path / "up.npz")[0].out
    assert "downwards" not in track()[0].out


def test_guesses_outside_of_the_image_are_no_other_image(track, tmp_path):
    clip = keypoints()
    below = clip.keypoints[:, :1] + torch.tensor([0.0, 600.0])
    guessed = below.expand(-1, 6, -1)
    names = ("hip_left", "hip_right", "knee_left", "knee_right", "ankle_left", "ankle_right")
    sure = torch.cat([torch.ones(N_FRAMES, 4), torch.full((N_FRAMES, 6), 0.1)], 1)
    more = torch.cat([clip.keypoints, guessed], 1)
    clip = replace(clip, keypoints=more, names=(*clip.names, *names), confidence=sure.double())
    write_keypoints(tmp_path / "near.npz", clip)
    assert bool(track(clip=tmp_path / "near.npz")[1].observed.any())


def test_several_people_and_numbers_of_files_are_noted(track, files, tmp_path):
    clip = keypoints()
    rows = clip.keypoints.nan_to_num(0)
    for t, points in enumerate(rows):
        table = torch.zeros(18, 3)
        for joint, name in (("Neck", "neck"), ("LWrist", "hand_left"), ("RWrist", "hand_right")):
            at = SKELETONS["openpose-18"].joints.index(joint)
            table[at, :2], table[at, 2] = points[clip.names.index(name)], 0.9
        people = [{"pose_keypoints_2d": table.flatten().tolist()}] * (2 if t == 7 else 1)
        (tmp_path / f"clip_{100 + t:06d}_keypoints.json").write_text(json.dumps({"people": people}))
    done, _ = track("--camera", "525,525,319.5,239.5", "--neck", "neck", clip=tmp_path)
    assert "one of kind neck, as --neck says, and not mid-shoulder, as the joint set" in done.out
    assert "several people, up to 2, from frame 7 on" in done.out
    assert "frame 0 is number 100" in done.out


def test_keypoints_of_no_body_have_no_poses(track, capsys):
    poses = track()[1]
    assert track_output.report_failure(poses) == 0
    nothing = replace(poses, observed=torch.zeros_like(poses.observed))
    assert track_output.report_failure(nothing) == 1
    assert "every keypoint was rejected as an outlier" in capsys.readouterr().err


# --- refusals -------------------------------------------------------------------------------------

PRIOR, CLIP = "{files}/prior.safetensors", "{files}/keypoints.npz"
BAD_INPUT = {
    "no keypoints": ([], "missing: INPUT"),
    "missing file": (["{tmp}/no.npz"], "no.npz: no such file"),
    "truncated": (["{tmp}/truncated.npz"], "expected an .npz file"),
    "foreign keys": (["{files}/recordings/p1.npz"], "expected the key keypoints"),
    "other suffix": (["{tmp}/notes.txt"], "expected keypoints as .npz, .csv or a folder"),
    "other program": (["{tmp}/dlc.h5"], "got .h5; write those of other programs as a .csv"),
    "unknown names": (["{tmp}/names.npz"], "antenna"),
    "no upper body": (["{tmp}/knees.npz"], "expected some of hand_left"),
    "no camera": (["{tmp}/no_camera.npz"], "expected --camera FILE"),
    "long gap": (["{tmp}/gap.npz"], "longer than max_gap"),
    "no name of a folder": ([CLIP, "--out", ""], "expected a folder for the results"),
    "unwritable": ([CLIP, "--out", "{tmp}/notes.txt/below"], "cannot be written to this folder"),
    "no such prior": ([CLIP, "--prior", "nobody"], "expected the name of a prior"),
    "foreign prior": ([CLIP, "--prior", CLIP], "expected a prior as safetensors"),
    "unknown method": ([CLIP, "--method", "kf"], ", ".join(METHODS)),
    "method has no particles": ([CLIP, "--n-particles", "9"], "needs --method, one of pf"),
    "no particles": ([CLIP, "--method", "pf-walk", "--n-particles", "0"], "at least 1"),
    "option of another method": ([CLIP, "--method", "mkf-fixed", "--steady", "true"], "steady"),
    "tracks of the default": ([CLIP, "--n-tracks", "9"], "one of mkf-sampled, mkf-split"),
    "tracks of another": (
        [CLIP, "--method", "mkf-fixed", "--n-tracks", "9"],
        "does not apply to --method mkf-fixed; it is of mkf-sampled",
    ),
    "smoothing of particles": ([CLIP, "--method", "pf-walk", "--smoothing", "3"], "mkf-fixed"),
    "bad smoothing": ([CLIP, "--smoothing", "half"], "a number of frames, 'full' or 'none'"),
    "negative smoothing": ([CLIP, "--smoothing", "-1"], "a number of frames, 'full' or"),
    "bad std": ([CLIP, "--measurement-std", "wide"], "a number or five"),
    "four stds": ([CLIP, "--measurement-std", "1,2,3,4"], "one number or five"),
    "bad lengths": ([CLIP, "--bone-lengths", "long"], "must be NAME=METRES with commas"),
    "lengths of single poses": (
        [CLIP, "--method", "mkf-fixed", "--bone-lengths", "forearm=0.2"],
        "it is of articulated",
    ),
    "a length twice": ([CLIP, "--bone-lengths", "forearm=0.2,forearm=0.3"], "each length once"),
    "a height beside lengths": (
        [CLIP, "--height", "1.6", "--bone-lengths", "forearm=0.2"],
        "bone_lengths and height each tell how large",
    ),
    "a height in feet": ([CLIP, "--height", "5.7"], "it is in metres"),
    "nobody's poses": ([CLIP, "--person", "{tmp}/none.npz"], "no such file"),
    "negative std": ([CLIP, "--measurement-std=-2"], "must be positive"),
    "three numbers": ([CLIP, "--camera", "1,2,3"], "fx,fy,cx,cy"),
    "no focal length": ([CLIP, "--camera", "0,0,320,240"], "positive focal lengths"),
    "a camera in millimetres": ([CLIP, "--camera", "4.2,4.2,3,2"], "a camera must be in pixels"),
    "no camera file": ([CLIP, "--camera", "{tmp}/no.toml"], "no such file"),
    "camera of other images": ([CLIP, "--camera", "{tmp}/wide.toml"], "640 x 360"),
    "a tilt of a camera overhead": ([CLIP, "--tilt=-80"], "looks down by 80 degrees"),
    "a tilt and an axis": ([CLIP, "--tilt", "5", "--up", "z"], "give one of them"),
    "an axis alone": ([CLIP, "--up", "z"], "needs --camera FILE"),
    "a camera's name alone": (
        [CLIP, "--camera-name", "left"],
        "one of several cameras of --camera",
    ),
    "keypoints of another size": (["{tmp}/large.npz"], "lie outside the image of 640 x 480"),
    "confidence of a detector": ([CLIP, "--min-confidence", "0.5"], "is for videos"),
    "detector of keypoints": ([CLIP, "--detector", "no.onnx"], "is for videos"),
    "no overlay of keypoints": ([CLIP, "--overlay", "false"], "is for videos"),
    "unknown frame": ([CLIP, "--frame", "world"], "'camera' or 'body'"),
    "unknown neck": ([CLIP, "--neck", "long"], "mid-shoulder"),
    "no nose": (["{tmp}/no_head.npz", "--nose-as-head", "true"], "needs a nose"),
    "bad fps": ([CLIP, "--fps", "0"], "--fps must be positive"),
    "bad number": ([CLIP, "--seed", "one"], "--seed must be a whole number"),
    "bad flag": ([CLIP, "--pictures", "maybe"], "argument --pictures"),
    "unknown option": ([CLIP, "--speed", "9"], "--speed"),
    "no config": ([CLIP, "--config", "{tmp}/no.yaml"], "no.yaml"),
    "bad config": ([CLIP, "--config", "{tmp}/bad.yaml"], "parsing"),
    "unknown key in config": ([CLIP, "--config", "{tmp}/key.yaml"], "'speed'"),
}


@pytest.fixture
def bad_files(tmp_path, files):
    (tmp_path / "notes.txt").write_text("no keypoints")
    (tmp_path / "dlc.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))  # video to FFmpeg
    (tmp_path / "bad.yaml").write_text("{out: [")
    (tmp_path / "key.yaml").write_text("speed: 9\n")
    whole = (files / "keypoints.npz").read_bytes()
    (tmp_path / "truncated.npz").write_bytes(whole[: len(whole) // 2])
    large = keypoints()
    large.keypoints[..., 0] += 500
    write_keypoints(tmp_path / "large.npz", large)
    write_keypoints(tmp_path / "no_camera.npz", keypoints(K=None, image_size=None))
    knees = ("knee_left", "knee_right", "ankle_left", "ankle_right")
    write_keypoints(tmp_path / "knees.npz", keypoints(names=knees))
    write_keypoints(
        tmp_path / "names.npz", keypoints(names=("head", "neck", "antenna", "hand_left"))
    )
    gap = keypoints(fps=3.0)
    gap.keypoints[2:22] = torch.nan
    write_keypoints(tmp_path / "gap.npz", gap)
    headless = keypoints(names=("neck", "elbow_left", "hand_left", "hand_right"))
    write_keypoints(tmp_path / "no_head.npz", headless)
    PinholeCamera(500, 500, 320, 180, 640, 360).save(tmp_path / "wide.toml")
    return {"tmp": tmp_path, "files": files}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_refusals(case, torchpose, bad_files, tmp_path):
    arguments, message = BAD_INPUT[case]
    given = [a.format(**bad_files) for a in arguments]
    base = [] if "--out" in given else ["--out", str(tmp_path / "out")]
    base += [] if "--prior" in given else ["--prior", PRIOR.format(**bad_files)]
    done = torchpose("track", *given, *base)
    assert done.code == 2
    assert message in done.err
    assert done.err.startswith("torchpose: error: ") and len(done.err.splitlines()) == 1
    assert done.out == ""
    assert not list((tmp_path / "out").glob("*"))


def test_missing_out(torchpose, files):
    done = torchpose("track", files / "keypoints.npz")
    assert (
        done.code == 2 and done.err == "torchpose: error: missing: --out; see --help for examples\n"
    )


def test_debug_shows_where(torchpose, tmp_path, monkeypatch):
    from torchpose.errors import InputError

    with pytest.raises(InputError):
        torchpose("track", tmp_path / "no.npz", "--out", tmp_path, "--debug")
    monkeypatch.setenv("TORCHPOSE_DEBUG", "1")
    with pytest.raises(InputError):
        torchpose("track", tmp_path / "no.npz", "--out", tmp_path)


def test_interruption_leaves_nothing_half_written(torchpose, files, tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", interrupt)
    out = tmp_path / "out"
    prior = files / "prior.safetensors"
    done = torchpose("track", files / "keypoints.npz", "--out", out, "--prior", prior)
    assert done.code == 130 and "interrupted" in done.err
    assert list(out.iterdir()) == []


def test_degenerate_filter_is_told(track, capsys):
    _, poses = track()
    assert track_output.report_failure(poses) == 0
    assert track_output.report_failure(replace(poses, failed_at=torch.tensor([7]))) == 1
    assert "degenerated at frame 7" in capsys.readouterr().err
