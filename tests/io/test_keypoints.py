"""Keypoints: round trips between the forms, what counts as missing, OpenPose, and bad files."""

import json
import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.data import data_dir_or_skip
from torchpose.errors import (
    CameraError,
    FileFormatError,
    InputError,
    NobodySeenError,
    ShapeError,
    SkeletonError,
)
from torchpose.io import Keypoints, read_keypoints, write_keypoints
from torchpose.io._formats.keypoint_files import is_keypoint_header
from torchpose.io._formats.openpose import _BODY_25B, holds_openpose, read_openpose_people
from torchpose.skeleton import SKELETONS
from torchpose.skeleton._joint_sets import COCO
from torchpose.skeleton._mediapipe_landmarks import LANDMARKS

NAMES = ("head", "lhand", "RWrist")


def points(n: int = 5) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 640, (n, len(NAMES), 2))


def write(path, **changes):
    arrays = {"keypoints": points(), "names": np.array(NAMES), **changes}
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def text(tmp_path, *lines):
    path = tmp_path / "clip.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


# --- npz ------------------------------------------------------------------------------------------


def test_npz(tmp_path):
    confidence = np.full((5, 3), 0.9)
    confidence[1, 0], confidence[2, 1] = 0, math.nan
    given_points = points()
    given_points[3, 2, 0] = math.nan  # one coordinate
    read = read_keypoints(
        write(tmp_path / "a.npz", keypoints=given_points, confidence=confidence, fps=25.0,
              K=np.diag([500.0, 500, 1]), image_size=[640, 480], neck="mid-shoulder")
    )  # fmt: skip
    assert read.keypoints.dtype == torch.float64
    assert (read.names, read.fps, read.image_size, len(read)) == (NAMES, 25.0, (640, 480), 5)
    assert read.neck == "mid-shoulder"
    assert read.K is not None
    assert read.K[0, 0] == 500
    missing = {(1, 0), (2, 1), (3, 2)}
    assert {tuple(i) for i in (~read.measured).nonzero().tolist()} == missing
    assert read.confidence is not None
    assert {tuple(i) for i in (read.confidence == 0).nonzero().tolist()} == missing
    np.testing.assert_array_equal(read.keypoints[0], given_points[0])


def test_coordinates_that_are_no_pixels(tmp_path):
    shares = points() / 640
    with pytest.raises(FileFormatError, match=r"must be in pixels.*width and height"):
        read_keypoints(write(tmp_path / "a.npz", keypoints=shares))
    shares[:, 2] = 2.7  # far outside of the image, where MediaPipe puts the legs of who sits
    with pytest.raises(FileFormatError, match=r"must be in pixels.*most"):
        read_keypoints(write(tmp_path / "b.npz", keypoints=shares))
    shares[:, 2] = np.nan
    assert len(read_keypoints(write(tmp_path / "c.npz", keypoints=shares[:1]))) == 1  # two: too few


def test_shares_of_an_image_of_known_size_are_multiplied(tmp_path):
    size = np.array([640, 480])
    shares = points() / size
    for name, stated, known in (("a", {"image_size": size}, None), ("b", {}, (640, 480))):
        read = read_keypoints(write(tmp_path / f"{name}.npz", keypoints=shares, **stated), known)
        torch.testing.assert_close(read.keypoints, torch.from_numpy(points()))
        assert read.notes == (
            "keypoints between 0 and 1 are multiplied by the 640 x 480 pixels of the image",
        )
    with pytest.raises(FileFormatError, match="must be in pixels"):  # from -1 to 1
        read_keypoints(write(tmp_path / "c.npz", keypoints=2 * shares - 1), (640, 480))
    in_pixels = read_keypoints(write(tmp_path / "d.npz"), (320, 240))
    torch.testing.assert_close(in_pixels.keypoints, torch.from_numpy(points()))


def test_peaks_above_one_count_as_one(tmp_path):
    read = read_keypoints(
        write(tmp_path / "a.npz", keypoints=points(), confidence=np.full((5, 3), 1.3))
    )
    assert read.confidence is not None and bool((read.confidence == 1).all())


def test_zeros_are_missing(tmp_path):
    zeros = points()
    zeros[2, 1] = 0
    read = read_keypoints(write(tmp_path / "a.npz", keypoints=zeros))
    assert (~read.measured).nonzero().tolist() == [[2, 1]]
    assert read.notes == ("1 keypoint at exactly (0, 0) or (-1, -1) counts as missing",)
    zeros[2, 1] = -1
    read = read_keypoints(write(tmp_path / "d.npz", keypoints=zeros))
    assert (~read.measured).nonzero().tolist() == [[2, 1]]
    confidence = np.where((zeros == -1).all(-1), 0.0, 1.0)
    assert not read_keypoints(
        write(tmp_path / "b.npz", keypoints=zeros, confidence=confidence)
    ).notes
    with pytest.raises(InputError, match="no keypoint is measured"):
        read_keypoints(write(tmp_path / "c.npz", keypoints=np.zeros((5, 3, 2))))


def test_only_what_must_be_there(tmp_path):
    read = read_keypoints(write(tmp_path / "a.npz", keypoints=points().astype(np.float32)))
    assert (read.confidence, read.fps, read.K, read.image_size, read.neck) == (None,) * 5


def test_the_neck_of_a_known_set(tmp_path):
    names = SKELETONS["openpose-18"].joints
    path = write(
        tmp_path / "a.npz", keypoints=100 + np.arange(72.0).reshape(2, 18, 2), names=np.array(names)
    )
    assert read_keypoints(path).neck == "mid-shoulder"


@pytest.mark.parametrize(
    ("changes", "error", "word"),
    [
        ({"keypoints": None}, FileFormatError, "keypoints, found names"),
        ({"names": None}, FileFormatError, "names"),
        ({"keypoints": points()[0]}, FileFormatError, "shape"),
        ({"keypoints": np.ones((5, 3, 3))}, FileFormatError, "array of its own"),
        ({"keypoints": points()[:, :2]}, FileFormatError, "3 names"),
        ({"keypoints": points(0)}, InputError, "empty"),
        ({"keypoints": points() * math.nan}, InputError, "no keypoint is measured in any of 5"),
        ({"confidence": np.zeros((5, 3))}, InputError, "no keypoint is measured"),
        ({"keypoints": points() * math.inf}, FileFormatError, "infinite"),
        ({"keypoints": np.array([["a"]])}, FileFormatError, "numbers"),
        ({"names": np.array(["head", "tail", "RWrist"])}, SkeletonError, "tail.*known are"),
        ({"names": np.array(["head", "lhand", "hand_left"])}, SkeletonError, "both hand_left"),
        ({"confidence": np.ones((5, 2))}, FileFormatError, "confidence"),
        ({"confidence": -np.ones((5, 3))}, FileFormatError, "at least 0"),
        ({"confidence": np.full((5, 3), math.inf)}, FileFormatError, "finite"),
        ({"confidence": np.full((5, 3), 90.0)}, FileFormatError, "percent by 100"),
        ({"fps": -1.0}, FileFormatError, "fps"),
        ({"fps": [25.0, 30.0]}, FileFormatError, "fps"),
        ({"K": np.zeros((3, 3))}, CameraError, "focal"),
        ({"K": np.eye(2)}, CameraError, "shape"),
        ({"K": np.stack([np.eye(3)] * 2)}, CameraError, "shape"),
        ({"image_size": [640]}, FileFormatError, "image_size"),
        ({"image_size": [640, math.nan]}, FileFormatError, "image_size"),
        ({"neck": "long"}, FileFormatError, "low-neck"),
    ],
)
def test_what_is_no_keypoint_file(tmp_path, changes, error, word):
    path = write(tmp_path / "clip.npz", **changes)
    with pytest.raises(error, match=word) as caught:
        read_keypoints(path)
    assert "clip.npz" in str(caught.value)


def test_other_files(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_keypoints(tmp_path / "none.npz")
    (tmp_path / "a.mp4").write_bytes(b"")
    with pytest.raises(FileFormatError, match="OpenPose JSON"):
        read_keypoints(tmp_path / "a.mp4")
    (tmp_path / "b.npz").write_bytes(write(tmp_path / "a.npz").read_bytes()[:400])
    with pytest.raises(FileFormatError, match="truncated"):
        read_keypoints(tmp_path / "b.npz")


# --- csv and writing ------------------------------------------------------------------------------

# far from shares of an image, which are refused
COORDINATE = st.floats(10, 1e4) | st.floats(-1e4, -10) | st.just(math.nan)


@settings(
    deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(st.lists(COORDINATE, min_size=6, max_size=6), min_size=1, max_size=6),
    st.booleans(),
    st.sampled_from([".csv", ".npz"]),
)
def test_what_is_written_reads_back(tmp_path, values, scored, suffix):
    given_points = torch.tensor(values, dtype=torch.float64).reshape(-1, 3, 2)
    given_points[0, 0] = 100.0
    measured = torch.isfinite(given_points).all(-1)
    given_points[~measured] = math.nan
    confidence = torch.where(measured, 0.7, 0.0).double() if scored else None
    data = Keypoints(given_points, NAMES, confidence, fps=29.97, image_size=(640, 480))
    path = tmp_path / f"clip{suffix}"
    write_keypoints(path, data)
    back = read_keypoints(path)
    torch.testing.assert_close(back.keypoints, given_points, rtol=0, atol=0, equal_nan=True)
    if confidence is None:
        assert back.confidence is None
    else:
        assert back.confidence is not None
        torch.testing.assert_close(back.confidence, confidence, rtol=0, atol=0)
    assert (back.names, back.fps, back.image_size) == (NAMES, 29.97, (640, 480))


def test_writing_keeps_the_camera(tmp_path):
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
    data = Keypoints(torch.full((2, 3, 2), 100.0).double(), NAMES, K=K, neck="neck")
    write_keypoints(tmp_path / "a.npz", data)
    back = read_keypoints(tmp_path / "a.npz")
    assert back.K is not None
    assert torch.equal(back.K, K)
    assert back.neck == "neck"
    with pytest.raises(InputError, match=r"\.npz or \.csv"):
        write_keypoints(tmp_path / "a.json", data)


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_what_could_not_be_read_is_not_written(tmp_path, suffix):
    path, good = tmp_path / f"a{suffix}", torch.from_numpy(points())
    write_keypoints(path, Keypoints(good.clone().requires_grad_(), NAMES))
    before = path.read_bytes()
    for data, word in (
        (Keypoints(good[None], NAMES), r"keypoints must have shape \[T, 3, 2\]"),
        (Keypoints(good, NAMES[:2]), r"keypoints must have shape \[T, 2, 2\]"),
        (Keypoints(good, NAMES, torch.ones(5)), r"confidence must have shape \[5, 3\]"),
    ):
        with pytest.raises(ShapeError, match=word):
            write_keypoints(path, data)
    assert path.read_bytes() == before
    torch.testing.assert_close(read_keypoints(path).keypoints, good)


def test_wide_rows(tmp_path):
    path = text(
        tmp_path,
        "# fps = 25",
        "frame,head_x,head_y,head_confidence,lhand_x,lhand_y",
        "10, 1,2,0.5, 3,4",
        "11, 1,2,0,   3,",
        "",
        "13, ,,,      5,6",
    )
    read = read_keypoints(path)
    assert read.fps == 25
    assert read.names == ("head", "lhand")
    assert read.measured.tolist() == [[True, True], [False, False], [False, False], [False, True]]
    assert read.confidence is not None
    assert read.confidence.tolist() == [[0.5, 1], [0, 0], [0, 0], [0, 1]]
    assert read.keypoints[3, 1].tolist() == [5, 6]


@pytest.mark.parametrize(
    "spelling",
    ["HEAD_X,HEAD_Y,HEAD_SCORE", "HeadX,HeadY,HeadScore", "Head.x,Head.y,Head.score",
     "Head X,Head Y,Head Score", "x_Head,y_Head,score_Head", "X-head,Y-head,Score-head"],
)  # fmt: skip
def test_columns_of_other_spellings(tmp_path, spelling):
    plain = read_keypoints(text(tmp_path, "frame,head_x,head_y,head_score", "0,10,20,0.5"))
    read = read_keypoints(text(tmp_path, f"frame,{spelling}", "0,10,20,0.5"))
    assert [name.lower() for name in read.names] == ["head"]
    assert (read.keypoints.tolist(), read.confidence.tolist()) == ([[[10, 20]]], [[0.5]])
    assert read.notes == plain.notes == ()
    x, y, _ = spelling.split(",")
    assert is_keypoint_header(["time", x, y])
    assert is_keypoint_header(["Timestamp (ms)", "name", "x", "y", "z"])
    assert not is_keypoint_header(["name", "x", "y"])
    assert not is_keypoint_header(["time", x, y, y.replace("Y", "Z").replace("y", "z")])


def test_long_rows(tmp_path):
    path = text(
        tmp_path,
        "frame,name,x,y,confidence",
        "0,head,1,2,0.9",
        "0,lhand,3,4,0.8",
        "2,lhand,5,6,0.7",
    )
    read = read_keypoints(path)
    assert read.names == ("head", "lhand")
    assert read.measured.tolist() == [[True, True], [False, False], [False, True]]
    plain = read_keypoints(text(tmp_path, "frame,name,x,y", "7,head,1,2"))
    assert plain.keypoints.tolist() == [[[1, 2]]]
    assert plain.confidence is None


@pytest.mark.parametrize(
    "lines",
    [
        ["frame,head_x,head_y,head_visibility,lhand_x,lhand_y", "0,1,2,0.7,5,6", "1,3,4,0,5,6"],
        ["frame,name,x,y,visibility", "0,head,1,2,0.7", "0,lhand,5,6,1", "1,head,3,4,0", "1,lhand,5,6,1"],
    ],
)  # fmt: skip
def test_visibility_of_tables_is_the_confidence(tmp_path, lines):
    read = read_keypoints(text(tmp_path, *lines))
    assert read.names == ("head", "lhand")
    assert read.confidence is not None
    assert read.confidence.tolist() == [[0.7, 1], [0, 1]]
    assert read.measured.tolist() == [[True, True], [False, True]]


def test_visibility_of_arrays_is_the_confidence_where_there_is_none(tmp_path):
    visibility, confidence = np.full((5, 3), 0.4), np.full((5, 3), 0.9)
    of = {"joints2d": points(), "keypoints": None}
    for arrays, expected in (
        ({"visibility": visibility}, 0.4),
        ({"visibility": visibility, "confidence": confidence}, 0.9),
        ({**of, "confidence": confidence}, 0.9),
        ({**of, "visibility": visibility, "confidence": confidence}, 0.4),
    ):
        read = read_keypoints(write(tmp_path / "a.npz", **arrays))
        assert read.confidence is not None
        assert read.confidence.unique().tolist() == [expected]


def test_joints_that_were_inferred_are_no_keypoints(tmp_path):
    observed = np.random.default_rng(1).uniform(size=(5, 3)) < 0.6
    poses = {"keypoints": None, "joints2d": points(), "joints3d": np.zeros((5, 3, 3))}
    read = read_keypoints(write(tmp_path / "poses.npz", **poses, observed=observed))
    assert read.measured.tolist() == observed.tolist()
    assert "tracked before" in read.notes[0]
    read = read_keypoints(write(tmp_path / "landmarks.npz", **poses))  # as MediaPipe's
    assert bool(read.measured.all()) and not read.notes


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        ([""], "empty"),
        (["time,head,neck", "0,1,2"], "line 1.*header"),
        (["moment,head_x,head_y", "0,1,2"], "delete or rename moment"),
        (["frame"], "columns"),
        (["frame,head_x", "0,1"], r"head_y \(absent\)"),
        (["frame,head_x,head_y,colour", "0,1,2,3"], "colour"),
        (
            ["frame,a_x,a_y,a_confidence,a_visibility", "0,1,2,3,4"],
            "delete or rename a_visibility",
        ),
        (
            ["frame,e,head_x,head_y,a,b,c", "0,1,2,3,4,5,6"],
            "rename e, a, b and 1 more .*# fps",
        ),
        (["frame,head_x,head_y,head_x", "0,1,2,3"], "each once"),
        (
            ["frame,x1,y1,z1,v1,x2,y2,z2,v2", "0,1,2,3,4,5,6,7,8"],
            "got frame, x1, y1 and 6 more; rename them so$",
        ),
        (["frame,head_x,head_y", "0,1"], "line 2.*3 cells"),
        (["frame,head_x,head_y", "0,1,two"], "line 2.*'two'"),
        (["frame,head_x,head_y", "0,1,2", "0,1,2"], "line 3.*increase"),
        (["frame,head_x,head_y", "0,1,2", ",1,2"], "line 3.*got none"),
        (["frame,head_x,head_y", "0.5,1,2"], "line 2.*whole"),
        (["frame,head_x,head_y", "0,1,2", "999999999,1,2"], "line 3.*999999999"),
        (["frame,name,x,y", "0,head,1,2", "0,head,1,2"], "twice"),
        (["frame,name,x,y", "1,head,1,2", "0,head,1,2"], "line 3.*increase"),
        (["frame,name,x,y,colour", "0,head,1,2,3"], "got frame,name,x,y,colour; rename or delete"),
        (["frame,name,PoseX,PoseY", "0,head,1,2"], "got frame,name,PoseX,PoseY; rename or delete"),
        (["frame,xHead,yHead", "0,1,2"], "got frame, xHead, yHead; rename them so"),
        (["frame,HeadX,HeadY,MaxX", "0,1,2,3"], "delete or rename MaxX"),
        (["frame,HeadX,HeadY,y_Head", "0,1,2,3"], "delete or rename y_Head"),
        (["frame,HeadX,HeadY,Head.x,Head.y", "0,1,2,3,4"], "delete or rename HeadX, HeadY"),
        (["# fps = fast", "frame,head_x,head_y", "0,1,2"], "fps"),
        (["# fps = 0", "frame,head_x,head_y", "0,1,2"], "fps"),
    ],
)
def test_bad_rows(tmp_path, lines, word):
    with pytest.raises(FileFormatError, match=word) as caught:
        read_keypoints(text(tmp_path, *lines))
    assert "clip.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("lines", "left_out"),
    [
        (["frame,a_x,a_y,a_z,a_visibility", "3,10,20,-0.4,0.5"], "a_z"),
        (["timestamp,frame_number,a_x,a_y,a_z,a_confidence", "0.1,3,10,20,5,0.5"], "timestamp, a_z"),
        (["frame_idx,a_x,a_y,a_presence,a_score", "3,10,20,1,0.5"], "a_presence"),
        (["frame,name,x,y,z,visibility", "3,a,10,20,0.1,0.5"], "z"),
        (["frame,timestamp_ms,landmark,x,y,z,score", "3,100,a,10,20,7,0.5"], "timestamp_ms, z"),
    ],
)  # fmt: skip
def test_depths_and_times_of_tables_are_passed_over(tmp_path, lines, left_out):
    read = read_keypoints(text(tmp_path, *[line.replace("a", "head") if i else line.replace("a_", "head_")
                                           for i, line in enumerate(lines)]))  # fmt: skip
    assert read.names == ("head",) and read.first_frame == 3
    assert read.keypoints.tolist() == [[[10.0, 20.0]]]
    assert read.confidence is not None and read.confidence.tolist() == [[0.5]]
    (note,) = read.notes
    assert f"columns {left_out.replace('a_', 'head_')} are passed over" in note


@pytest.mark.parametrize("stamp", ["2024-05-01T10:00:{:06.3f}", "00:00:{:06.3f}", "{}"])
@pytest.mark.parametrize("frames", [(3, 4, 5, 6), (0, 2, 4, 8)])
def test_time_stamps_give_the_rate(tmp_path, stamp, frames):
    rows = [f"{stamp.format(f / 25)};{f};10,5;20" for f in frames]
    read = read_keypoints(text(tmp_path, "timestamp;frame;head_x;head_y", *rows))
    # Seconds since 1970 resolve a quarter of a microsecond.
    assert read.fps == pytest.approx(25.0, rel=1e-5)
    assert read.keypoints[0].tolist() == [[10.5, 20.0]]
    assert read.notes == ("time stamps taken for seconds: 25 frames per second",)
    stated = read_keypoints(text(tmp_path, "# fps = 24", "timestamp;frame;head_x;head_y", *rows))
    assert stated.fps == 24.0
    rows = [row.replace(";", "@:;", 1) for row in rows]  # times of no known form are passed over
    assert read_keypoints(text(tmp_path, "time;frame;head_x;head_y", *rows)).fps is None


def test_a_table_without_frames_has_them_by_its_times(tmp_path):
    times = [0, 34, 66, 166, 201]  # milliseconds; two frames are absent
    rows = [f"{time},{time},20" for time in times]
    read = read_keypoints(text(tmp_path, "timestamp,head_x,head_y", *rows))
    assert read.keypoints[:, 0, 0].nan_to_num(-1).tolist() == [0, 34, 66, -1, -1, 166, 201]
    assert read.fps == pytest.approx(30, rel=0.02)
    long = [f"{time},{name},{time},20" for time in times for name in ("head", "neck")]
    again = read_keypoints(text(tmp_path, "time,name,x,y", *long))
    assert torch.equal(again.keypoints[:, 1].nan_to_num(), read.keypoints[:, 0].nan_to_num())


@pytest.mark.parametrize("times", [(0, 2, 1), (0, 1, ""), (0, 1, 1), (0, 1, "soon"), (0, 1, 10**7)])
def test_times_in_place_of_frames_increase(tmp_path, times):
    rows = [f"{time},10,20" for time in times]
    with pytest.raises(FileFormatError, match="line 4: "):
        read_keypoints(text(tmp_path, "timestamp,head_x,head_y", *rows))


@pytest.mark.parametrize("times", [(5, 5), (0, 1, 1), ("10:00:01", "10:00:01", "10:00:02")])
def test_two_rows_of_one_time_are_told_apart_from_wrong_frame_numbers(tmp_path, times):
    rows = [f"{time},10,20" for time in times]
    expected = rf"line {2 + times.index(times[1]) + 1}: expected a later time than {times[1]}, which the row"
    with pytest.raises(FileFormatError, match=f"{expected}.*column 'frame'"):
        read_keypoints(text(tmp_path, "time,head_x,head_y", *rows))


@pytest.mark.parametrize(
    ("header", "steps", "count", "fps"),
    [
        ("time,head_x,head_y", (28, 52), 61, 25.0),
        ("time,frame,head_x,head_y", (28, 52), 61, 25.0),
        ("time,head_x,head_y", (33, 67), 91, 30.0),
    ],
)
def test_jitter_of_times_is_no_missing_frame(tmp_path, header, steps, count, fps):
    """Steps of 28 and 52 ms in turn are frames of 40 ms; of 33 and 67 ms, every third is missing."""
    times = [0, *np.tile(steps, 30).cumsum().tolist()]
    numbered = "frame" in header
    rows = [f"{time},{f'{t},' * numbered}10,20" for t, time in enumerate(times)]
    read = read_keypoints(text(tmp_path, header, *rows))
    assert len(read.keypoints) == count
    assert read.fps == pytest.approx(fps)


def test_rows_without_frames_and_times_are_frames(tmp_path):
    read = read_keypoints(text(tmp_path, "head_x,head_y", "1,2", "3,4", "5,6"))
    assert read.keypoints[:, 0, 0].tolist() == [1, 3, 5]
    assert read.notes == (
        "no column of frames or times: each row is taken for the frame after the last",
    )


def test_time_stamps_in_whole_milliseconds_give_the_rate_of_their_mean(tmp_path):
    rows = [f"{1000 * f // 30},{f},10,20" for f in (*range(20), *range(35, 50))]
    read = read_keypoints(text(tmp_path, "timestamp,frame,head_x,head_y", *rows))
    assert read.fps == pytest.approx(30.0, rel=1e-3)


def test_the_rate_by_uneven_time_stamps_is_that_of_their_mean(tmp_path):
    steps = np.tile([28, 30, 44, 36, 42, 33, 44, 31], 20)  # milliseconds, of a busy webcam
    times = [0, *steps.cumsum().tolist()]
    read = read_keypoints(text(tmp_path, "timestamp,head_x,head_y", *(f"{t},10,20" for t in times)))
    assert len(read.keypoints) == len(times)
    assert (len(times) - 1) / read.fps == pytest.approx(times[-1] / 1000, rel=1e-6)
    assert len(read.notes) == 1


def test_coarse_time_stamps_of_counted_frames_give_the_rate(tmp_path):
    rows = [f"{t // 3 / 10},{t},10,20" for t in range(90)]  # tenths of a second
    read = read_keypoints(text(tmp_path, "time,frame,head_x,head_y", *rows))
    assert read.fps == pytest.approx(30.0, rel=1e-6) and len(read.notes) == 1


@pytest.mark.parametrize("header", ["time,frame,head_x,head_y", "time,head_x,head_y"])
def test_a_rate_that_changes_is_noted(tmp_path, header):
    times = [*(t / 30 for t in range(60)), *(2 + t / 22 for t in range(60))]
    counted = "frame" in header
    rows = [f"{time:.4f},{f'{t},' * counted}10,20" for t, time in enumerate(times)]
    read = read_keypoints(text(tmp_path, header, *rows))
    assert len(read.keypoints) == 120 and 119 / read.fps == pytest.approx(times[-1], abs=0.01)
    assert "the rate changes" in read.notes[1] and "frame 60 comes 0.3" in read.notes[1]
    assert "after its time stamp" in read.notes[1]


@pytest.mark.parametrize("mark", [";", "\t"])
def test_decimal_commas_between_semicolons_or_tabs(tmp_path, mark):
    lines = ["frame,head_x,head_y,neck_x,neck_y", "0,1.5,2.5,3.5,4.5", "1,5.5,6.5,,"]
    plain = read_keypoints(text(tmp_path, *lines))
    german = [line.replace(",", mark).replace(".", ",") for line in lines]
    np.testing.assert_array_equal(
        read_keypoints(text(tmp_path, *german)).keypoints, plain.keypoints
    )
    with pytest.raises(FileFormatError, match="decimal commas, separate cells by semicolons"):
        read_keypoints(text(tmp_path, lines[0], lines[1].replace(".", ",")))


def test_numbers_of_landmarks_are_mediapipes(tmp_path):
    rows = [f"0,{i},{0.3 + 0.01 * i},0.5,0,0.9" for i in range(33)]
    path = text(tmp_path, "# image_size = 1000,500", "frame,landmark,x,y,z,visibility", *rows)
    read = read_keypoints(path)
    assert read.names[:33] == LANDMARKS
    assert read.keypoints[0, 12].tolist() == pytest.approx([420.0, 250.0])


def test_tables_of_deeplabcut(tmp_path):
    header = ["scorer,net,net,net", "bodyparts,head,head,head", "coords,x,y,likelihood"]
    read = read_keypoints(text(tmp_path, *header, "0,1.5,2.5,0.5", "2,3.5,4.5,0.25"))
    assert read.names == ("head",) and len(read) == 3
    assert read.keypoints[2].tolist() == [[3.5, 4.5]]
    assert read.confidence is not None and read.confidence[:, 0].tolist() == [0.5, 0.0, 0.25]
    one = ["individuals,ann,ann,ann", "individuals,ann,ann,bob"]
    assert len(read_keypoints(text(tmp_path, header[0], one[0], *header[1:], "0,1,2,1"))) == 1
    with pytest.raises(FileFormatError, match="of several"):
        read_keypoints(text(tmp_path, header[0], one[1], *header[1:], "0,1,2,1"))


def test_a_table_of_several_cameras_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match="expected a table of one camera"):
        read_keypoints(text(tmp_path, "sync_index,port,point_id,img_loc_x,img_loc_y", "0,1,4,5,6"))


def test_points_in_space_are_no_keypoints(tmp_path):
    rows = [f"{i},{300 * (-1) ** i},900,1200" for i in range(9)]
    with pytest.raises(FileFormatError, match="points in space"):
        read_keypoints(text(tmp_path, "frame,head_x,head_y,head_z", *rows))


def test_rows_without_measurements(tmp_path):
    with pytest.raises(InputError, match="empty"):
        read_keypoints(text(tmp_path, "frame,head_x,head_y"))
    with pytest.raises(InputError, match="no keypoint is measured"):
        read_keypoints(text(tmp_path, "frame,head_x,head_y", "0,,"))
    with pytest.raises(SkeletonError, match=r"clip.csv.*tail"):
        read_keypoints(text(tmp_path, "frame,tail_x,tail_y", "0,1,2"))
    path = tmp_path / "clip.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError, match="clip"):
        read_keypoints(path)


# --- OpenPose -------------------------------------------------------------------------------------


def person(x: float, confidence: float = 0.8, joints: int = 25) -> dict:
    values = np.tile([x, 100.0, confidence], (joints, 1))
    return {"pose_keypoints_2d": values.ravel().tolist()}


def standing(x: float, confidence: float) -> dict:
    values = [[x + 10 * (i % 5), 100.0 + 20 * i, confidence] for i in range(25)]
    return {"pose_keypoints_2d": np.ravel(values).tolist()}


def frame(folder, number: int | str, *people: dict):
    folder.mkdir(exist_ok=True)
    label = f"{number:012d}" if isinstance(number, int) else number
    (folder / f"clip_{label}_keypoints.json").write_text(json.dumps({"people": people}))


@pytest.mark.parametrize("name", ["cam01_{:06d}.json", "cam01.{:04d}.json"])
def test_files_with_the_names_that_pose2sim_gives_are_numbered_frames(tmp_path, name):
    for number, people in ((7, [person(10)]), (9, []), (10, [person(13)])):
        (tmp_path / name.format(number)).write_text(json.dumps({"people": people}))
    (tmp_path / "calibration.json").write_text("{}")  # of something else
    read = read_keypoints(tmp_path)
    assert read.measured.all(-1).tolist() == [True, False, False, True]
    assert (read.first_frame, holds_openpose(tmp_path)) == (7, True)
    (tmp_path / name.format(7)).write_text('{"frames": []}')
    assert not holds_openpose(tmp_path)


@pytest.mark.parametrize(("confidence", "said"), [(1.02, False), (6.3, True)])
def test_scores_that_are_no_probabilities_are_said(tmp_path, confidence, said):
    frame(tmp_path / "json", 0, person(10, confidence), person(20, 0.4))
    read = read_keypoints(tmp_path / "json")
    everybody = read_openpose_people(tmp_path / "json")
    for notes in (read.notes, everybody.notes):
        assert any("up to 6.3 are no probabilities" in note for note in notes) == said
    assert read.confidence.max() == 1


@pytest.mark.parametrize("joints", [25, 18])
def test_openpose_folder(tmp_path, joints):
    folder = tmp_path / "json"
    silent = person(11, joints=joints)
    silent["pose_keypoints_2d"][:3] = [0, 0, 0]  # OpenPose writes zeros for what it did not see
    frame(folder, 9, person(10, joints=joints))
    frame(folder, 10, silent)
    frame(folder, 11)
    frame(folder, 13, person(13, joints=joints))
    read = read_keypoints(folder)
    assert read.names == SKELETONS[f"openpose-{joints}"].joints
    assert read.keypoints.shape == (5, joints, 2)
    assert read.measured.all(-1).tolist() == [True, False, False, False, True]
    assert read.measured.any(-1).tolist() == [True, True, False, False, True]
    assert read.keypoints[:, 3, 0].nan_to_num(-1).tolist() == [10, 11, -1, -1, 13]
    assert read.neck == "mid-shoulder"


_FEET = ["big_toe", "small_toe", "heel"]


@pytest.mark.parametrize(
    ("joints", "names"),
    [
        (17, COCO),
        (
            26,
            (
                *COCO,
                *3 * [None],
                *(f"{side}_{point}" for point in _FEET for side in ("left", "right")),
            ),
        ),
        (33, LANDMARKS),
        (133, (*COCO, *(f"{side}_{point}" for side in ("left", "right") for point in _FEET))),
    ],
)
def test_folders_of_other_joint_sets(tmp_path, joints, names):
    flat = np.stack([10 + np.arange(joints), np.full(joints, 5), np.full(joints, 0.9)], -1)
    frame(
        tmp_path / "json", 4, {"pose_keypoints_2d": flat.ravel().tolist()}, person(1, 0.2, joints)
    )
    read = read_keypoints(tmp_path / "json")
    places = {name: 10 + i for i, name in enumerate(names) if name}
    given = dict(zip(read.names, read.keypoints[0, :, 0].tolist(), strict=True))
    assert {name: given[name] for name in places} == places
    everybody = read_openpose_people(tmp_path / "json")
    assert everybody.names == tuple(places)
    assert everybody.keypoints.shape == (1, 2, len(places), 2)


_STANDING = {  # pixels
    "Nose": (0, -60), "LEye": (3, -63), "REye": (-3, -63), "LEar": (8, -60), "REar": (-8, -60),
    "Neck": (0, 0), "MidHip": (0, 100), "Head": (0, -80), "LShoulder": (35, 0), "RShoulder": (-35, 0),
    "LElbow": (45, 50), "RElbow": (-45, 50), "LWrist": (50, 95), "RWrist": (-50, 95), "LHip": (18, 100),
    "RHip": (-18, 100), "LKnee": (20, 190), "RKnee": (-20, 190), "LAnkle": (20, 280), "RAnkle": (-20, 280),
}  # fmt: skip


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("layout", ["BODY_25", "BODY_25B"])
def test_the_two_orders_of_25_keypoints_are_told_apart(tmp_path, layout, behind):
    names = SKELETONS["openpose-25"].joints if layout == "BODY_25" else _BODY_25B
    faces = ("Nose", "LEye", "REye", "LEar", "REar")
    flat = []
    for name in names:
        x, y = _STANDING.get(name, (15, 295))
        seen = not (behind and name in faces)
        flat += [500.0 + x, 300.0 + y, 0.9] if seen else [0.0, 0.0, 0.0]
    frame(tmp_path / "json", 0, {"pose_keypoints_2d": flat})
    assert read_keypoints(tmp_path / "json").names == tuple(names)


@pytest.mark.parametrize("layout", ["BODY_25", "BODY_25B"])
def test_noise_does_not_hide_the_order_of_an_upper_body(tmp_path, layout):
    names = SKELETONS["openpose-25"].joints if layout == "BODY_25" else _BODY_25B
    places = _STANDING | {
        "LElbow": (65, -35), "RElbow": (-65, -35), "LWrist": (45, -85), "RWrist": (-45, -85),
    }  # fmt: skip
    generator = np.random.default_rng(0)
    for number in range(20):
        flat = []
        for name in names:
            seen = not name.endswith(("Hip", "Knee", "Ankle", "Toe", "Heel"))
            x, y = generator.normal(places.get(name, (0, 0)), 11)
            flat += [500.0 + x, 300.0 + y, 0.7] if seen else [0.0, 0.0, 0.0]
        frame(tmp_path / "json", number, {"pose_keypoints_2d": flat})
    assert read_keypoints(tmp_path / "json").names == tuple(names)


@pytest.mark.parametrize("nothing", [math.nan, None])
def test_people_and_keypoints_that_are_no_numbers_are_missing(tmp_path, nothing):
    folder = tmp_path / "json"
    partly = standing(20, 0.9)
    partly["pose_keypoints_2d"][4] = nothing  # of the second keypoint
    frame(folder, 0, {"pose_keypoints_2d": 75 * [nothing]}, standing(10, 0.9))
    frame(folder, 1, {"pose_keypoints_2d": 75 * [nothing]})
    frame(folder, 2, partly)
    read = read_keypoints(folder)
    assert read.measured.sum(-1).tolist() == [25, 0, 24] and not read.measured[2, 1]
    assert read.n_people.tolist() == [1, 0, 1]


def test_the_most_confident_person_is_followed(tmp_path):
    folder = tmp_path / "json"
    frame(folder, 0)
    frame(folder, 1, standing(900, 0.5), standing(100, 0.9), standing(500, 0.7))
    frame(folder, 2, standing(890, 0.95), standing(110, 0.4))  # another one is more confident now
    frame(folder, 3, {"pose_keypoints_2d": []}, standing(880, 0.9))  # ours is not there
    frame(folder, 4, standing(870, 0.5), standing(130, 0.9))
    read = read_keypoints(folder)
    assert read.keypoints[1:, 0, 0].nan_to_num(-1).tolist() == [100, 110, -1, 130]


def test_somebody_who_passes_is_not_taken_for_the_hidden_person(tmp_path):
    folder = tmp_path / "json"
    for number, x in enumerate(np.linspace(900, -700, 80).round()):
        passing, ours = standing(x, 0.7), standing(100, 0.9)
        hidden = abs(x - 100) < 150
        frame(folder, number, passing, *([] if hidden else [ours]))
    places = read_keypoints(folder).keypoints[:, 0, 0].nan_to_num(-1).tolist()
    assert set(places) == {-1.0, 100.0} and places[-1] == 100.0


def test_a_person_who_stays_away_is_followed_again_and_a_neighbour_is_not(tmp_path):
    folder = tmp_path / "json"
    for number in range(150):
        away = 20 <= number < 140
        frame(folder, number, standing(500, 0.7), *([] if away else [standing(100 + number, 0.9)]))
    places = read_keypoints(folder).keypoints[:, 0, 0].nan_to_num(-1).tolist()
    assert places[20:140] == [-1.0] * 120 and places[140:] == [240.0 + i for i in range(10)]


def test_second_detections_do_not_end_the_following(tmp_path):
    folder = tmp_path / "json"
    frame(folder, 0, standing(100, 0.9), standing(104, 0.8))
    for number in range(1, 9):
        frame(folder, number, standing(104 + number, 0.8))
    assert read_keypoints(folder).measured.all()


def test_nothing_in_common_means_the_most_confident(tmp_path):
    folder = tmp_path / "json"
    upper, lower, faint = person(100), person(200, 0.9), person(300, 0.2)
    upper["pose_keypoints_2d"][30:] = [0.0] * 45
    for other in (lower, faint):
        other["pose_keypoints_2d"][:30] = [0.0] * 30
    frame(folder, 0, upper)
    frame(folder, 1, faint, lower)
    assert read_keypoints(folder).keypoints[1, -1, 0] == 200


def test_files_without_numbers_and_old_key(tmp_path):
    folder = tmp_path / "json"
    frame(folder, "b", {"pose_keypoints": person(2)["pose_keypoints_2d"]})
    frame(folder, "a", {"pose_keypoints": person(1)["pose_keypoints_2d"]})
    read = read_keypoints(folder)
    assert read.keypoints[:, 0, 0].tolist() == [1, 2] and read.first_frame == 0


def test_bad_openpose_folders(tmp_path):
    with pytest.raises(NobodySeenError, match="the folder is empty"):
        read_keypoints(tmp_path)
    (tmp_path / "notes.txt").write_text("of something else")
    with pytest.raises(InputError, match="found none"):
        read_keypoints(tmp_path)
    frame(tmp_path / "nobody", 0)
    with pytest.raises(InputError, match="nobody was found in any of 1"):
        read_keypoints(tmp_path / "nobody")
    frame(tmp_path / "mixed", 0, person(1), person(1, joints=18))
    frame(tmp_path / "other", 0, person(1, joints=16))
    for name in ("mixed", "other"):
        with pytest.raises(FileFormatError, match="BODY_25"):
            read_keypoints(tmp_path / name)
    frame(tmp_path / "odd", 3, {"pose_keypoints_2d": [1.0, 2.0]})
    with pytest.raises(FileFormatError, match=r"000003_keypoints.json.*2 values"):
        read_keypoints(tmp_path / "odd")
    frame(tmp_path / "far", 0, person(1))
    frame(tmp_path / "far", 10**11, person(1))
    with pytest.raises(FileFormatError, match="span 100000000001 frames"):
        read_keypoints(tmp_path / "far")
    frame(tmp_path / "two", 0, person(1))
    (tmp_path / "two" / "b_0_keypoints.json").write_text('{"people": []}')
    with pytest.raises(FileFormatError, match="one frame number"):
        read_keypoints(tmp_path / "two")


@pytest.mark.parametrize(
    "content",
    ["", "{", "[]", "3", '{"people": 3}', '{"people": [3]}', '{"people": [{}]}',
     '{"people": [{"pose_keypoints_2d": "x"}]}', '{"people": [{"pose_keypoints_2d": [1, 2, Infinity]}]}'],
)  # fmt: skip
def test_what_is_not_openposes_json(tmp_path, content):
    (tmp_path / "a_0_keypoints.json").write_text(content)
    with pytest.raises(FileFormatError, match=r"a_0_keypoints.json"):
        read_keypoints(tmp_path)


# --- real files -----------------------------------------------------------------------------------


@pytest.mark.data
def test_mediapipe_files():
    read = read_keypoints(data_dir_or_skip("video_asl") / "again_mediapipe_pose1.npz")
    assert read.keypoints.shape == (77, 19, 2)
    assert read.names[15:] == ("head", "neck", "hand_left", "hand_right")
    assert (read.fps, read.image_size) == (30.0, (640, 480))
    left, right = (read.names.index(f"{side}_shoulder") for side in ("left", "right"))
    assert (read.keypoints[:, left, 0] > read.keypoints[:, right, 0]).all()
