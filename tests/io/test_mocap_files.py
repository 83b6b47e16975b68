"""BVH and C3D: round trips through our and foreign writers, and a pose worked out by hand."""

import sys
import warnings

import numpy as np
import pytest
import torch

from tests.io.skeleton_files import person
from tests.upper_body import bvh_reader
from tests.upper_body.test_bvh import track_of
from torchpose.demo import performer
from torchpose.errors import FileFormatError, MissingDependencyError, SkeletonError
from torchpose.io import read_recording
from torchpose.io._formats.mocap_files import bvh_joint_names
from torchpose.io._recordings import find_recordings
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body._pose_files import write_bvh

# Someone in a T pose who faces +z: offsets in centimetres, arms along ±x.
ARM = """
  {indent}JOINT {side}Shoulder
  {{ OFFSET {x} 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT {side}Arm
    {{ OFFSET {sign}15 0 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT {side}ForeArm
      {{ OFFSET {sign}28 0 0
        CHANNELS 3 Zrotation Xrotation Yrotation
        JOINT {side}Hand
        {{ OFFSET {sign}25 0 0
          CHANNELS 3 Zrotation Xrotation Yrotation
          End Site
          {{ OFFSET {sign}8 0 0 }}
        }}
      }}
    }}
  }}"""
CHANNELS = 6 + 3 * 11


def hierarchy(prefix=""):
    arms = "".join(
        ARM.format(side=side, sign=sign, x=f"{sign}3", indent="")
        for side, sign in (("Left", ""), ("Right", "-"))
    )
    text = f"""HIERARCHY
ROOT Hips
{{ OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Spine
  {{ OFFSET 0 20 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT Neck
    {{ OFFSET 0 30 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT Head
      {{ OFFSET 0 10 0
        CHANNELS 3 Zrotation Xrotation Yrotation
        End Site
        {{ OFFSET 0 20 0 }}
      }}
    }}{arms}
  }}
}}
"""
    text = text.replace("{ OFFSET", "{\nOFFSET").replace(" }", "\n}")
    for word in ("ROOT ", "JOINT "):
        text = text.replace(word, word + prefix)
    return text


def bvh_text(frames, **options):
    rows = "\n".join(" ".join(f"{v:g}" for v in row) for row in frames)
    return f"{hierarchy(**options)}MOTION\nFrames: {len(frames)}\nFrame Time: 0.025\n{rows}\n"


def at_rest(n=1):
    frames = np.zeros((n, CHANNELS))
    frames[:, 1] = 95
    return frames


def write(folder, text, name="a.bvh"):
    (folder / name).write_text(text)
    return folder / name


# --- BVH ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("prefix", ["", "mixamorig:"])
def test_a_pose_by_hand(tmp_path, prefix):
    pytest.importorskip("bvhio")
    frames = at_rest(2)
    # channels: hips 6, spine, neck, head, then shoulder, arm, forearm, hand of the left side
    frames[1, 6 + 3 * 3 + 3] = -90  # left arm about z: it hangs down
    [one] = read_recording(write(tmp_path, bvh_text(frames, prefix=prefix)))
    body = one.upper_body()
    assert (body.neck, body.hand, body.head) == ("neck", "wrist", "head")
    assert one.fps == pytest.approx(40)
    # metres, y down, facing the camera: the left arm at +x; heights from the hips at 0.95
    still = {"shoulder_left": (0.18, -1.25), "elbow_left": (0.46, -1.25), "hand_left": (0.71, -1.25),
             "shoulder_right": (-0.18, -1.25), "neck": (0, -1.45), "head": (0, -1.65)}  # fmt: skip
    hanging = still | {"elbow_left": (0.18, -0.97), "hand_left": (0.18, -0.72)}
    for frame, expected in enumerate((still, hanging)):
        for name, (x, y) in expected.items():
            found = body.joints[frame, UPPER_BODY.index(name)]
            torch.testing.assert_close(found, torch.tensor([x, y, 0.0]).double(), atol=1e-4, rtol=0)
    assert any("centimetres" in note for note in one.notes)
    assert any("middle between its node" in note for note in one.notes)


def test_against_another_forward_kinematics(tmp_path):
    pytest.importorskip("bvhio")
    rng = np.random.default_rng(0)
    frames = at_rest(5) + np.concatenate(
        [rng.normal(size=(5, 3)) * 20, rng.uniform(-50, 50, size=(5, CHANNELS - 3))], 1
    )
    path = write(tmp_path, bvh_text(frames))
    motion = bvh_reader.read_bvh(path)
    [one] = read_recording(path)
    nodes = {"shoulder_left": "LeftArm", "elbow_right": "RightForeArm", "wrist_left": "LeftHand",
             "neck": "Neck", "hip_center": "Hips", "clavicle_right": "RightShoulder"}  # fmt: skip
    for frame in range(5):
        places = bvh_reader.pose(motion, frame)
        for joint, node in nodes.items():
            found = one.rotation.T @ one.joints[frame, one.names.index(joint)]
            np.testing.assert_allclose(found, places[node] / 100, atol=2e-5)


def test_round_trip_of_our_writer(tmp_path):
    pytest.importorskip("bvhio")
    joints = performer(n_frames=40).joints
    write_bvh(track_of(joints), tmp_path / "poses.bvh")
    [one] = read_recording(tmp_path / "poses.bvh")
    body = one.upper_body()
    # the room is turned so that the mean heading faces the camera; lengths and sides are kept
    both = torch.cdist(body.joints, body.joints), torch.cdist(joints, joints)
    torch.testing.assert_close(*both, atol=1e-5, rtol=0)
    assert bool((body.joints[:, 2, 0] > body.joints[:, 5, 0]).all())
    assert (body.hand, one.fps) == ("hand", pytest.approx(30))


def test_results_are_no_recordings(tmp_path):
    write_bvh(track_of(performer(n_frames=3).joints), tmp_path / "poses.bvh")
    take = write(tmp_path, bvh_text(at_rest(2)), "take.bvh")
    assert find_recordings(tmp_path) == [take]


@pytest.mark.parametrize(
    ("nodes", "expected"),
    [
        ("LeftCollar LeftShoulder LeftElbow LeftWrist",
         {"clavicle_left": "LeftCollar", "shoulder_left": "LeftShoulder",
          "elbow_left": "LeftElbow", "wrist_left": "LeftWrist"}),
        ("LeftCollar LeftUpArm LeftLowArm LeftHand",
         {"clavicle_left": "LeftCollar", "shoulder_left": "LeftUpArm",
          "elbow_left": "LeftLowArm", "wrist_left": "LeftHand"}),
        ("rCollar rShldr rForeArm rHand rThumb1",
         {"clavicle_right": "rCollar", "shoulder_right": "rShldr",
          "elbow_right": "rForeArm", "wrist_right": "rHand"}),
        ("clavicle_l upperarm_l lowerarm_l hand_l thigh_l calf_l foot_l",
         {"clavicle_left": "clavicle_l", "shoulder_left": "upperarm_l", "elbow_left": "lowerarm_l",
          "wrist_left": "hand_l", "hip_left": "thigh_l", "knee_left": "calf_l",
          "ankle_left": "foot_l"}),
        ("shoulder_left elbow_left hand_left",
         {"shoulder_left": "shoulder_left", "elbow_left": "elbow_left", "hand_left": "hand_left"}),
        ("Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase RightLeg Spine Spine1 Neck Head LeftHandIndex1",
         {"hip_center": "Hips", "hip_left": "LeftUpLeg", "knee_left": "LeftLeg",
          "ankle_left": "LeftFoot", "toe_left": "LeftToeBase", "knee_right": "RightLeg",
          "spine": "Spine", "neck": "Neck", "head": "Head"}),
    ],
)  # fmt: skip
def test_names_of_nodes(nodes, expected):
    assert bvh_joint_names(nodes.split()) == expected


@pytest.mark.parametrize(
    ("spoil", "error", "word"),
    [
        (lambda t: t[: t.index("MOTION")], FileFormatError, "MOTION"),
        (lambda t: t.replace("Frames: 3", "Frames: 30"), FileFormatError, "ends after 3"),
        (
            lambda t: t.rsplit(" ", 1)[0] + "\n",
            FileFormatError,
            "frame 2: expected 39 numbers, got 38",
        ),
        (lambda t: t.replace("}", "", 1), FileFormatError, "braces"),
        (lambda t: t.replace("OFFSET", "OFSET", 1), FileFormatError, "damaged"),
        (lambda t: t.replace("95", "9x", 1), FileFormatError, "damaged"),
        (lambda t: t.replace("Frame Time", "Time"), FileFormatError, "Frame Time"),
        (lambda t: t.replace("Head", "Top"), SkeletonError, "no node stands for head"),
        (lambda t: "joints", FileFormatError, "HIERARCHY"),
    ],
)
def test_what_is_no_bvh(tmp_path, spoil, error, word):
    pytest.importorskip("bvhio")
    with pytest.raises(error, match=word) as caught:
        read_recording(write(tmp_path, spoil(bvh_text(at_rest(3)))))
    assert "a.bvh" in str(caught.value)


@pytest.mark.parametrize(("name", "library"), [("a.bvh", "bvhio"), ("a.c3d", "c3d")])
def test_without_the_library(tmp_path, monkeypatch, name, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(MissingDependencyError, match=rf"{name}.*pip install {library}"):
        read_recording(write(tmp_path, bvh_text(at_rest(2)), name))


# --- C3D ------------------------------------------------------------------------------------------

JOINTS = ("LShoulder", "RShoulder", "LElbow", "RElbow", "LWrist", "RWrist", "Head", "Neck")


def write_c3d(path, joints, labels, units="mm  ", up="+Z", missing=()):
    """`joints` [T, J, 3] in the file's axes and unit; `missing`: pairs of frame and point."""
    c3d = pytest.importorskip("c3d")
    writer = c3d.Writer(point_rate=100.0, point_units=units)
    writer.set_point_labels(labels)
    writer.set_screen_axis("+X", up)
    for t, frame in enumerate(joints):
        points = np.zeros((len(labels), 5), np.float32)
        points[:, :3] = frame
        for when, point in missing:
            if when == t:
                points[point, 3] = -1
        writer.add_frames([(points, np.empty((0, 0)))])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with path.open("wb") as stream:
            writer.write(stream)
    return path


def z_up(joints):
    """From camera axes to a room with z up in which the person faces -y."""
    return np.stack([joints[..., 0], joints[..., 2], -joints[..., 1]], -1)


@pytest.mark.parametrize(("units", "factor"), [("mm  ", 1000), ("m   ", 1), ("cm  ", 100)])
def test_round_trip_of_c3d(tmp_path, units, factor):
    joints = person(JOINTS, 6, (0.0, 0.0, 0.0))
    labels = [f"S01:{name}" for name in JOINTS] + ["STRN"]
    points = np.concatenate([z_up(joints), np.ones((6, 1, 3))], 1) * factor
    path = write_c3d(tmp_path / "a.c3d", points, labels, units, missing=[(2, 4)])
    [one] = read_recording(path)
    expected = joints.copy()
    expected[2, 4] = np.nan
    np.testing.assert_allclose(one.joints @ one.rotation, z_up(expected), atol=1e-5)
    assert one.names == JOINTS
    assert one.fps == pytest.approx(100)
    assert any("STRN" in note for note in one.notes)
    assert one.upper_body().hand == "wrist"
    facing = one.joints[:, 0] - one.joints[:, 1]
    assert bool((facing[:, 0] > 0.3).all())


def test_what_is_no_c3d(tmp_path):
    joints = 1000 * z_up(person(JOINTS, 30, (0.0, 0.0, 0.0)))
    path = write_c3d(tmp_path / "a.c3d", joints, list(JOINTS))
    whole = path.read_bytes()
    for part in (whole[:100], whole[: len(whole) - 1500], b"", b"\x00" * 2000, b"joints" * 400):
        path.write_bytes(part)
        with pytest.raises(FileFormatError, match=r"a\.c3d"):
            read_recording(path)
    write_c3d(path, joints, [f"M{i}" for i in range(8)])
    with pytest.raises(SkeletonError, match=r"a\.c3d.*got M0, M1"):
        read_recording(path)
    write_c3d(path, joints / 10, list(JOINTS))
    with pytest.raises(FileFormatError, match=r"a\.c3d"):
        read_recording(path)  # centimetres that are called millimetres
