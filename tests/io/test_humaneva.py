"""HumanEva-I: a folder written in its layout, its joint centres, its clock, and damaged files."""

import numpy as np
import pytest
import torch

from benchmarks import humaneva_files as humaneva
from benchmarks._humaneva_joints import joint_centres
from tests.io import humaneva_files
from tests.io.humaneva_files import write_c3d
from torchpose.errors import FileFormatError, InputError
from torchpose.math._rotations import rotvec_to_matrix

SEGMENTS = ("PEL", "TRX", "HED", "LFE", "LTI", "RFE", "RTI", "LHU", "LRA", "RHU", "RRA")
ORIGINS = {  # millimetres, z up, facing +x, left at +y
    "PEL": (0, 0, 1000), "TRX": (0, 0, 1450), "HED": (0, 0, 1600),
    "LFE": (0, 100, 550), "LTI": (0, 100, 100), "RFE": (0, -100, 550), "RTI": (0, -100, 100),
    "LHU": (0, 200, 1150), "LRA": (0, 200, 900), "RHU": (0, -200, 1150), "RRA": (0, -200, 900),
}  # fmt: skip
ENDS = {
    "LCLO": (0, 200, 1430),
    "RCLO": (0, -200, 1430),
    "LFEP": (0, 100, 980),
    "RFEP": (0, -100, 980),
}


def body_points(n_frames, step=10.0):
    """Points of the body model [S, 3] by label: someone upright who moves along x by `step` a frame."""
    points = {name: np.array(place, float) for name, place in ENDS.items()}
    for segment in SEGMENTS:
        origin = np.array(ORIGINS[segment], float)
        points[f"{segment}O"] = origin
        for axis, direction in (("P", (0, 0, 1)), ("A", (1, 0, 0)), ("L", (0, 1, 0))):
            if f"{segment}{axis}" not in points:
                points[f"{segment}{axis}"] = origin + 40 * np.array(direction, float)
    moved = np.arange(n_frames)[:, None] * np.array([step, 0.0, 0.0])
    return {name: place + moved for name, place in points.items()}


def write_calibration(path):
    R = rotvec_to_matrix(torch.tensor((0.3, -1.2, 0.5), dtype=torch.float64)).numpy()
    K = [[765.0, 0, 330.5], [0, 764.0, 240.25], [0, 0, 1]]
    distortions = (-0.2, 0.1, 0.001, -0.002, 0.0)
    humaneva_files.write_calibration(path, K, R, (120.0, -80.0, 3500.0), distortions)
    return R


@pytest.fixture
def root(tmp_path):
    """One person with one trial, three cameras, static trial, measures, videos, backgrounds."""
    folder = tmp_path / "HumanEva_I"
    person = folder / "S1"
    write_c3d(person / "Mocap_Data" / "Walking_1.c3d", body_points(41), [(20, "LHUO")])
    static = body_points(3, 0.0) | {
        "LSHO": np.tile([0.0, 207.0, 1500.0], (3, 1)), "RSHO": np.tile([0.0, -207.0, 1500.0], (3, 1))
    }  # fmt: skip
    write_c3d(person / "Mocap_Data" / "Static.c3d", static)
    (person / "Mocap_Data" / "S1.mp").write_text(
        "$LKneeWidth = 105\n$LShoulderOffset = 40\n$RShoulderOffset = 50.0\n"
    )
    (person / "Sync_Data").mkdir()
    (person / "Image_Data").mkdir()
    (folder / "Background").mkdir()
    for i, camera in enumerate(("C1", "C2", "C3")):
        write_calibration(person / "Calibration_Data" / f"{camera}.cal")
        text = f"{11 + 2 * i}\n5.0\n2.0\n"  # C3 has its images two frames later than C2
        (person / "Sync_Data" / f"Walking_1_({camera}).ofs").write_text(text)
        (person / "Image_Data" / f"Walking_1_({camera}).avi").write_bytes(b"")
        for k in (1, 2):
            (folder / "Background" / f"Background_{k}_({camera}).avi").write_bytes(b"")
    return folder


def test_a_trial_of_the_layout(root):
    assert humaneva.find_humaneva(root) == [("S1", "Walking", "1")]
    trial = humaneva.read_humaneva(root, "S1", "Walking", 1)
    assert trial.names[0] == "pelvis" and trial.joints.shape[1:] == (15, 3)
    assert trial.cameras.names == ("C1", "C2", "C3") and trial.cameras.size == (480, 640)
    assert sorted(trial.videos) == ["C1", "C2", "C3"] and not trial.notes
    assert [len(trial.backgrounds[c]) for c in ("C1", "C2", "C3")] == [2, 2, 2]
    # the first image of C1 would be 12.5 frames before the mocap: all start with it, at frame one
    assert trial.first_frames == {"C1": 8, "C2": 10, "C3": 12}
    pelvis = trial.joints[:, 0, 0]
    assert float(pelvis[0]) == pytest.approx(-0.05, abs=1e-6)  # 5 cm behind, mocap frame 1
    assert float(pelvis[1] - pelvis[0]) == pytest.approx(0.02, abs=1e-6)  # two mocap frames
    assert bool(trial.joints[10].isnan().all()) and bool(trial.joints[9].isfinite().all())
    clip = trial.clip(2, 6)
    assert len(clip) == 5 and clip.trial == "Walking_1" and clip.up.tolist() == [0, 0, 1]
    torch.testing.assert_close(clip.recorded[0], trial.joints[1])


def test_calibration_projects_as_written(root):
    cv2 = pytest.importorskip("cv2")
    path = root / "S1" / "Calibration_Data" / "C1.cal"
    R = write_calibration(path)
    camera = humaneva.read_calibration(path)
    points = np.random.default_rng(0).normal(size=(7, 3))
    K = np.array([[765.0, 0, 330.5], [0, 764.0, 240.25], [0, 0, 1]])
    expected, _ = cv2.projectPoints(
        1000 * points, cv2.Rodrigues(R)[0], np.array([120.0, -80.0, 3500.0]), K, np.zeros(5)
    )
    found = camera(torch.from_numpy(points))[..., :2].numpy()
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-4)
    np.testing.assert_allclose(camera.distortions.numpy(), (-0.2, 0.1, 0.001, -0.002, 0.0))


def test_joint_centres_by_hand():
    points = body_points(1)
    plain = joint_centres(points, {})[0]
    np.testing.assert_allclose(plain[0], (-50, 0, 1000))
    np.testing.assert_allclose(plain[1], (-25, 0, 1450))  # between both ends of torso and head
    np.testing.assert_allclose(plain[2:5], [(0, 200, 1430), (0, 200, 1150), (0, 200, 900)])
    np.testing.assert_allclose(plain[8:11], [(0, 100, 980), (0, 100, 550), (0, 100, 100)])
    np.testing.assert_allclose(plain[14], (0, 0, 1450 + 316.103))
    bent = joint_centres(points, {"shoulders": 200.0, "LShoulderOffset": 40.0})[0]
    tilt = np.arctan2(100, 450)
    upper = np.array([-50 - 450 * np.sin(tilt), 0, 1000 + 450 * np.cos(tilt)])
    np.testing.assert_allclose(bent[1], (upper + np.array([0, 0, 1450])) / 2)
    tilt = np.arctan2(20, 280)
    elbow = np.array([-280 * np.sin(tilt), 200, 1430 - 280 * np.cos(tilt)])
    np.testing.assert_allclose(bent[3], elbow)
    np.testing.assert_allclose(bent[4], elbow + 250 * np.array([np.sin(tilt), 0, -np.cos(tilt)]))
    np.testing.assert_allclose(bent[5:8], plain[5:8])


def test_what_the_data_set_s_tools_keep(root):
    """The same trial from the .mat that is written instead of the .c3d."""
    io = pytest.importorskip("scipy.io")
    folder = root / "S1" / "Mocap_Data"
    before = humaneva.read_humaneva(root, "S1", "Walking", 1)
    points = body_points(41)
    points["LHUO"][20] = 0
    labels = np.array([f"S1:{name}" for name in points], dtype=object)
    parameters = np.array(
        [{"name": "USED", "data": len(labels)}, {"name": "LABELS", "data": labels}], dtype=object
    )
    groups = np.array(
        [{"name": "ANALOG"}, {"name": "POINT", "Parameter": parameters}], dtype=object
    )
    content = {"Markers": np.stack(list(points.values()), 1), "ParameterGroup": groups}
    io.savemat(folder / "Walking_1.mat", content)
    (folder / "Walking_1.c3d").unlink()
    after = humaneva.read_humaneva(root, "S1", "Walking", 1)
    torch.testing.assert_close(after.joints, before.joints, equal_nan=True, atol=1e-6, rtol=0)
    (folder / "Walking_1.mat").write_bytes(b"no matlab file")
    with pytest.raises(FileFormatError, match=r"Walking_1\.mat: expected Markers"):
        humaneva.read_humaneva(root, "S1", "Walking", 1)


def test_without_offsets_and_measures(root):
    for path in (root / "S1").glob("Sync_Data/*"):
        path.unlink()
    (root / "S1" / "Mocap_Data" / "Static.c3d").unlink()
    (root / "S1" / "Mocap_Data" / "S1.mp").unlink()
    trial = humaneva.read_humaneva(root, "S1", "Walking", 1, ["C2"])
    assert trial.first_frames == {"C2": 0} and len(trial) == 21
    assert len(trial.notes) == 4 and "Static.c3d" in trial.notes[1]


def test_partitions_are_those_of_the_data_set():
    assert len(humaneva.PARTITIONS) == 15
    assert all(1 <= a < b < c for a, b, c in humaneva.PARTITIONS.values())


def test_refusals(root, tmp_path):
    calibration = root / "S1" / "Calibration_Data" / "C1.cal"
    calibration.write_text("1 2 3")
    with pytest.raises(FileFormatError, match="expected 22 finite numbers, got 3"):
        humaneva.read_humaneva(root, "S1", "Walking", 1)
    calibration.write_text(" ".join(["1.0"] * 22))
    with pytest.raises(FileFormatError, match="must be a rotation matrix"):
        humaneva.read_calibration(calibration)
    write_calibration(calibration)
    with pytest.raises(InputError, match=r"expected Jog_1\.c3d or Jog_1\.mat"):
        humaneva.read_humaneva(root, "S1", "Jog", 1)
    offset = root / "S1" / "Sync_Data" / "Walking_1_(C1).ofs"
    offset.write_text("1 1 0")
    with pytest.raises(FileFormatError, match="scale must be positive"):
        humaneva.read_humaneva(root, "S1", "Walking", 1)
    offset.write_text("1 9000 2")
    with pytest.raises(InputError, match="after the motion capture ends"):
        humaneva.read_humaneva(root, "S1", "Walking", 1)
    points = body_points(5)
    del points["TRXO"]
    with pytest.raises(FileFormatError, match="TRXO"):
        joint_centres(points, {})
    with pytest.raises(InputError, match="expected HumanEva-I"):
        humaneva.find_humaneva(tmp_path / "nothing")
