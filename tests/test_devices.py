"""Every tracker that is moved to a device computes there, and says what it says on the CPU.

The device is a CUDA device where there is one, and in any case one that pretends to be another.
"""

import contextlib
import math

import pytest
import torch

import torchpose
from tests.pretended_device import PRETENDED, moved, pretended_device
from tests.whole_body.keypoints.scenes import FPS, NAMES, scene
from tests.whole_body.keypoints.test_faulty_cameras import with_turn
from tests.whole_body.keypoints.test_feet import WITH_FEET, with_feet
from torchpose.body import BODY_15, Body
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.demo import KEYPOINT_NAMES, demo_camera, noisy_keypoints, performer
from torchpose.upper_body import METHODS, method_options
from torchpose.whole_body import METHODS as BODY_METHODS
from torchpose.whole_body import render

NEEDS_CUDA = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]
DEVICES = [PRETENDED, pytest.param("cuda", marks=NEEDS_CUDA)]


def on_devices(methods, pretended):
    """Every method on CUDA, and on the slower pretended device those that share least of their code."""
    return [
        *((name, PRETENDED) for name in pretended),
        *(pytest.param(name, "cuda", marks=NEEDS_CUDA) for name in methods),
    ]


UPPER_BODY = list(KEYPOINT_NAMES)
FIELDS = ("joints2d", "joints3d", "covariance2d", "covariance3d", "log_evidence")
HALF = math.pi / math.sqrt(2)
METRE = 1e-5  # what the order of sums may change over some tens of frames
MODELS = {
    "mrpf": {"manifold": "walk"},
    "root": {"conditionals": "walk"},
    "constrained": {"action": "exercises"},
}


@pytest.fixture(params=DEVICES)
def device(request):
    return request.param


def use_of(device):
    """The context in which a device can be used."""
    return pretended_device() if device == PRETENDED else contextlib.nullcontext()


@pytest.fixture(scope="module")
def keypoints():
    """Two performers, one of whom hides a hand for a while."""
    frames = torch.stack(
        [noisy_keypoints(performer(3, seed=seed).joints, std_px=3.0) for seed in range(2)]
    )
    frames[1, 1:, 2] = torch.nan
    return frames


@pytest.fixture(scope="module")
def confidence(keypoints):
    generator = torch.Generator().manual_seed(3)
    shape = keypoints.shape[:-1]
    return 0.3 + 0.7 * torch.rand(shape, generator=generator, dtype=torch.float64)


def upper_body(method, device):
    options = {"n_particles": 60} if "n_particles" in method_options(method) else {}
    prior = torchpose.load_prior("kinect-upper-body")
    return moved(torchpose.UpperBodyTracker(prior, prior.camera, method, **options), device)


def random(device):
    return torch.Generator("cuda" if device == "cuda" else "cpu").manual_seed(0)


def has_other_draws(method, device):
    return device == "cuda" and ("n_particles" in method_options(method) or method == "mkf-sampled")


@pytest.mark.parametrize(
    ("method", "device"),
    on_devices(
        METHODS, ["window-mixture", "articulated", "mkf-fixed", "mkf-sampled", "pf-mixture"]
    ),
)
def test_upper_bodies(keypoints, confidence, method, device):
    given = keypoints, confidence, UPPER_BODY
    here = upper_body(method, "cpu")(*given, generator=random("cpu"))
    with use_of(device):
        tracker = upper_body(method, device)
        there = tracker(*given, generator=random(device))
        assert all(getattr(there, name).device.type == device for name in FIELDS)
        state = tracker.init(len(keypoints), UPPER_BODY, random(device))
        for t in range(keypoints.shape[1]):
            state, pose = tracker.step(state, keypoints[:, t], confidence[:, t])
        found, last = {name: getattr(there, name).cpu() for name in FIELDS}, pose.joints3d.cpu()
    torch.testing.assert_close(last, found["joints3d"][:, -1], rtol=0, atol=METRE)
    if has_other_draws(method, device):
        distance = (found["joints3d"] - here.joints3d).norm(dim=-1)
        assert float(distance.median()) < 0.1
        return
    close = torch.testing.assert_close
    close(found["joints3d"], here.joints3d, rtol=0, atol=METRE)
    close(found["joints2d"], here.joints2d, rtol=0, atol=1e-2)
    close(found["covariance3d"], here.covariance3d, rtol=1e-3, atol=METRE**2)


def body_tracker(seen, device, fps=FPS, **options):
    return moved(torchpose.BodyTracker(seen.rig, "kalman", fps=fps, up="y", **options), device)


@pytest.mark.parametrize(("cameras", "height"), [(1, None), (1, 1.7), (2, None)])
def test_whole_bodies(cameras, height, device):
    seen = scene(cameras, 4)
    given = {"keypoints": seen.keypoints, "confidence": seen.confidence, "names": NAMES}
    here = body_tracker(seen, "cpu", camera_height=height)(**given, smoothing="full")
    with use_of(device):
        tracker = body_tracker(seen, device, camera_height=height)
        there = tracker(**given, smoothing="full")
        assert there.joints3d.device.type == device
        state = tracker.init()
        for points, trust in zip(seen.keypoints, seen.confidence, strict=True):
            state, pose = tracker.step(state, keypoints=points, confidence=trust, names=NAMES)
        joints, cov = there.joints3d.cpu(), there.covariance3d.cpu()
        last = pose.joints3d.reshape(15, 3).cpu()  # which no later frame smooths
    torch.testing.assert_close(joints, here.joints3d, rtol=0, atol=METRE)
    torch.testing.assert_close(cov, here.covariance3d, rtol=1e-3, atol=METRE**2)
    torch.testing.assert_close(last, here.joints3d[-1], rtol=0, atol=METRE)
    assert there.details.keys() == here.details.keys()


@pytest.mark.parametrize("device", [pytest.param("cuda", marks=NEEDS_CUDA)])
def test_feet_and_a_camera_that_is_turned(device):
    seen, _, keypoints = with_feet(3, 22)
    rig = with_turn(seen.rig, 1, 20.0)
    given = {"keypoints": keypoints, "names": WITH_FEET}
    here = torchpose.BodyTracker(rig, "kalman", fps=FPS)(**given)
    with use_of(device):
        tracker = moved(torchpose.BodyTracker(rig, "kalman", fps=FPS), device)
        there = tracker(**given)
        state = tracker.init()
        for points in keypoints:
            state, pose = tracker.step(state, keypoints=points, names=WITH_FEET)
        feet, joints = there.feet.points3d.cpu(), there.joints3d.cpu()
        last = pose.feet.points3d.reshape(6, 3).cpu()
    assert there.notes == here.notes
    torch.testing.assert_close(joints, here.joints3d, rtol=0, atol=METRE)
    torch.testing.assert_close(feet, here.feet.points3d, rtol=0, atol=METRE)
    torch.testing.assert_close(last, here.feet.points3d[-1], rtol=0, atol=METRE)


@pytest.mark.parametrize("device", [pytest.param("cuda", marks=NEEDS_CUDA)])
def test_a_whole_body_that_one_of_several_cameras_sees(device):
    seen = scene(2, 4, noise=2.0)
    seen.keypoints[:3, 1] = torch.nan
    here = body_tracker(seen, "cpu", 3.0)(keypoints=seen.keypoints)
    with use_of(device):
        there = body_tracker(seen, device, 3.0)(keypoints=seen.keypoints)
        joints, cov = there.joints3d.cpu(), there.covariance3d.cpu()
    assert here.first_frame == there.first_frame == 2 and bool(here.respread[-1])
    torch.testing.assert_close(joints, here.joints3d, rtol=0, atol=METRE)
    torch.testing.assert_close(cov, here.covariance3d, rtol=1e-3, atol=METRE**2)


def test_cameras_that_are_slightly_wrong(device):
    if device == PRETENDED:
        pytest.skip("takes half a minute, and the notes about cameras above run most of it")
    seen = scene(2, 12)
    given = {"keypoints": seen.keypoints, "confidence": seen.confidence, "names": NAMES}
    track = body_tracker(seen, device)(**given, refine="both")
    error = (track.joints3d.cpu() - seen.joints[-len(track.joints3d) :]).norm(dim=-1)
    assert float(error.mean()) < 0.05


@pytest.mark.usefixtures("undoubted_here")  # tracks above have these notes
def test_several_persons(device):
    seen = scene(2, 4)
    detections = torch.stack([seen.keypoints, seen.keypoints + 300], 2)
    trust = torch.stack([seen.confidence, 0 * seen.confidence], 2)
    given = {"keypoints": detections, "confidence": trust, "names": NAMES, "persons": "all"}
    with use_of(device):
        (person,) = body_tracker(seen, device)(**given)
        assert person.joints3d.device.type == device
        assert {each.device.type for each in person.details.values()} == {device}


@pytest.fixture(scope="module")
def silhouettes():
    """Silhouettes of a body that stands still, the two small cameras, and its joints."""
    cameras = [
        PinholeCamera(80, 80, 39.5, 29.5, 80, 60, name, rotation=rotation, translation=(0, 0, 3))
        for name, rotation in (("front", (math.pi, 0, 0)), ("side", (HALF, 0, HALF)))
    ]
    body, standing = Body.of_height(BODY_15, 1.75), torch.zeros(3, 36, dtype=torch.float64)
    images = render(body, standing, CameraRig(cameras), 60, 80)
    return images, cameras, body.joints(standing[0])


@pytest.mark.parametrize(
    ("method", "device"), on_devices(BODY_METHODS, ["mrpf", "root", "constrained"])
)
def test_particles(method, silhouettes, device):
    images, cameras, joints = silhouettes
    pixels = CameraRig(cameras)(joints).pixels.expand(len(images), -1, -1, -1)
    given = {"keypoints": pixels, "names": NAMES}

    def tracked(place):
        options = {"n_particles": 60, **MODELS.get(method, {})}
        tracker = moved(torchpose.BodyTracker(CameraRig(cameras), method, **options), place)
        start = torch.zeros(tracker.body.dim, dtype=torch.float64)
        return tracker(images, start, generator=random(place), **given).joints3d

    here = tracked("cpu")
    with use_of(device):
        there = tracked(device)
        assert there.device.type == device
        there = there.cpu()
    assert bool(there.isfinite().all())
    if device == PRETENDED:  # the same random numbers
        torch.testing.assert_close(there, here)


class OneFace:
    """Finds a face where the performer's is, so that OpenCV's detector is not needed."""

    def __init__(self, face):
        self.face = face

    def __call__(self, image, region=None):
        return self.face


@pytest.fixture(scope="module")
def filmed():
    """Images of a performer, and a detector of the face."""
    pytest.importorskip("matplotlib", reason="the performer's face comes from matplotlib")
    from torchpose.demo._rendering import Scene, render_performance

    shown = performer(20, distance=1.6)
    scene = Scene(clutter=False, exposure=0.0)
    images = list(render_performance([shown], demo_camera(), scene=scene))
    head = demo_camera()(shown.joints[:, 3]).mean(0)[:2]
    return images, OneFace(torch.tensor([[*head.tolist(), 90.0]], dtype=torch.float64))


def test_video(filmed, device):
    if device == PRETENDED:
        pytest.skip("videos are measured in a thread of their own, in which no device is pretended")
    images, face = filmed

    def tracked(place):
        prior = torchpose.load_prior("kinect-upper-body")
        tracker = torchpose.VideoTracker(prior, demo_camera(), face_detector=face, edges=True)
        (person,) = moved(tracker, place)(images)
        assert tracker.tracker.measurement_cov.device.type == place
        return person.track.joints3d.cpu()

    here = tracked("cpu")
    with use_of(device):
        there = tracked(device)
    torch.testing.assert_close(there, here, rtol=0, atol=METRE)
