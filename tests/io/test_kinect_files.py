"""Kinect v1, v2 and Azure files, one and several bodies: what a hand-made file says comes back."""

import re

import numpy as np
import pytest
import torch

from tests.io.skeleton_files import (
    azure_text,
    daily_text,
    header_text,
    ntu_text,
    person,
    rows_text,
    to_kinect,
)
from torchpose.errors import FileFormatError, InputError
from torchpose.io import read_recording, read_recordings
from torchpose.io._recordings import find_recordings
from torchpose.skeleton import SKELETONS

V1 = SKELETONS["kinect-v1-20"].joints
V2 = SKELETONS["kinect-v2-25"].joints
AZURE = SKELETONS["azure-32"].joints
NTU_NAME = "S001C002P013R001A023.skeleton"


def write(folder, name, text):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def frames_of(joints, first=0):
    return {first + t: row for t, row in enumerate(joints)}


# --- NTU RGB+D ------------------------------------------------------------------------------------


def test_ntu_with_two_bodies_of_which_one_leaves(tmp_path):
    main, other = person(V2, 8), person(V2, 3, place=(0.9, -0.2, 2.5), seed=1)
    bodies = {
        "72057594037931101": frames_of(to_kinect(main)),
        "7205": frames_of(to_kinect(other), 2),
    }
    states = {("72057594037931101", 4, V2.index("HandLeft")): 1,
              ("72057594037931101", 5, V2.index("HandLeft")): 0}  # fmt: skip
    path = write(tmp_path, NTU_NAME, ntu_text(bodies, 8, states))
    first, second = read_recording(path)
    expected = main.copy()
    expected[5, V2.index("HandLeft")] = np.nan
    np.testing.assert_allclose(first.joints, expected, atol=1e-6)
    np.testing.assert_allclose(second.joints, other, atol=1e-6)
    assert first.weights is not None
    assert first.weights[:, V2.index("HandLeft")].tolist() == [1, 1, 1, 1, 0.5, 0, 1, 1]
    assert (first.fps, first.skeleton, first.action) == (30.0, "kinect-v2-25", "A023")
    assert (first.person_id, second.person_id) == ("NTU-RGB+D#P013", "NTU-RGB+D#P013+1")
    assert (first.companion, second.companion, second.first_frame) == (0, 1, 2)
    assert any("0-1, 5-7" in note for note in second.notes)
    assert first.notes == ()


def test_a_body_that_is_found_again_is_the_same_person(tmp_path):
    joints = to_kinect(person(V2, 9))
    bodies = {"1": {t: joints[t] for t in range(4)}, "2": {t: joints[t] for t in range(6, 9)}}
    [one] = read_recording(write(tmp_path, NTU_NAME, ntu_text(bodies, 9)))
    assert one.joints[[0, 8]].isfinite().all()
    assert one.joints[4:6].isnan().all()
    assert one.weights is not None and not one.weights[4:6].any()
    assert any("1, 2 are taken for one person" in note for note in one.notes)
    assert any("4-5" in note for note in one.notes)


def test_furniture_that_a_sensor_takes_for_people(tmp_path):
    main = to_kinect(person(V2, 8))
    chair = person(V2, 8, place=(0.9, -0.2, 2.5), seed=1)  # y down, so upside down
    bodies = {"1": frames_of(chair), "2": frames_of(main)}
    states = {("1", frame, joint): 1 for frame in range(8) for joint in range(25)}
    [one] = read_recording(write(tmp_path, NTU_NAME, ntu_text(bodies, 8, states)))
    np.testing.assert_allclose(to_kinect(one.joints.numpy()), main, atol=1e-6)
    assert any(note.startswith("other body 1 is left out: after conversion") for note in one.notes)


def test_ntu_of_another_name_is_of_its_folder(tmp_path):
    text = ntu_text({"1": frames_of(to_kinect(person(V2)))}, 6)
    [one] = read_recording(write(tmp_path / "alice", "wave.skeleton", text))
    assert one.person_id == "alice#"
    assert any("folder" in note for note in one.notes)


@pytest.mark.parametrize(
    ("spoil", "error", "word"),
    [
        (lambda t: t[: len(t) // 2], FileFormatError, "line .*expected"),
        (lambda t: t + "0\n", FileFormatError, "expected the end after 6 frames"),
        (lambda t: t.replace("\n25\n", "\n20\n", 1), FileFormatError, "frame 0: expected 25"),
        (lambda t: t.replace(" 2\n", " 7\n"), FileFormatError, "SpineBase.*tracking state"),
        (
            lambda t: t.replace("250.1", "x", 1),
            FileFormatError,
            "line 5, frame 0: expected numbers",
        ),
        (lambda t: "joints\n", FileFormatError, "number of frames, got 'joints'"),
        (lambda t: "", FileFormatError, "the file ends"),
        (lambda t: "2\n0\n0\n", InputError, "nobody"),
    ],
)
def test_what_is_no_ntu_file(tmp_path, spoil, error, word):
    text = ntu_text({"1": frames_of(to_kinect(person(V2)))}, 6)
    with pytest.raises(error, match=word) as caught:
        read_recording(write(tmp_path, NTU_NAME, spoil(text)))
    assert NTU_NAME in str(caught.value)


def test_one_body_twice_in_a_frame(tmp_path):
    text = ntu_text({"1": frames_of(to_kinect(person(V2))), "2": {3: person(V2)[0]}}, 6)
    with pytest.raises(FileFormatError, match="frame 3: body 1 is there twice"):
        read_recording(write(tmp_path, NTU_NAME, text.replace("\n2 0 1 1", "\n1 0 1 1")))


# --- Azure Kinect ---------------------------------------------------------------------------------


def test_azure_in_millimetres(tmp_path):
    joints = person(AZURE, 5)
    text = azure_text({1: frames_of(joints)}, 7, AZURE)
    [one] = read_recording(write(tmp_path / "bob", "take1.json", text))
    np.testing.assert_allclose(one.joints, joints, atol=1e-9)
    assert one.fps == pytest.approx(30, abs=0.01)
    assert (one.skeleton, one.person_id, one.action) == ("azure-32", "bob#", "take1")
    assert one.upper_body().neck == "neck" and one.upper_body().hand == "hand"


def test_azure_confidence_and_two_bodies(tmp_path):
    one, two = person(AZURE, 4), person(AZURE, 2, place=(-0.8, 0, 3), seed=2)
    levels = {(body, t): [2] * 32 for body in (7, 9) for t in range(4)}
    levels[7, 1] = [0, 1, 3] + [2] * 29
    text = azure_text({7: frames_of(one), 9: frames_of(two, 1)}, 4, AZURE, levels)
    first, second = read_recording(write(tmp_path, "a.json", text))
    assert first.weights is not None
    assert first.weights[1, :4].tolist() == [0, 0.5, 1, 1]
    assert first.joints[1, 0].isnan().all() and first.joints[1, 1:].isfinite().all()
    np.testing.assert_allclose(second.joints, two, atol=1e-9)
    assert (second.companion, second.first_frame) == (1, 1)


@pytest.mark.parametrize(
    ("spoil", "word"),
    [
        (lambda t: t[:-40], "truncated or of another kind"),
        (lambda t: "[]", "another kind of JSON"),
        (lambda t: '{"people": []}', "another kind of JSON"),
        (lambda t: t.replace('"body_id"', '"id"'), "frame 0: expected 'body_id'"),
        (
            lambda t: t.replace('"PELVIS", ', ""),
            r"body 1: joint_positions must have shape \[31, 3\]",
        ),
        (
            lambda t: t.replace('"timestamp_usec": 67666', '"timestamp_usec": 5'),
            "frame 2: time stamps",
        ),
        (lambda t: t.replace("[[", '[["x",', 1), "must be numbers"),
    ],
)
def test_what_is_no_azure_file(tmp_path, spoil, word):
    text = azure_text({1: frames_of(person(AZURE, 4))}, 4, AZURE)
    with pytest.raises(FileFormatError, match=word) as caught:
        read_recording(write(tmp_path, "a.json", spoil(text)))
    assert "a.json" in str(caught.value)


# --- Kinect v1 ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["joints_s01_e01.txt", "joints.csv"])
def test_rows_of_kinect_v1(tmp_path, name):
    joints = person(V1, 5)
    text = rows_text(to_kinect(joints), first=range(252, 257))
    [one] = read_recording(write(tmp_path / "carol", name, text))
    np.testing.assert_allclose(one.joints, joints, atol=1e-6)
    assert (one.skeleton, one.fps, one.person_id) == ("kinect-v1-20", 30.0, "carol#")
    assert any("30 frames per second assumed" in note for note in one.notes)


def test_rows_with_time_and_a_fourth_number(tmp_path):
    joints = person(V1, 5)
    text = rows_text(to_kinect(joints), first=[0, 40, 80, 120, 160], fourth=1.0)
    [one] = read_recording(write(tmp_path, "P1_1_1_p06.csv", text))
    assert one.fps == pytest.approx(25)
    assert any("milliseconds" in note for note in one.notes)
    assert one.weights is not None and bool((one.weights == 1).all())
    states = np.full((5, 20, 1), 2.0)
    states[3, 7], states[4, 7] = 1, 0
    [one] = read_recording(write(tmp_path, "b.txt", rows_text(to_kinect(joints), fourth=states)))
    assert one.weights is not None and one.weights[3:, 7].tolist() == [0.5, 0]
    assert one.joints[4, 7].isnan().all()
    for fourth in (7.5, 0.0):
        [one] = read_recording(
            write(tmp_path, "c.txt", rows_text(to_kinect(joints), fourth=fourth))
        )
        assert one.weights is None and any("no tracking state" in note for note in one.notes)


def test_daily_activity(tmp_path):
    main, other = person(V1, 6), person(V1, 2, place=(0.9, 0, 3), seed=1)
    bodies = [frames_of(to_kinect(main)), frames_of(to_kinect(other), 3)]
    first, second = read_recording(
        write(tmp_path / "dan", "a01_s01_e01_skeleton.txt", daily_text(bodies, 7))
    )
    np.testing.assert_allclose(first.joints, main, atol=1e-6)
    np.testing.assert_allclose(second.joints, other, atol=1e-6)
    assert (first.person_id, second.person_id) == ("dan#", "dan#+1")
    text = daily_text(bodies, 7)
    with pytest.raises(FileFormatError, match=r"ends in frame|of which"):
        read_recording(write(tmp_path, "b.txt", text[: len(text) // 2].rsplit("\n", 1)[0]))


def test_rows_of_single_joints_are_refused(tmp_path):
    rows = rows_text(person(V1, 5).reshape(-1, 1, 3), fourth=1.0)
    with pytest.raises(FileFormatError, match=r"a01.*MSR-Action3D.*header"):
        read_recording(write(tmp_path, "a01_s01_e01_skeleton3D.txt", rows))


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("1 2 3 4 5\n", "rows of 60, 61"),
        ("frame,head_x,head_y\n0,1,2\n", "a header with NAME_x.*got frame, head_x, head_y"),
        ("frame,name,x,y,z\n0,head,1,2,3\n", "a row for each frame, got frame, name, x"),
        (rows_text(person(V1, 2)).rsplit(" ", 3)[0], "line 2: expected 60 numbers.*got 57"),
        (rows_text(person(V1, 2)).replace("0", "o", 1), "line 1: expected numbers"),
    ],
)
def test_what_are_no_rows(tmp_path, text, word):
    with pytest.raises(FileFormatError, match=word):
        read_recording(write(tmp_path, "a.txt", text))


# --- tables with a header -------------------------------------------------------------------------


def test_a_table_with_a_header(tmp_path):
    joints = to_kinect(person(V2, 5))
    states = np.full((5, 25), 2.0)
    states[2, 7], states[3, 7] = 1, 0
    joints[1, 3] = np.nan
    extra = {"timestamp": [t / 20 for t in range(5)], "lean": [0] * 5}
    facts = ("person = eve", "action = wave")
    text = header_text(joints, V2, extra, ("state", states), facts)
    [one] = read_recording(write(tmp_path, "table.csv", text))
    joints[3, 7] = np.nan  # not tracked, whatever stands there
    np.testing.assert_allclose(to_kinect(one.joints.numpy()), joints, atol=1e-6)
    assert one.fps == pytest.approx(20)
    assert (one.skeleton, one.person, one.action) == ("kinect-v2-25", "eve", "wave")
    assert one.weights is not None
    assert (float(one.weights[2, 7]), float(one.weights[1, 3])) == (0.5, 0)
    assert any("columns not used: lean" in note for note in one.notes)


def test_a_table_of_other_joints_says_its_axes(tmp_path):
    names = ("head", "left_shoulder", "right_shoulder", "LElbow")
    joints = person(names, 4)
    facts = ("fps = 25", "axes = camera")
    confidence = np.linspace(0, 1, 16).reshape(4, 4)
    text = header_text(joints, names, state=("confidence", confidence), facts=facts, mark=";")
    [one] = read_recording(write(tmp_path, "a.csv", text))
    assert one.fps == 25
    assert one.weights is not None
    np.testing.assert_allclose(one.weights, confidence, atol=1e-6)
    with pytest.raises(FileFormatError, match="axes"):
        read_recording(write(tmp_path, "b.csv", header_text(joints, names)))


def test_a_table_of_several_bodies(tmp_path):
    one, two = person(V2, 4), person(V2, 4, place=(-0.8, 0, 3), seed=1)
    both = to_kinect(np.stack([one, two], 1).reshape(8, 25, 3))
    extra = {"frame": [0, 0, 1, 1, 2, 2, 3, 3], "body_id": [5, 6] * 4}
    path = write(tmp_path, "a.csv", header_text(both[:7], V2, {k: v[:7] for k, v in extra.items()}))
    first, second = read_recording(path)
    np.testing.assert_allclose(first.joints, one, atol=1e-6)
    np.testing.assert_allclose(second.joints, two[:3], atol=1e-6)
    assert second.companion == 1


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda t: t.replace("Head_x", "Head_w", 1), "joint Head has the columns y, z"),
        (lambda t: t.replace("Head_", "Neck_"), "column neck_x is there twice"),
        (lambda t: t.replace("\n", ",1\n").replace(",1\n", "\n", 1), "line 2: expected 75 cells"),
        (lambda t: "# fps = fast\n" + t, "fps must be one positive"),
        (lambda t: t.replace("-0.", "-0:", 1), "line 2: expected numbers"),
    ],
)
def test_what_is_no_table(tmp_path, change, word):
    text = header_text(to_kinect(person(V2, 3)), V2)
    with pytest.raises(FileFormatError, match=word):
        read_recording(write(tmp_path, "a.csv", change(text)))


# --- folders of colleagues ------------------------------------------------------------------------


def test_a_folder_is_a_person(tmp_path):
    write(tmp_path / "alice", "a.csv", rows_text(to_kinect(person(V1))))
    write(tmp_path / "alice", "b.txt", rows_text(to_kinect(person(V1, seed=1))))
    write(tmp_path / "bob", "c.json", azure_text({1: frames_of(person(AZURE))}, 6, AZURE))
    write(tmp_path / "carol", "d.skeleton", ntu_text({"1": frames_of(to_kinect(person(V2)))}, 6))
    write(tmp_path, "notes.txt", "recorded on Monday\n")
    write(tmp_path, "people.json", '{"people": []}')
    write(tmp_path, "keypoints.csv", "frame,head_x,head_y\n0,1,2\n")
    assert len(find_recordings(tmp_path)) == 4
    persons = [r.person_id for r in read_recordings(tmp_path)]
    assert persons == ["alice#", "alice#", "bob#", "carol#"]


# --- units and fillers ----------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "word"), [(1000, "millimetres"), (100, "centimetres")])
def test_units_are_told_by_the_body(tmp_path, factor, word):
    joints = person(V1)
    [one] = read_recording(write(tmp_path, "a.txt", rows_text(to_kinect(joints * factor))))
    np.testing.assert_allclose(one.joints, joints, atol=1e-5)
    assert any(word in note for note in one.notes)


def test_no_size_of_a_body(tmp_path):
    for factor in (30, 39.4, 1e5):  # 39.4: inches
        with pytest.raises(FileFormatError, match=r"a.txt: the body spans.*no person"):
            read_recording(write(tmp_path, "a.txt", rows_text(to_kinect(person(V1) * factor))))
    text = azure_text({1: frames_of(person(AZURE) / 1000 * 39370)}, 6, AZURE)
    with pytest.raises(FileFormatError, match=r"b.json.*(states its unit|no person)"):
        read_recording(write(tmp_path, "b.json", text))


def test_joints_at_zero_are_missing_and_said(tmp_path):
    joints = to_kinect(person(V1, 8))
    joints[2:5, 7] = 0
    joints[6] = 0
    [one] = read_recording(write(tmp_path, "a.txt", rows_text(joints)))
    assert one.joints[2:5, 7].isnan().all() and one.joints[6].isnan().all()
    assert int(one.joints.isnan().any(-1).sum()) == 3 + 20
    assert any("left_hand" in note and "2-4" in note for note in one.notes)
    assert any("no body" in note and " 6" in note for note in one.notes)
    with pytest.raises(InputError, match="zero or NaN"):
        read_recording(write(tmp_path, "b.txt", rows_text(0 * joints)))


def test_a_foot_that_is_never_there_and_a_centre(tmp_path):
    joints = to_kinect(person(V1, 5))
    joints[:, 15] = 0  # a filler 2 m away from the body
    [one] = read_recording(write(tmp_path, "a.txt", rows_text(joints)))
    assert one.joints[:, 15].isnan().all()
    centred = joints - joints[:, 2:3]
    [one] = read_recording(write(tmp_path, "b.txt", rows_text(centred)))
    assert torch.equal(one.joints[:, 2], torch.zeros(5, 3).double())
    assert any("centred on shoulder_center" in note for note in one.notes)


def test_infinite_joints_name_person_and_frame(tmp_path):
    text = header_text(to_kinect(person(V2, 5)), V2, facts=("person = eve",)).splitlines()
    cells = text[4].split(",")
    cells[9] = "inf"
    text[4] = ",".join(cells)
    with pytest.raises(FileFormatError, match=r"a.csv, person eve.*frame 2 is \(Head\)"):
        read_recording(write(tmp_path, "a.csv", "\n".join(text)))


def table(path, stamps, name="time", separator=",", decimal="."):
    """Three joints of two frames, with a column of time stamps."""
    cells = [
        [
            name,
            *(
                f"{joint}_{axis}"
                for joint in ("Head", "ShoulderLeft", "ShoulderRight")
                for axis in "xyz"
            ),
        ]
    ]
    body = ("0.0", "0.7", "2.1", "-0.17", "0.4", "2.1", "0.17", "0.4", "2.1")
    cells += [[cell.replace(".", decimal) for cell in (str(stamp), *body)] for stamp in stamps]
    path.write_text("# axes = kinect\n" + "\n".join(separator.join(row) for row in cells) + "\n")
    return path


@pytest.mark.parametrize(
    ("name", "second"),
    [("timestamp", 10**9), ("Time (s)", 1), ("Time [ms]", 1000), ("time_us", 10**6)],
)
def test_time_columns_of_a_table(tmp_path, name, second):
    path = table(tmp_path / "a.csv", [i * second / 20 for i in range(5)], name)
    [found] = read_recordings(path)
    assert found.fps == pytest.approx(20.0) and not any("not used" in n for n in found.notes)


def iso_stamps(n_frames):
    return [f"2024-05-01T10:00:{i / 20:09.6f}" for i in range(n_frames)]


@pytest.mark.parametrize(
    "shown",
    [
        lambda stamp: stamp,
        lambda stamp: stamp.replace("T", " ") + "0+02:00",  # seven digits, as .NET writes them
        lambda stamp: stamp[:23] + "Z",
        lambda stamp: stamp[11:],  # the time of the day alone
    ],
)
def test_time_stamps_of_iso_8601(tmp_path, shown):
    stamps = [shown(stamp) for stamp in iso_stamps(5)]
    [found] = read_recordings(table(tmp_path / "a.csv", stamps, "Timestamp"))
    assert found.fps == pytest.approx(20.0, rel=1e-5)
    [found] = read_recordings(table(tmp_path / "b.csv", stamps, separator=";", decimal=","))
    assert found.fps == pytest.approx(20.0, rel=1e-5)
    with pytest.raises(FileFormatError, match=r"line 4: .*'noon' to a number or a time as 2024-"):
        read_recordings(table(tmp_path / "c.csv", [*stamps[:1], "noon"]))


@pytest.mark.parametrize("numbers", [3, 4])
def test_time_stamps_of_iso_8601_before_rows(tmp_path, numbers):
    joints = to_kinect(person(V2, 5))
    states = np.full((5, 25, numbers - 3), 2.0)
    rows = np.concatenate([joints, states], -1).reshape(5, -1)
    lines = [",".join([stamp, *map(repr, row)])
             for stamp, row in zip(iso_stamps(5), rows.tolist(), strict=True)]  # fmt: skip
    path = write(tmp_path, "a.csv", "\n".join(lines))
    [found] = read_recordings(path.parent)
    assert found.fps == pytest.approx(20.0)
    np.testing.assert_allclose(to_kinect(found.joints.numpy()), joints)


def test_rows_of_several_bodies_without_a_column_that_tells(tmp_path):
    joints = to_kinect(np.stack([person(V2, 3), person(V2, 3, seed=1)], 1).reshape(6, 25, 3))
    for name, stamps in (("frame", [0, 0, 1, 1, 2, 2]), ("time", [0, 0, 0.1, 0.1, 0.2, 0.2])):
        path = write(tmp_path, "a.csv", header_text(joints, V2, {name: stamps}))
        with pytest.raises(
            FileFormatError, match=f"line 3: the {name} must increase, got 0 after 0.*body_id"
        ):
            read_recording(path)
    path = write(tmp_path, "a.csv", header_text(joints, V2, {"frame": [0, 1, 2, 0, 1, 2]}))
    with pytest.raises(FileFormatError, match="line 5: the frame must increase, got 0 after 2"):
        read_recording(path)
    text = header_text(joints, V2, {"frame": [0, 1, 2, 5, 6, 7]})
    [found] = read_recording(write(tmp_path, "a.csv", text))
    assert found.notes == ("frames that are not in the file, by its numbers: 2, after 2",)
    text = header_text(joints, V2, {"frame": [0, 0, 1, 1, 2, 2], "player": [1, 2] * 3})
    assert len(read_recording(write(tmp_path, "a.csv", text))) == 2


def test_words_of_sensors_for_how_far_to_trust(tmp_path):
    joints = to_kinect(person(V2, 3))
    levels = np.array([0.0, 1.0, 2.0])[:, None].repeat(25, 1)
    joints[0, 0] = np.nan
    text = header_text(joints, V2, state=("tracking_state", levels))
    plain = read_recording(write(tmp_path, "a.csv", text))[0].weights
    words = ("NotTracked", "Inferred", "Tracked")
    azure = [f"K4ABT_JOINT_CONFIDENCE_{word}" for word in ("NONE", "LOW", "MEDIUM")]
    for kind, shown in (
        ("tracking_state", words), ("confidence", azure), ("confidence", range(3))
    ):  # fmt: skip
        head, *rows = header_text(joints, V2, state=("state", levels)).splitlines()
        rows = [",".join(str(shown[i]) if c % 4 == 3 else cell
                         for c, cell in enumerate(row.split(",")))
                for i, row in enumerate(rows)]  # fmt: skip
        text = "\n".join([head.replace("_state", f"_{kind}"), *rows])
        found = read_recording(write(tmp_path, "a.csv", text))[0].weights
        assert found.unique().tolist() == [0.0, 0.5, 1.0] and found.equal(plain)


def test_quoted_cells_and_units_beside_names(tmp_path):
    joints = to_kinect(person(V2, 3))
    text = header_text(1000 * joints, V2).replace("_x,", "_x [mm],").replace(",", '","')
    text = "\n".join(f'"{line}"' for line in text.splitlines())
    [found] = read_recording(write(tmp_path, "a.csv", text))
    np.testing.assert_allclose(to_kinect(found.joints.numpy()), joints, atol=1e-6)


def test_axes_before_names(tmp_path):
    text = header_text(to_kinect(person(V2, 3)), V2)
    [plain] = read_recording(write(tmp_path, "a.csv", text))
    head, rest = text.split("\n", 1)
    turned = re.sub(r"(\w+)_([xyz]|state)\b", r"\2_\1", head)
    [found] = read_recording(write(tmp_path, "a.csv", f"{turned}\n{rest}"))
    assert turned != head and found.joints.equal(plain.joints)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas(tmp_path, separator):
    stamps = [i / 25 for i in range(5)]
    [found] = read_recordings(table(tmp_path / "a.csv", stamps, separator=separator, decimal=","))
    [plain] = read_recordings(table(tmp_path / "b.csv", stamps))
    assert found.joints.equal(plain.joints) and found.fps == pytest.approx(25.0)


def test_an_unknown_header_is_answered_by_the_known_one(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("\n".join([",".join(f"c{i}" for i in range(61)), ",".join(["0.5"] * 61)]))
    with pytest.raises(FileFormatError, match="line 1: expected numbers, or a header with NAME_x"):
        read_recordings(path)
