"""What curation drops, says and refuses, on made-up people and on the real Kinect sets."""

import json
import math
from dataclasses import replace

import pytest
import torch

from tests.data import data_dir_or_skip
from tests.learning.curation.bodies import moving, recording
from torchpose.errors import InputError, OverlapError, PriorError
from torchpose.io import read_recordings
from torchpose.io._recordings import find_recordings
from torchpose.learning._curation import CurationSettings, curate
from torchpose.skeleton import UPPER_BODY

WRISTS = tuple(name.replace("hand", "wrist") for name in UPPER_BODY)


def people(n=3, frames=150):
    return [recording(f"p{i}", joints=moving(frames, seed=i)) for i in range(n)]


def test_clean_recordings_pass_untouched():
    recordings = people()
    curated = curate(recordings)
    assert all(a is b for a, b in zip(curated.recordings, recordings, strict=True))
    assert curated.report.drops == ()
    assert curated.report.before == curated.report.after == (3, 3, 450, 3600)


def test_a_report_names_file_person_joint_and_frames():
    joints = moving(150, seed=7)
    joints[40, 0] += 0.4
    joints[60:63, 3] += torch.tensor([0.0, 0.0, 0.3])
    bad = recording("eve", "take", joints, first_frame=100)
    curated = curate([*people(), bad])
    report, text = curated.report, curated.report.text()
    assert "/recordings/eve/take.csv, person eve#: hand_left in 1 frame 140" in text
    assert "head in 3 frames 160-162" in text
    assert report.before.joints - report.after.joints == 4
    assert report.totals() == {"jump": (4, "joints")}
    facts = json.loads(json.dumps(report.facts()))
    assert facts["by_person"] == {"eve#": {"jump": 4}}
    assert facts["settings"]["person_frames"] == 100
    assert curated.recordings[-1].joints[40, 0].isnan().all()
    assert bad.joints.isfinite().all()  # what came is not changed


def test_poses_that_are_no_body():
    joints = moving(150, seed=7)
    joints[90] = joints[90, 4] + 0.01 * torch.randn(
        8, 3, generator=torch.Generator().manual_seed(1)
    )
    bad = recording("eve", "take", joints, first_frame=100)
    curated = curate([*people(), bad], CurationSettings(jump_speeds=None))
    [drop] = curated.report.drops
    assert (drop.reason, drop.frames, drop.joint) == ("no body", "190", "")
    assert "dropped  1 frame: no body" in curated.report.text()
    assert curated.recordings[-1].joints[90].isnan().all()


def test_too_few_frames():
    short = recording("eve", joints=moving(99, seed=9))
    curated = curate([*people(), short])
    assert [r.person_id for r in curated.recordings] == ["p0#", "p1#", "p2#"]
    assert "eve#" in curated.report.text() and "99 frames of this person" in curated.report.text()
    with pytest.raises(InputError, match=r"nothing is left.*eve/a\.csv.*100 are needed"):
        curate([short])
    assert len(curate([short], CurationSettings(person_frames=50)).recordings) == 1
    one_arm = moving(150, seed=9)
    one_arm[:, 6] = math.nan
    assert len(curate([recording("eve", joints=one_arm)]).recordings) == 1
    one_arm[:, 1] = math.nan  # the joint set lacks both elbows, as if it had none
    assert len(curate([recording("eve", joints=one_arm)]).recordings) == 1
    one_arm[:60, 1] = 0.2
    with pytest.raises(InputError, match="nothing is left"):
        curate([recording("eve", joints=one_arm)])


def test_no_persons_size():
    tiny = recording("doll", joints=moving(150, seed=9, size=0.3))
    report = curate([*people(), tiny]).report
    [drop] = report.drops
    assert (drop.reason, drop.person) == ("no person's size", "doll#")
    assert "cm; people have" in drop.why


def test_companions_and_copies():
    friend = recording("p0", "x", moving(150, seed=30), companion=1)
    copy = recording("p1", "copy", moving(150, seed=1)[:120])
    curated = curate([*people(), friend, copy])
    assert len(curated.recordings) == 3
    assert {d.reason for d in curated.report.drops} == {"companion", "duplicate"}
    assert any("also in /recordings/p1/a.csv" in d.why for d in curated.report.drops)
    kept = curate([*people(), friend], CurationSettings(companions=True))
    assert len(kept.recordings) == 4
    with pytest.raises(InputError, match=r"p1/copy.*remove one"):
        curate([*people(), copy], CurationSettings(duplicates="refuse"))
    with pytest.raises(OverlapError, match=r"p9/copy.*p9#.*p1/a.*two persons"):
        curate([*people(), recording("p9", "copy", moving(150, seed=1))])


def test_several_copies_of_one_recording_leave_one():
    same = moving(150, seed=1)
    copies = [recording("p1", name, same) for name in "abcd"]
    curated = curate(copies)
    assert [r.path.name for r in curated.recordings] == ["a.csv"]
    assert len(curated.report.drops) == 3


def test_what_is_refused():
    with pytest.raises(InputError, match="at least one"):
        curate([])
    wrists = recording("eve", joints=moving(seed=9), names=WRISTS)
    with pytest.raises(PriorError, match=r"hand and wrist.*p0/a\.csv.*wrist: /recordings/eve/a"):
        curate([*people(), wrists])
    joints = moving(150, seed=9)
    joints[30, 3, 1] = math.inf
    with pytest.raises(InputError, match=r"eve/a\.csv, person eve#: head is infinite in frame 30"):
        curate([*people(), recording("eve", joints=joints)])
    for change in ({"duplicates": "keep"}, {"face_camera": "frame"}, {"bone_ratios": (0.5,) * 7}):
        with pytest.raises(InputError, match=next(iter(change))):
            curate(people(), CurationSettings(**change))


def test_changes_on_request():
    settings = CurationSettings(face_camera="recording", harmonise=True, mirror=True)
    curated = curate(people(), settings)
    assert len(curated.recordings) == 6
    assert curated.recordings[0].notes[-2:] == ("turned towards the camera, each recording",
                                                "bones scaled to the mean person's")  # fmt: skip
    assert curated.recordings[5].notes[-1] == "mirrored"
    assert curated.report.after.recordings == 3


def test_notes_are_counted_and_folders_of_one_name_are_said(tmp_path):
    same = [
        recording(joints=moving(150, seed=i), path=tmp_path / room / "ann" / "a.csv",
                  notes=("taken for millimetres",))
        for i, room in enumerate(("room1", "room2"))
    ]  # fmt: skip
    notes = curate(same).report.notes
    assert "taken for millimetres (2 recordings)" in notes
    assert any("2 folders count as the one person ann#" in note for note in notes)
    named = [
        replace(recording(day, joints=moving(150, seed=i)), person="ann")
        for i, day in enumerate(("a", "b"))
    ]
    assert any("a#ann, b#ann count as 2 persons" in note for note in curate(named).report.notes)


def test_many_notes_on_single_files_hide_no_other(tmp_path):
    """Notes that differ in numbers alone are one, and those on all recordings come first."""
    recordings = [
        recording(joints=moving(150, seed=i), path=tmp_path / f"room{i % 2}" / "ann" / f"{i}.csv",
                  fps=None if i else 30.0,
                  notes=(f"taken for millimetres (the shoulders are apart {300 + i / 4:g})",
                         f"frames not in the file: {1 + i % 5}, after {', '.join('789'[:1 + i % 3])}",
                         f"columns not used: {'abcdefghijklmnopqrstuvwxyz'[i]}"))
        for i in range(25)
    ]  # fmt: skip
    report = curate(recordings).report
    assert report.notes[0].startswith("2 folders count as the one person ann#")
    assert "no frame rate is stated by" in report.notes[1] and "and 22 more" in report.notes[1]
    assert report.notes[2:4] == (
        "taken for millimetres (the shoulders are apart 300) (25 recordings, numbers of the first)",
        "frames not in the file: 1, after 7 (25 recordings, numbers of the first)",
    )
    assert len(report.notes) == 29 and report.text().endswith("note     and 9 more")


def test_stated_frame_rates_need_no_note():
    assert not any("frame rate" in note for note in curate(people()).report.notes)


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "step", "most"),
    [("burke_kinect", 1, 1e-4), ("kinect_laban", 1, 1e-3), ("kinect_utd_mhad", 29, 3e-3)],
)
def test_little_of_real_recordings_is_dropped(folder, step, most):
    curated = curate(read_recordings(find_recordings(data_dir_or_skip(folder))[::step]))
    report = curated.report
    assert report.after.recordings == report.before.recordings
    assert 1 - report.after.joints / report.before.joints < most


@pytest.mark.data
def test_jumps_put_into_real_recordings_are_found():
    generator = torch.Generator().manual_seed(0)
    found = total = 0
    for one in read_recordings(data_dir_or_skip("kinect_laban")):
        joints = one.upper_body().joints
        before = curate([one], CurationSettings(person_frames=1)).recordings[0].upper_body().joints
        frames = torch.arange(10, len(joints) - 10, 25)
        joint = torch.randint(8, (len(frames),), generator=generator)
        shift = torch.randn(len(frames), 3, generator=generator).double()
        spoilt = joints.clone()
        spoilt[frames, joint] += 0.5 * torch.nn.functional.normalize(shift, dim=-1)
        name = recording("x", joints=spoilt, fps=one.fps)
        after = curate([name], CurationSettings(person_frames=1)).recordings[0].joints
        found += int(after[frames, joint].isnan().any(-1).sum())
        total += len(frames)
        assert int(after.isnan().sum()) <= int(before.isnan().sum()) + 3 * (len(frames) + 3)
    assert found >= 0.95 * total
