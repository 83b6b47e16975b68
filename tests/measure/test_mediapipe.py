"""The adapters for MediaPipe, on a stand-in for the package that records what it is asked."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from torchpose.errors import InputError, MissingDependencyError
from torchpose.measure import FaceDetector, MediaPipeFaceDetector, MediaPipePose
from torchpose.measure._face import FaceTracker
from torchpose.measure._face_detector import Region
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS


class Stand:
    """A package that finds bright squares as faces, and the poses that a test puts in."""

    def __init__(self):
        self.options, self.images, self.stamps, self.poses, self.closed = [], [], [], [], 0
        self.broken = None

    def package(self):
        module = ModuleType("mediapipe")
        module.__version__ = "1.2.2"
        module.ImageFormat = SimpleNamespace(SRGB="srgb")
        module.Image = lambda image_format, data: SimpleNamespace(format=image_format, data=data)
        vision = SimpleNamespace(
            RunningMode=SimpleNamespace(IMAGE="image", VIDEO="video"),
            FaceDetectorOptions=SimpleNamespace,
            PoseLandmarkerOptions=SimpleNamespace,
            FaceDetector=SimpleNamespace(create_from_options=self.make),
            PoseLandmarker=SimpleNamespace(create_from_options=self.make),
        )
        module.tasks = SimpleNamespace(BaseOptions=SimpleNamespace, vision=vision)
        return module

    def make(self, options):
        if self.broken is not None:
            raise self.broken
        self.options.append(options)
        return SimpleNamespace(
            detect=self.detect, detect_for_video=self.detect_for_video, close=self.close
        )

    def close(self):
        self.closed += 1

    def detect(self, image):
        self.images.append(image)
        bright = image.data[..., 0] > 100
        if not bright.any():
            return SimpleNamespace(detections=[])
        rows, columns = np.flatnonzero(bright.any(1)), np.flatnonzero(bright.any(0))
        if min(len(rows), len(columns)) < 40:  # cut off by the edge of the view
            return SimpleNamespace(detections=[])
        box = SimpleNamespace(
            origin_x=int(columns[0]), origin_y=int(rows[0]), width=len(columns), height=len(rows)
        )
        share = float(bright.sum()) / bright.size
        detection = SimpleNamespace(bounding_box=box, categories=[SimpleNamespace(score=share)])
        return SimpleNamespace(detections=[detection])

    def detect_for_video(self, image, stamp):
        self.images.append(image)
        self.stamps.append(stamp)
        marks = [[SimpleNamespace(x=u / 640, y=v / 480, visibility=s) for u, v, s in p.tolist()]
                 for p in self.poses]  # fmt: skip
        world = [[SimpleNamespace(x=u, y=v, z=s) for u, v, s in p.tolist()] for p in self.poses]
        return SimpleNamespace(pose_landmarks=marks, pose_world_landmarks=world)


@pytest.fixture
def stand(monkeypatch):
    stand = Stand()
    monkeypatch.setitem(sys.modules, "mediapipe", stand.package())
    return stand


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.task"
    path.write_bytes(b"some model")
    return path


def face_image(left=300, top=100, side=80):
    image = np.zeros((480, 640), np.uint8)
    image[top : top + side, left : left + side] = 200
    return image


def test_a_box_becomes_one_of_the_cascades_kind(stand, model):
    detector = MediaPipeFaceDetector(model, tiles=1, min_confidence=0.3)
    assert isinstance(detector, FaceDetector)
    found = detector(face_image())
    assert found.tolist() == [[340.0, pytest.approx(140 - 0.13 * 80), pytest.approx(92.0)]]
    (options,) = stand.options
    assert options.base_options.model_asset_path == str(model)
    assert (options.running_mode, options.min_detection_confidence) == ("image", 0.3)
    assert stand.images[0].data.shape == (480, 640, 3)
    assert stand.images[0].data.flags.c_contiguous


def test_a_region_is_cut_out_and_its_sizes_hold(stand, model):
    detector = MediaPipeFaceDetector(model)
    region = Region(250, 60, 430, 240, 60.0, 130.0)
    assert detector(face_image(), region).tolist() == [
        [340.0, pytest.approx(129.6), pytest.approx(92.0)]
    ]
    assert stand.images[0].data.shape == (180, 180, 3)
    assert len(detector(face_image(), region._replace(smallest=100.0))) == 0
    assert len(detector(face_image(), region._replace(left=640, right=640))) == 0


@pytest.mark.parametrize(("left", "top"), [(0, 0), (300, 100), (560, 400), (180, 200)])
@pytest.mark.parametrize("tiles", [1, 2, 3])
def test_a_face_in_several_squares_is_one_face(stand, model, left, top, tiles):
    detector = MediaPipeFaceDetector(model, tiles=tiles)
    found = detector(face_image(left, top))
    assert len(found) == 1
    assert found[0, :2].tolist() == pytest.approx([left + 40, top + 40 - 0.13 * 80])
    sizes = {image.data.shape[:2] for image in stand.images}
    assert sizes == {(480, 640)} | ({(480 // tiles,) * 2} if tiles > 1 else set())


def test_it_drops_into_the_face_tracker(stand, model):
    tracker = FaceTracker(MediaPipeFaceDetector(model))
    state = tracker.init()
    for frame in range(12):
        state = tracker.step(state, face_image(300 + 2 * frame))
    assert tracker.usable(state).tolist() == [True]
    assert state.mean[0, 0] == pytest.approx(340 + 22, abs=2)


def test_nothing_found_is_an_empty_tensor(stand, model):
    assert MediaPipeFaceDetector(model)(np.zeros((480, 640), np.uint8)).shape == (0, 3)


def pose_of(points):
    whole = torch.full((len(LANDMARKS), 3), 0.9, dtype=torch.float64)
    whole[:, :2] = torch.arange(66.0, dtype=torch.float64).reshape(33, 2)
    for name, point in points.items():
        whole[LANDMARKS.index(name), :2] = torch.tensor(point, dtype=torch.float64)
    return whole


UPRIGHT = {
    "left_ear": (340, 100), "right_ear": (300, 100),
    "left_shoulder": (400, 180), "right_shoulder": (240, 180),
    "left_wrist": (420, 400), "right_wrist": (220, 400),
    "left_index": (430, 440), "right_index": (210, 440),
}  # fmt: skip


def test_poses_are_pixels_with_head_neck_and_hands(stand, model):
    stand.poses = [pose_of(UPRIGHT), pose_of(UPRIGHT) + torch.tensor([5.0, 0, -0.2])]
    with MediaPipePose(model, max_people=2) as pose:
        found = pose(np.zeros((480, 640, 3), np.uint8), 0.0)
    assert stand.closed == 1
    assert stand.options[0].num_poses == 2
    assert stand.options[0].running_mode == "video"
    by_name = dict(zip(pose.names, found.points[0].tolist(), strict=True))
    for name, point in UPRIGHT.items():
        assert by_name[name] == pytest.approx(point)
    assert by_name["head"] == pytest.approx((320, 180 - 160))
    assert by_name["neck"] == pytest.approx((320, 180 - 0.27 * 160))
    assert by_name["hand_left"] == pytest.approx((427, 428))
    assert found.points[1] - found.points[0] == pytest.approx(
        torch.tensor([[5.0, 0]] * 37).double()
    )
    assert found.visibility.shape == (2, 37)
    assert found.visibility[1].tolist() == pytest.approx([0.7] * 37)
    assert found.joints3d.shape == (2, 33, 3)
    assert torch.equal(found.joints3d[0], stand.poses[0])


def test_times_become_rising_milliseconds(stand, model):
    pose = MediaPipePose(model)
    image = np.zeros((480, 640, 3), np.uint8)
    for time in (0.0, 0.0001, 0.0002, 0.0333):
        pose(image, time)
    assert stand.stamps == [0, 1, 2, 33]
    with pytest.raises(InputError, match="later than that of the frame before"):
        pose(image, 0.0333)
    with pytest.raises(InputError, match="finite"):
        pose(image, float("nan"))


def test_nobody_is_a_missing_measurement(stand, model):
    pose = MediaPipePose(model)
    found = pose(np.zeros((480, 640, 3), np.uint8), 0.0)
    assert found.points.shape == (0, 37, 2)
    assert found.joints3d.shape == (0, 33, 3)
    points, confidence = pose.of_one(found)
    assert points.isnan().all()
    assert confidence.shape == (1, 37)
    assert not confidence.any()


def test_the_first_person_is_what_a_tracker_takes(stand, model):
    stand.poses = [pose_of(UPRIGHT)]
    pose = MediaPipePose(model)
    found = pose(np.zeros((480, 640, 3), np.uint8), 0.0)
    points, confidence = pose.of_one(found)
    assert torch.equal(points, found.points)
    assert torch.equal(confidence, found.visibility)


@pytest.mark.parametrize("adapter", [MediaPipeFaceDetector, MediaPipePose])
def test_without_the_package_it_says_what_to_install(adapter, model, monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(
        MissingDependencyError, match=r"pip install 'torchpose.mediapipe.'.*model file"
    ):
        adapter(model)


@pytest.mark.parametrize("adapter", [MediaPipeFaceDetector, MediaPipePose])
def test_an_old_package_is_named(adapter, model, monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", ModuleType("mediapipe"))
    with pytest.raises(MissingDependencyError, match=r"Tasks API.*upgrade"):
        adapter(model)


@pytest.mark.parametrize("adapter", [MediaPipeFaceDetector, MediaPipePose])
def test_a_missing_model_says_where_models_are_described(adapter, stand, tmp_path):
    with pytest.raises(InputError, match=r"absent\.task.*no such file.*MediaPipe's models page"):
        adapter(tmp_path / "absent.task")


@pytest.mark.parametrize("error", [RuntimeError, ValueError, FileNotFoundError])
@pytest.mark.parametrize("adapter", [MediaPipeFaceDetector, MediaPipePose])
def test_another_kind_of_model_is_named(adapter, error, stand, model):
    stand.broken = error("Unable to open zip archive.\nStack:")
    with pytest.raises(InputError, match=r"model\.task.*MediaPipe: Unable to open zip archive\.$"):
        adapter(model)


def test_bad_settings_and_images(stand, model):
    with pytest.raises(InputError, match="min_confidence must be in 0 to 1"):
        MediaPipeFaceDetector(model, min_confidence=2.0)
    with pytest.raises(InputError, match="tiles must be at least 1"):
        MediaPipeFaceDetector(model, tiles=0)
    with pytest.raises(InputError, match="scale must be positive"):
        MediaPipeFaceDetector(model, scale=0.0)
    with pytest.raises(InputError, match="max_people must be at least 1"):
        MediaPipePose(model, max_people=0)
    with pytest.raises(InputError, match="image must be grey"):
        MediaPipeFaceDetector(model)(np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="image must be RGB"):
        MediaPipePose(model)(np.zeros((4, 4), np.uint8), 0.0)
