"""Recordings: every data set reads, and everything that is none is refused by name."""

import math

import numpy as np
import pytest
import torch

from tests.data import data_dir_or_skip
from torchpose.errors import FileFormatError, InputError, SkeletonError
from torchpose.io import read_recording, read_recordings
from torchpose.io._recordings import find_recordings, notes_on_unread_files
from torchpose.skeleton import SKELETONS, UPPER_BODY

V2 = SKELETONS["kinect-v2-25"].joints


def pose(n: int = 4) -> np.ndarray:
    """Upright eight joints in camera axes, with a little motion."""
    rest = np.zeros((8, 3))
    rest[:, 0] = [0.3, 0.25, 0.17, 0, 0, -0.17, -0.25, -0.3]
    rest[:, 1] = [0.5, 0.25, 0, -0.25, -0.1, 0, 0.25, 0.5]
    return rest + 0.01 * np.random.default_rng(0).normal(size=(n, 8, 3))


def write(path, **changes):
    arrays = {"joints": pose(), "names": np.array(UPPER_BODY), "fps": 30.0, "subject": "p1"}
    arrays.update(changes)
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def kinect_lines(n: int = 5) -> list[str]:
    """Rows of a Kinect v2 file: a person 2 m away, y up, left at smaller x."""
    values = np.zeros((n, 25, 4))
    values[..., 2], values[..., 3] = 2.0, 2
    for name, x, y in (("Head", 0, 0.7), ("Neck", 0, 0.5), ("ShoulderLeft", -0.2, 0.4),
                       ("ShoulderRight", 0.2, 0.4), ("HandLeft", -0.3, 0.0)):  # fmt: skip
        values[:, V2.index(name), :2] = x, y
    values[1, V2.index("ElbowLeft"), 3] = 1
    values[2, V2.index("ElbowLeft"), 3] = 0
    return [f"{10_000_000 + 333_333 * i}," + ",".join(f"{v:g}" for v in row) + ","
            for i, row in enumerate(values.reshape(n, -1))]  # fmt: skip


def matrix_yaml(table: np.ndarray, kind: str = "opencv-matrix") -> str:
    rows = ", ".join(f"{v:.6f}" for v in table.ravel())
    return (
        f"%YAML:1.0\n---\nKinect: !!{kind}\n   rows: {table.shape[0]}\n   cols: {table.shape[1]}\n"
        f"   dt: f\n   data: [ {rows} ]\n"
    )


# --- npz ------------------------------------------------------------------------------------------


def test_the_common_form(tmp_path):
    [recording] = read_recording(write(tmp_path / "a.npz", action="wave", source="github:x/y@1:f"))
    np.testing.assert_array_equal(recording.joints, pose())
    assert recording.joints.dtype == torch.float64
    assert (recording.names, recording.skeleton) == (UPPER_BODY, "upper-body-8")
    assert (recording.fps, recording.person, recording.action) == (30.0, "p1", "wave")
    assert recording.person_id == "github:x/y#p1"
    assert len(recording) == 4
    assert recording.upper_body().neck == "neck"


def test_optional_keys(tmp_path):
    [recording] = read_recording(write(tmp_path / "a.npz", fps=None, subject=None))
    assert (recording.fps, recording.person, recording.weights) == (None, "", None)
    assert recording.person_id == f"{tmp_path.name}#"
    [weighted] = read_recording(write(tmp_path / "b.npz", weights=np.full((4, 8), 0.5)))
    assert weighted.weights is not None
    assert weighted.weights.shape == (4, 8)
    weights = np.ones((4, 8))
    weights[2, 5] = 0
    [untracked] = read_recording(write(tmp_path / "c.npz", weights=weights))
    missing = untracked.joints.isnan().all(-1)
    assert missing.nonzero().tolist() == [[2, 5]] and untracked.weights.tolist() == weights.tolist()
    with pytest.raises(InputError, match="every joint has weight 0 or is missing"):
        read_recording(write(tmp_path / "d.npz", weights=np.zeros((4, 8))))


def test_axes_of_file_argument_and_joint_set(tmp_path):
    kinect = pose() * [-1, -1, 1]
    path = write(tmp_path / "a.npz", joints=kinect, axes="kinect")
    [stated] = read_recording(path)
    np.testing.assert_allclose(stated.joints, pose())
    np.testing.assert_allclose(stated.joints @ stated.rotation, kinect)  # and back
    path = write(tmp_path / "b.npz", joints=kinect)
    with pytest.raises(FileFormatError, match=r"b.npz.*head lies.*below the shoulders"):
        read_recording(path)
    [given] = read_recording(path, axes="kinect")
    torch.testing.assert_close(given.joints, stated.joints)
    with pytest.raises(InputError, match=r"b.npz.*sideways"):
        read_recording(path, axes="sideways")


def test_a_folder_says_the_axes_of_its_recordings(tmp_path):
    """Two devices of different axes in one fit, neither of which its files state."""
    room = np.stack([pose()[..., 0], pose()[..., 2], -pose()[..., 1]], -1)
    for folder, joints, axes in (("a", pose(), "camera"), ("b", room, "z-up\n")):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "x.npz", joints=joints)
        (tmp_path / folder / "axes.txt").write_text(axes)
    of_a, of_b = read_recordings(tmp_path)
    assert of_a.joints.equal(read_recording(tmp_path / "a" / "x.npz", axes="camera")[0].joints)
    assert of_b.joints.equal(read_recording(tmp_path / "b" / "x.npz", axes="z-up")[0].joints)
    assert notes_on_unread_files(tmp_path, find_recordings(tmp_path)) == []
    (tmp_path / "b" / "axes.txt").write_text("up")
    with pytest.raises(FileFormatError, match=r"axes.txt: expected one of camera.*got 'up'"):
        read_recordings(tmp_path)
    assert read_recordings(tmp_path, axes="camera")[0].joints.equal(of_a.joints)


def test_an_unknown_set_needs_axes(tmp_path):
    names = np.array(["head", "lshoulder", "rshoulder"])
    path = write(tmp_path / "a.npz", joints=pose()[:, [3, 2, 5]], names=names)
    with pytest.raises(FileFormatError, match=r"a.npz.*axes"):
        read_recording(path)
    assert read_recording(path, axes="camera")[0].skeleton == ""


def test_mirrored_joints_are_said(tmp_path):
    for name, factor, told in (("right", 1, 0), ("mirrored", -1, 1)):
        [read] = read_recording(write(tmp_path / f"{name}.npz", joints=pose() * [factor, 1, 1]))
        assert sum("mirrored" in note for note in read.notes) == told


def test_a_joint_with_one_coordinate_missing_is_missing(tmp_path):
    joints = pose()
    joints[1, 2, 0] = math.nan
    [recording] = read_recording(write(tmp_path / "a.npz", joints=joints))
    assert recording.joints.isnan().sum() == 3
    assert recording.joints[1, 2].isnan().all()


@pytest.mark.parametrize(("factor", "word"), [(1000, "millimetres"), (100, "centimetres")])
def test_other_units_are_converted_and_said(tmp_path, factor, word):
    [recording] = read_recording(write(tmp_path / "a.npz", joints=pose() * factor))
    np.testing.assert_allclose(recording.joints, pose(), atol=1e-12)
    assert any(word in note for note in recording.notes)
    assert read_recording(write(tmp_path / "b.npz"))[0].notes == ()


@pytest.mark.parametrize(
    ("changes", "error", "word"),
    [
        ({"joints": None}, FileFormatError, "joints"),
        ({"names": None}, FileFormatError, "names"),
        ({"joints": pose()[0]}, FileFormatError, r"\[T, 8, 3\]"),
        ({"joints": pose()[:, :7]}, FileFormatError, "shape"),
        ({"joints": pose()[..., :2]}, FileFormatError, "shape"),
        ({"joints": np.array([["x"] * 8])}, FileFormatError, "numbers"),
        ({"joints": np.array(3.0)}, FileFormatError, "shape"),
        ({"joints": pose(0)}, InputError, "empty"),
        ({"joints": pose() * np.nan}, InputError, "every joint is NaN"),
        ({"joints": np.where(pose() > 0.49, np.inf, pose())}, FileFormatError, "infinite"),
        ({"joints": pose() * 30}, FileFormatError, "no person in metres"),
        ({"joints": pose() / 20}, FileFormatError, "no person in metres"),
        ({"joints": pose() * 0}, InputError, "zero or NaN"),
        ({"names": np.array(["tail", *UPPER_BODY[1:]])}, SkeletonError, "tail.*known are"),
        ({"names": np.array(["head", *UPPER_BODY[1:]])}, SkeletonError, "both head"),
        ({"names": np.array(UPPER_BODY[:7])}, FileFormatError, "7 names"),
        ({"fps": 0.0}, FileFormatError, "fps"),
        ({"fps": math.nan}, FileFormatError, "fps"),
        ({"fps": "fast"}, FileFormatError, "fps"),
        ({"fps": np.array([30.0, 25.0])}, FileFormatError, "fps"),
        ({"weights": np.ones((4, 7))}, FileFormatError, "weights"),
        ({"weights": np.full((4, 8), 2.0)}, FileFormatError, "weights"),
        ({"weights": np.full((4, 8), math.nan)}, FileFormatError, "weights"),
    ],
)
def test_what_is_no_recording(tmp_path, changes, error, word):
    path = write(tmp_path / "walk.npz", **changes)
    with pytest.raises(error, match=word) as caught:
        read_recording(path)
    assert "walk.npz" in str(caught.value)


def test_other_files(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_recording(tmp_path / "none.npz")
    (tmp_path / "a.doc").write_text("joints")
    with pytest.raises(FileFormatError, match=r"a.doc.*\.npz"):
        read_recording(tmp_path / "a.doc")
    (tmp_path / "a.npz").write_bytes(write(tmp_path / "b.npz").read_bytes()[:700])
    with pytest.raises(FileFormatError, match="truncated"):
        read_recording(tmp_path / "a.npz")
    np.savez(tmp_path / "c.npz", joints=np.array([{}], dtype=object), names=np.array(UPPER_BODY))
    with pytest.raises(FileFormatError, match="pickled"):
        read_recording(tmp_path / "c.npz")


# --- Kinect v2 rows -------------------------------------------------------------------------------


def test_kinect_rows(tmp_path):
    path = tmp_path / "Ges.csv"
    path.write_text("\n".join(kinect_lines()))  # no newline at the end of the last row
    [recording] = read_recording(path)
    assert recording.fps == pytest.approx(30, abs=1e-3)
    assert (recording.skeleton, recording.action) == ("kinect-v2-25", "Ges")
    elbow = V2.index("ElbowLeft")
    assert recording.weights is not None
    assert recording.weights[:, elbow].tolist() == [1, 0.5, 0, 1, 1]
    assert recording.joints[2, elbow].isnan().all()
    assert recording.joints.isnan().sum() == 3
    left = recording.joints[0, V2.index("ShoulderLeft")]
    torch.testing.assert_close(left, torch.tensor([0.2, -0.4, 2.0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda line: line[:200], "line 3.*101 numbers"),
        (lambda line: line.replace(",2,", ",two,", 1), "line 3.*two"),
        (lambda line: line + "5,", "line 3.*102"),
        (lambda line: line.replace(",2,2,", ",2,nan,"), "line 3.*tracking states"),
        (lambda line: "1" + line[line.index(",") :], "line 3.*time stamps"),
        (lambda line: "time" + line[line.index(",") :], "line 3.*time"),
    ],
)
def test_a_bad_row_is_named(tmp_path, spoil, word):
    lines = kinect_lines()
    lines[2] = spoil(lines[2])
    (tmp_path / "Ges.csv").write_text("\n".join(lines))
    with pytest.raises(FileFormatError, match=rf"Ges.csv, {word}"):
        read_recording(tmp_path / "Ges.csv")


def test_no_rows_and_no_text(tmp_path):
    (tmp_path / "a.csv").write_text("\n")
    with pytest.raises(InputError, match="empty"):
        read_recording(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(FileFormatError, match=r"b.csv"):
        read_recording(tmp_path / "b.csv")


# --- OpenCV matrix --------------------------------------------------------------------------------


def test_the_authors_matrix(tmp_path):
    pytest.importorskip("cv2")
    path = tmp_path / "Joints.yaml"
    path.write_text(matrix_yaml(pose().reshape(4, 24)))
    [recording] = read_recording(path)
    np.testing.assert_allclose(recording.joints, pose(), atol=1e-6)
    assert (recording.names, recording.fps) == (UPPER_BODY, 30.0)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a: 1\n",
        "%YAML:1.0\n---\nname: opencv-matrix\n",
        matrix_yaml(np.zeros((4, 23))),
        matrix_yaml(np.zeros((0, 24))),
        matrix_yaml(pose().reshape(4, 24))[:300],
        matrix_yaml(pose().reshape(4, 24)).replace("rows: 4", "rows: 5"),
        matrix_yaml(pose().reshape(4, 24)).replace("rows: 4", "rows: x"),
    ],
)
def test_what_is_no_such_matrix(tmp_path, text):
    pytest.importorskip("cv2")
    path = tmp_path / "Joints.yaml"
    path.write_text(text)
    with pytest.raises((FileFormatError, InputError), match=r"Joints.yaml"):
        read_recording(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileFormatError, match=r"Joints.yaml"):
        read_recording(path)


def test_opencv_writes_what_is_read(tmp_path):
    cv2 = pytest.importorskip("cv2")
    joints = pose().reshape(4, 24)
    for kind in (np.float32, np.float64):
        storage = cv2.FileStorage(str(tmp_path / "a.yaml"), cv2.FILE_STORAGE_WRITE)
        storage.write("joints", joints.astype(kind))
        storage.release()
        [one] = read_recording(tmp_path / "a.yaml")
        assert np.array_equal(one.joints.reshape(4, 24), joints.astype(kind).astype(float))


# --- folders --------------------------------------------------------------------------------------


def test_find_recordings(tmp_path):
    deep = tmp_path / "set" / "deep"
    deep.mkdir(parents=True)
    write(tmp_path / "set" / "b.npz")
    write(tmp_path / "set" / "a.npz")
    (tmp_path / "set" / "raw.csv").write_text("\n".join(kinect_lines()))  # passed over beside .npz
    (tmp_path / "set" / "README.md").write_text("joints")
    np.savez(tmp_path / "set" / "other.npz", keypoints=np.zeros(3))
    (deep / "Ges.csv").write_text("\n".join(kinect_lines()))
    (deep / "keypoints.csv").write_text("frame,head_x,head_y\n0,1,2\n")
    found = find_recordings(tmp_path)
    assert [p.name for p in found] == ["a.npz", "b.npz", "Ges.csv"]
    assert find_recordings([tmp_path / "set", tmp_path, found[1]]) == found
    assert [len(r) for r in read_recordings([tmp_path])] == [4, 4, 5]
    beside, other = notes_on_unread_files(tmp_path, find_recordings(tmp_path))
    assert (
        "holds recordings as .npz" in beside and beside.count(".csv") == 1 and "raw.csv" in beside
    )
    assert "do not begin as a recording does" in other and "keypoints.csv" in other
    both = [tmp_path, tmp_path / "set" / "raw.csv"]
    assert notes_on_unread_files(both, find_recordings(both)) == [other]
    assert notes_on_unread_files(found, find_recordings(found)) == []


def test_archives_under_other_keys_are_said(tmp_path):
    """The recordings of a person were missing from fits without a word."""
    write(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", positions=pose(), joint_names=np.array(["head"]))
    np.savez(tmp_path / "keypoints.npz", keypoints=np.zeros(3))
    np.savez(tmp_path / "scores-1.npz", filtered=np.zeros(3), smoothed=np.zeros(3))
    [note] = notes_on_unread_files(tmp_path, find_recordings(tmp_path))
    expected = (
        f"no arrays joints and names: {tmp_path / 'b.npz'}; the first has positions, joint_names"
    )
    assert note == f"not read, since they hold {expected}"
    (tmp_path / "a.npz").unlink()
    with pytest.raises(InputError, match=r"found none in .*; not read, .* the first has positions"):
        find_recordings(tmp_path)


def test_nothing_found(tmp_path):
    with pytest.raises(InputError, match="found none"):
        find_recordings(tmp_path)
    with pytest.raises(InputError, match="no paths"):
        find_recordings([])
    with pytest.raises(InputError, match="no such"):
        find_recordings([tmp_path / "none"])


def test_a_damaged_file_in_a_folder_is_not_passed_over(tmp_path):
    (tmp_path / "a.npz").write_bytes(write(tmp_path / "b.npz").read_bytes()[:700])
    assert len(find_recordings(tmp_path)) == 2
    with pytest.raises(FileFormatError, match=r"a.npz"):
        read_recordings(tmp_path)


# --- the data sets --------------------------------------------------------------------------------

SETS = {
    # folder: files, frames, (neck, hand, head), of which every n-th file is read here
    "burke_kinect": (1, 3687, ("mid-shoulder", "hand", "head"), 1),
    "kinect_laban": (7, 1421, ("neck", "hand", "head"), 1),
    "kinect_utd_mhad": (861, 58299, ("neck", "hand", "head"), 41),
    "mocap_berkeley_mhad": (300, 75734, ("low-neck", "wrist", None), 29),
    "mocap_cmu_actions": (38, 25080, ("neck", "wrist", "head"), 5),
    "mocap_cmu_walk": (69, 26100, ("neck", "hand", "head"), 5),
    "multicam_pose2sim": (1, 100, ("low-neck", "wrist", "head"), 1),
    "utd_mhad_silhouettes": (216, 14674, ("neck", "hand", "head"), 31),
}


@pytest.mark.data
@pytest.mark.parametrize("folder", SETS)
def test_every_set_reads(folder):
    files, frames, kinds, step = SETS[folder]
    paths = find_recordings(data_dir_or_skip(folder))
    assert len(paths) == files
    recordings = [r for path in paths[::step] for r in read_recording(path)]
    if step == 1:
        assert sum(map(len, recordings)) == frames
    facing = 0
    for recording in recordings:
        upper = recording.upper_body()
        assert (upper.neck, upper.hand, upper.head) == kinds
        absent = [] if kinds[2] else [3]
        assert upper.joints.isnan().any(-1).any(0).nonzero().flatten().tolist() == absent
        left, right = upper.joints[:, 2], upper.joints[:, 5]
        width = (left - right).norm(dim=-1).median()
        assert 0.2 < float(width) < 0.5
        facing += bool((left - right)[:, 0].median() > 0)
        assert recording.fps is not None
        assert 29 < recording.fps < 121
    assert facing >= 0.9 * len(recordings)  # someone who throws stands sideways


@pytest.mark.data
def test_frames_that_a_kinect_dropped_are_said():
    [wave] = read_recording(data_dir_or_skip("kinect_laban") / "Ges01_wavehand.csv")
    assert wave.notes == ("frames that are not in the file, by its time stamps: 2, after 88, 95",)


@pytest.mark.data
def test_the_authors_file_in_both_forms():
    pytest.importorskip("cv2")
    folder = data_dir_or_skip("burke_kinect")
    [yaml] = read_recording(folder / "KinectJoints.yaml")
    [npz] = read_recording(folder / "kinect_joints.npz")
    assert torch.equal(yaml.joints, npz.joints)
    assert yaml.names == npz.names


@pytest.mark.data
def test_kinect_axes_on_a_real_file():
    """By hand: x and y change sign, z stays."""
    path = sorted(data_dir_or_skip("kinect_utd_mhad").glob("*.npz"))[0]
    [recording] = read_recording(path)
    with np.load(path) as file:
        expected = file["joints"].astype(np.float64) * [-1, -1, 1]
    np.testing.assert_allclose(recording.joints, expected, atol=1e-12)


@pytest.mark.data
def test_one_person_in_two_sets_has_one_identity():
    first = read_recording(sorted(data_dir_or_skip("kinect_utd_mhad").glob("s03*"))[0])[0]
    second = read_recording(sorted(data_dir_or_skip("utd_mhad_silhouettes").glob("s03*"))[0])[0]
    other = read_recording(sorted(data_dir_or_skip("mocap_berkeley_mhad").glob("s03*"))[0])[0]
    assert first.person_id == second.person_id
    assert first.person == other.person
    assert first.person_id != other.person_id
