"""Detectors by file and by name, and what is refused."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from torchpose.errors import InputError, MissingDependencyError
from torchpose.measure._detectors.load import check_detector, load_detector
from torchpose.measure._detectors.mediapipe import MediaPipeDetector
from torchpose.measure._detectors.protocol import KeypointDetector, checked_detections

NAMES = ("nose", "left_shoulder", "right_shoulder", "left_wrist", "right_wrist")


class Detector:
    """Nobody is ever there."""

    names = NAMES

    def __call__(self, image):
        return np.zeros((0, 5, 2)), np.zeros((0, 5))


@pytest.fixture
def module(monkeypatch):
    module = ModuleType("my_detectors")
    module.make = Detector
    module.kinds = SimpleNamespace(first=Detector)
    module.number = 3
    module.needs_more = lambda size: size
    module.nothing = lambda: None
    module.unnamed = lambda: lambda image: image
    module.of_feet = lambda: SimpleNamespaceDetector(("left_toe", "right_toe"))
    module.unknown = lambda: SimpleNamespaceDetector(("left_antenna",))
    module.one_name = lambda: SimpleNamespaceDetector("nose")

    def broken():
        raise RuntimeError("no weights")

    module.broken = broken
    monkeypatch.setitem(sys.modules, "my_detectors", module)
    return module


class SimpleNamespaceDetector(Detector):
    def __init__(self, names):
        self.names = names


@pytest.mark.parametrize("name", ["make", "kinds.first"])
def test_a_factory_is_called(module, name):
    detector = load_detector(f"my_detectors:{name}")
    assert isinstance(detector, KeypointDetector) and detector.names == NAMES


def test_a_module_in_the_working_directory_is_found(tmp_path, monkeypatch):
    (tmp_path / "here_alone.py").write_text(
        "class make:\n    names = ('nose', 'left_wrist')\n    def __call__(self, image): ...\n"
    )
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    assert load_detector("here_alone:make").names == ("nose", "left_wrist")
    assert sys.path == before
    sys.modules.pop("here_alone")


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("my_detectors:absent", "expected package:factory.*AttributeError"),
        ("no_such_package_at_all:make", "expected package:factory.*no_such_package_at_all"),
        (":make", "expected package:factory"),
        ("my_detectors:number", "expected a callable that returns a detector, got int"),
        ("my_detectors:needs_more", "without arguments, got TypeError"),
        ("my_detectors:broken", "RuntimeError: no weights"),
        ("my_detectors:nothing", "expected a detector.*got NoneType"),
        ("my_detectors:unnamed", "attribute names.*got function"),
        ("my_detectors:one_name", "with names 'nose'"),
        ("my_detectors:of_feet", "names do not suit.*expected some of"),
        ("my_detectors:unknown", "names do not suit.*unknown joint name 'left_antenna'"),
    ],
)
def test_other_objects_are_named(module, where, said):
    with pytest.raises(InputError, match=f"^{where}.*{said}"):
        load_detector(where)


def test_files_that_are_missing_or_of_another_kind(tmp_path):
    for name in ("absent.onnx", "absent.task"):
        with pytest.raises(InputError, match=rf"{name}: expected a model file, there is no such"):
            load_detector(tmp_path / name)
    (tmp_path / "model.pt").write_bytes(b"weights")
    with pytest.raises(InputError, match=r"must be an ONNX model.*package:factory.*a \.pt file"):
        load_detector(tmp_path / "model.pt")
    with pytest.raises(InputError, match="this is neither"):
        load_detector("yolo")


def test_without_mediapipe_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    (tmp_path / "pose.task").write_bytes(b"model")
    with pytest.raises(MissingDependencyError, match=r"pip install 'torchpose.mediapipe.'"):
        load_detector(tmp_path / "pose.task")


def test_an_object_of_another_kind_is_named():
    with pytest.raises(InputError, match="mine: expected a detector"):
        check_detector(3, "mine")


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (None, "got NoneType"),
        (3, "got int"),
        ((np.zeros((1, 5, 2)),), r"got 1 values \(ndarray\)"),
        ((np.zeros((1, 5, 2)), "sure"), r"got 2 values \(ndarray, str\)"),
        ((np.zeros((1, 4, 2)), np.zeros((1, 4))), r"got \[1, 4, 2\] and \[1, 4\]"),
        ((np.zeros((1, 5, 3)), np.zeros((1, 5))), r"got \[1, 5, 3\] and \[1, 5\]"),
        ((np.zeros((5, 2)), np.zeros(5)), r"got \[5, 2\] and \[5\]"),
        ((np.zeros((2, 5, 2)), np.zeros((1, 5))), r"got \[2, 5, 2\] and \[1, 5\]"),
        ((np.zeros((1, 5, 2)), np.full((1, 5), 87.0)), "confidence in 0 to 1, got 87"),
    ],
)
def test_what_a_detector_returns_is_checked(found, said):
    with pytest.raises(InputError, match=f"^mine must return .*{said}"):
        checked_detections(found, 5, "mine")


def test_peaks_of_heat_maps_count_as_certain():
    found = checked_detections((np.full((1, 5, 2), 90.0), np.full((1, 5), 1.02)), 5, "mine")
    assert found.confidence.tolist() == [[1.0] * 5]


def test_shares_of_the_image_are_no_pixels():
    shares, sure = np.linspace(0.2, 0.8, 10).reshape(1, 5, 2), np.ones((1, 5))
    with pytest.raises(InputError, match=r"^mine must return keypoints in pixels, got all of them"):
        checked_detections((shares, sure), 5, "mine")
    at_one_place = np.full((1, 5, 2), 0.5), sure  # what a detector may give of an empty image
    for found in (at_one_place, (shares, 0 * sure), (640 * shares, sure)):
        assert checked_detections(found, 5, "mine").keypoints.shape == (1, 5, 2)


def test_what_is_not_finite_is_missing():
    points, sure = np.ones((1, 5, 2)), np.ones((1, 5), np.float32)
    points[0, 1], sure[0, 2] = np.inf, np.nan
    found = checked_detections((points, sure), 5, "mine")
    assert found.confidence[0].tolist() == [1, 0, 0, 1, 1]
    assert found.keypoints[0].isnan().any(-1).tolist() == [False, True, True, False, False]


def test_mediapipe_gets_even_times_and_begins_anew(tmp_path, monkeypatch):
    from tests.measure.test_mediapipe import UPRIGHT, Stand, pose_of

    stand = Stand()
    monkeypatch.setitem(sys.modules, "mediapipe", stand.package())
    (tmp_path / "pose.task").write_bytes(b"model")
    stand.poses = [pose_of(UPRIGHT)]
    detector = load_detector(tmp_path / "pose.task", fps=25.0, max_persons=2)
    assert isinstance(detector, MediaPipeDetector)
    assert stand.options[0].num_poses == 2
    detector.reset()
    assert stand.closed == 0  # nothing was shown yet
    image = np.zeros((480, 640, 3), np.uint8)
    for _ in range(3):
        points, visibility = detector(image)
    assert stand.stamps == [0, 40, 80]
    assert points.shape == (1, 37, 2) and visibility.shape == (1, 37)
    detector.reset()
    detector(image)
    assert stand.closed == 1 and stand.stamps[-1] == 0
