"""The protocols over persons, on tiny data sets, and on a few real sequences where they are there."""

import json
import math
import shutil
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import uncommon_poses
from tests.data import few_recordings
from tests.evaluation.recordings import V1, poses, small_recipe, write_one, write_people
from torchpose.cli import _evaluate as evaluate
from torchpose.errors import InputError, OutputError, OverlapError, PriorError
from torchpose.evaluation import _cross_dataset as cross_dataset
from torchpose.evaluation import _learning_curve as learning_curve
from torchpose.evaluation import _leave_one_person_out as leave_one_person_out
from torchpose.evaluation import _person_recordings as persons_module
from torchpose.evaluation import _unseen as unseen
from torchpose.evaluation._learning_curve import cyclic_subsets, halves
from torchpose.evaluation._person_recordings import POSE_CLASSES
from torchpose.evaluation._person_tables import mean_error
from torchpose.evaluation._trials import _version_of
from torchpose.io import read_recordings
from torchpose.priors import load_prior
from torchpose.skeleton import SKELETONS, UPPER_BODY

MHAD = SKELETONS["mhad-16"].joints
FRAMES = 26  # of a recording; completing joints takes a hundred of the persons to train on


def recipe(recordings, n_components=2, calibration_folds=0, **options):
    """`small_recipe` that takes the sizes of windows and of a calibration, which it has none of."""
    for name in ("window_components", "window_samples", "drawn_pieces"):
        options.pop(name, None)
    return small_recipe(recordings, n_components, **options)


def write_mocap(folder, persons, n_frames=40):
    """MHAD's joints: y up, wrists, a low neck and no head."""
    folder.mkdir(parents=True)
    for number, person in enumerate(persons):
        (people,) = [write_people(folder / "v1" / person, (person,), n_frames, first=4 + number)]
        with np.load(next(people.glob("*.npz"))) as arrays:
            named = dict(zip(V1, np.moveaxis(arrays["joints"], 1, 0), strict=True))
        middle = (named["left_shoulder"] + named["right_shoulder"]) / 2
        named["neck"] = middle + 0.4 * (named["shoulder_center"] - middle)
        named |= {f"{side}_toe": named[f"{side}_foot"] for side in ("left", "right")}
        joints = np.stack([named[name] for name in MHAD], 1) * (-1.0, 1.0, -1.0)
        np.savez(
            folder / f"{person}_a01_r{number}.npz", joints=joints.astype(np.float32),
            names=np.array(MHAD), fps=30.0, subject=person, action="demo",
            source="example/mocap@0:x",
        )  # fmt: skip
        shutil.rmtree(folder / "v1")
    return folder


def write_table(path, body, stranger=()):
    """A table of the eight joints, with another person beside the one whose file it is."""
    path.parent.mkdir(parents=True)
    columns = [f"{name}_{axis}" for name in UPPER_BODY for axis in "xyz"]
    rows = ["# axes = camera", "# fps = 30", ",".join(["frame", "body_id", *columns])]
    for number, bodies in enumerate((body, stranger)):
        rows += [
            ",".join(map(str, [frame, number, *joints.flatten().tolist()]))
            for frame, joints in enumerate(bodies)
        ]
    path.write_text("\n".join(rows))


def made_up_scores(jobs, *_):
    """Scores of jobs, none of which is run: three frames of every person."""
    values = torch.full((3, 8), 0.05)
    score = unseen.Scored(values, values, values[:, None].expand(3, 2, 8) > 1, values[:, 0],
                          values[:, :2].long(), 2 * values)  # fmt: skip
    return [dict.fromkeys(job.tests, score) for job in jobs]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """UTD, burke and MHAD in small."""
    folder = tmp_path_factory.mktemp("data")
    names = ("s1", "s2", "s7", "s8")
    write_people(folder / "kinect_utd_mhad", names, n_frames=FRAMES, n_sequences=2)
    write_one(folder / "burke_kinect", FRAMES, seed=14)
    write_mocap(folder / "mocap_berkeley_mhad", ("s1", "s9", "s10"))
    return folder


@pytest.fixture(scope="module")
def left_out(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("loo")
    report = leave_one_person_out.run(
        [data / "kinect_utd_mhad", data / "burke_kinect"], out, progress=False, recipe=recipe,
        n_components=2,
    )  # fmt: skip
    return report, out


@pytest.mark.slow
def test_one_line_for_each_person(left_out):
    report, out = left_out
    table = report["persons"]
    persons = ["one", "s1", "s2", "s7", "s8"]
    assert list(table.rows) == [*persons, "mean", "standard deviation", "all frames"]
    errors = [table[name, "filtered"] for name in persons]
    assert table["mean", "filtered"] == pytest.approx(np.mean(errors))
    assert table["standard deviation", "filtered"] == pytest.approx(np.std(errors, ddof=1))
    frames = [table[name, "frames"] for name in persons]
    assert frames == [FRAMES, *4 * [2 * FRAMES]] and table["all frames", "frames"] == 9 * FRAMES
    pooled = np.average(errors, weights=frames)
    assert table["all frames", "filtered"] == pytest.approx(pooled, rel=1e-5)
    for name in persons:
        assert 0 <= table[name, "in 50 %"] <= table[name, "in 90 %"] <= 100
        assert math.isfinite(table[name, "log-lik."])
    classes = report["pose_classes"]
    shares = [classes[name, "arm-frames (%)"] for name in POSE_CLASSES]
    assert sum(shares) == pytest.approx(100)
    assert json.loads((out / "report.json").read_text())["tables"]["persons"]["rows"]["s1"]
    assert (out / "persons.png").stat().st_size > 1000
    assert len(list(out.glob("prior-*.safetensors"))) == 5


def test_a_killed_run_goes_on(left_out, data):
    report, out = left_out
    kept = sorted(out.glob("*-*.*"))
    next(out.glob("scores-*.npz")).unlink()
    again = leave_one_person_out.run(
        [data / "kinect_utd_mhad", data / "burke_kinect"], out, progress=False, recipe=recipe,
        n_components=2,
    )  # fmt: skip
    assert sorted(out.glob("*-*.*")) == kept
    assert again["persons"].rows == report["persons"].rows


def test_only_persons_whom_files_name_are_scored(tmp_path, monkeypatch):
    """Strangers in their files are neither trained on nor tested, and nobody is known by two names."""
    ran = []
    monkeypatch.setattr(
        leave_one_person_out, "run_jobs", lambda jobs, *_: ran.extend(jobs) or made_up_scores(jobs)
    )
    write_table(tmp_path / "alice" / "both.csv", poses(30, 0), stranger=poses(12, 2))
    write_table(tmp_path / "bob" / "own.csv", poses(30, 4))
    report = leave_one_person_out.run(tmp_path, tmp_path / "out", progress=False)
    tests = {job.label: [len(r) for r in job.tests[job.label]] for job in ran}
    assert tests == {"alice": [30], "bob": [30]}
    persons = report["persons"]
    assert (persons["alice", "mean pose"], persons["mean", "filtered"]) == pytest.approx((10, 5))
    assert "The mean poses of the priors are 10.00 cm off" in report.findings[0]
    assert [[r.person_id for r in job.train] for job in ran] == [["bob#"], ["alice#"]]
    assert report.findings[-1].startswith("Other people in both.csv are left out (1 recording)")
    people = read_recordings(tmp_path / "bob")[0]
    one, other = (replace(people, person="s1", source=source) for source in "ab")
    assert list(persons_module.by_person([one, other])) == ["a#s1", "b#s1"]


def test_who_cannot_be_scored_is_told_before_any_fit(data, tmp_path):
    home = shutil.copytree(data / "kinect_utd_mhad", tmp_path / "home")
    with np.load(home / "s1_a01_t0.npz") as archive:
        arrays = dict(archive)
    joints = arrays["joints"].copy()
    joints[::5, V1.index("left_hand")] = np.nan
    np.savez(home / "z_a01_t0.npz", **arrays | {"subject": "z", "joints": joints})
    (home / "s1_a01_t0.npz").unlink()

    def fit(*_, **__):
        raise AssertionError("nothing is to be fitted")

    with pytest.raises(InputError, match="z: no 10 frames in a row have all eight joints"):
        leave_one_person_out.run(home, tmp_path / "out", progress=False, recipe=fit)


@pytest.mark.parametrize("protocol", [leave_one_person_out, learning_curve])
def test_hands_beside_wrists_are_refused_before_any_fit(protocol, data, tmp_path):
    write_mocap(tmp_path / "mocap", ("carl",))
    folders = [
        data / "kinect_utd_mhad" / "s1_a01_t0.npz",
        data / "burke_kinect",
        tmp_path / "mocap",
    ]
    with pytest.raises(PriorError, match=r"what a hand is, got hand and wrist .*carl_a01_r0\.npz"):
        protocol.run(folders, tmp_path / "out", progress=False)
    assert not list((tmp_path / "out").glob("*"))


def test_a_data_set_of_one_person_is_refused(data, tmp_path):
    one = write_people(tmp_path / "one", ("ann",), n_frames=FRAMES, first=9)
    with pytest.raises(
        InputError, match=r"one: .* to test \(ann\) and of others to train on, found ann"
    ):
        cross_dataset.run([one, data / "kinect_utd_mhad"], tmp_path / "out", progress=False)


def test_names_may_have_digits_that_are_no_numbers(tmp_path):
    write_table(tmp_path / "own.csv" / "own.csv", poses(30, 0))
    people = read_recordings(tmp_path)[0]
    named = [replace(people, person=name) for name in ("P²", "P10", "P9")]
    assert list(persons_module.by_person(named)) == ["P9", "P10", "P²"]


def test_scores_of_another_release_are_made_again(tmp_path, monkeypatch):
    """Its trackers gave other numbers, which were taken for those of this one."""
    made = []
    job = unseen.Job("", [], {"a": []}, {})
    score = made_up_scores([job])[0]["a"]
    score = score._replace(inside=score.inside.float())
    monkeypatch.setattr(unseen, "score_person", lambda *_: made.append(score) or score)
    prior = load_prior("kinect-upper-body-small")
    for version, count in (("1", 1), ("1", 1), ("2", 2)):
        monkeypatch.setattr(unseen, "package_version", lambda version=version: version)
        unseen._scored_at(prior, job, 30.0, [torch.zeros(10, 8, 3)], tmp_path, False)
        assert len(made) == count


def test_mirrored_recordings_are_said(tmp_path):
    for name, factor in (("a", 1.0), ("b", -1.0)):
        joints = poses(8, 0).numpy() * [factor, 1, 1]
        np.savez(tmp_path / f"{name}.npz", joints=joints, names=UPPER_BODY, subject=name, fps=30.0)
    [note] = persons_module.read_known_persons(tmp_path).notes
    assert note.startswith("In 1 of 2 recordings:") and "mirrored" in note


def test_copies_under_two_persons_are_refused(data, tmp_path):
    """Else what is tested is in the training."""
    home = shutil.copytree(data / "kinect_utd_mhad", tmp_path / "home")
    with np.load(home / "s1_a01_t0.npz") as arrays:
        np.savez(home / "s2_copy.npz", **dict(arrays) | {"subject": "s2"})
    more = write_people(tmp_path / "more", ("z",), first=9)
    for protocol, folders in (
        (leave_one_person_out, home), (learning_curve, home), (cross_dataset, [more, home]),
    ):  # fmt: skip
        with pytest.raises(OverlapError, match="under two persons would leak"):
            protocol.run(folders, tmp_path / "out", progress=False)
    with pytest.raises(OverlapError, match="under two persons would leak"):
        learning_curve.run(
            data / "kinect_utd_mhad", tmp_path / "out", progress=False, counts=(4,),
            more=(str(write_people(tmp_path / "copied", ("y",), FRAMES)),),
        )  # fmt: skip


@pytest.mark.parametrize("protocol", [leave_one_person_out, learning_curve, cross_dataset])
def test_counts_are_checked_before_any_work(protocol, tmp_path):
    for setting in ("every", "workers"):
        with pytest.raises(InputError, match=f"{setting} must be at least 1, got 0"):
            protocol.run(tmp_path / "nothing", tmp_path, progress=False, **{setting: 0})


def test_leaving_out_needs_two_persons(data, tmp_path):
    with pytest.raises(InputError, match="two persons or more"):
        leave_one_person_out.run(data / "burke_kinect", tmp_path, progress=False)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        leave_one_person_out.run(data, tmp_path / "file", progress=False)


def test_subsets_are_balanced():
    names = [f"s{i}" for i in range(8)]
    for count in (1, 2, 4, 7):
        subsets = cyclic_subsets(names, count, 8)
        assert len({frozenset(s) for s in subsets}) == 8
        assert all(len(set(s)) == count for s in subsets)
        trained = [sum(name in s for s in subsets) for name in names]
        assert trained == [count] * 8
    assert [len(s) for s in cyclic_subsets(names, 9, 8)] == [7] * 8
    assert cyclic_subsets(names, 2, 4) == [["s0", "s1"], ["s2", "s3"], ["s4", "s5"], ["s6", "s7"]]


def test_halves_by_trial(data):
    recordings = persons_module.by_person(read_recordings(data / "kinect_utd_mhad"))["s1"]
    first, second = halves(recordings)
    assert (first, second) == ([recordings[0]], [recordings[1]])
    other = [replace(r, action="other") for r in recordings]
    first, second = halves([*recordings, *other, other[0]])
    assert len(first) == 3 and len(second) == 2
    assert not {id(r) for r in first[:1]} & {id(r) for r in second[:1]}


def second_recipe(recordings, **options):
    """Another recipe: more components."""
    return recipe(recordings, **(options | {"n_components": 3}))


@pytest.mark.slow
def test_learning_curve(data, tmp_path):
    report = learning_curve.run(
        data, tmp_path, progress=False, counts=(1, 3, 4), n_own=1, n_subsets=2, every=2,
        recipes=[("new", recipe), ("first", second_recipe)],
    )  # fmt: skip
    curve = report["curve"]
    assert len(curve.rows) == 6
    assert curve["new, 1 person", "fits"] == 2 and curve["new, 1 person", "tests"] == 6
    assert curve["new, 3 persons", "tests"] == 2
    assert math.isnan(curve["new, 3 persons", "± drawn"])  # each is tracked by one fit only
    assert curve["new, 1 person", "± drawn"] > 0 and curve["new, 4 persons", "filtered"] > 0
    assert report.settings["further training persons"] == ["one"]
    own = report["own"]
    assert len(own.rows) == 8
    assert all(row[0] > 0 for row in own.rows.values())
    assert own["new: the person's first half, on others", "tests"] == 3
    assert any("'new' against 'first'" in line for line in report.findings)
    assert (tmp_path / "learning-curve.png").stat().st_size > 1000


def test_persons_with_one_recording_have_no_prior_of_their_own(data, tmp_path, monkeypatch):
    monkeypatch.setattr(learning_curve, "run_jobs", made_up_scores)
    home = shutil.copytree(data / "kinect_utd_mhad", tmp_path / "home")
    for name in ("s1", "s7"):
        (home / f"{name}_a01_t1.npz").unlink()
    report = learning_curve.run(
        home, tmp_path / "out", progress=False, counts=(1,), n_subsets=1, recipes=[("r", recipe)]
    )
    own = report["own"]
    assert own["the person's first half, on the person", "tests"] == 2  # s2, s8
    assert own["the person's first half, on others", "tests"] == 2
    assert any("with one recording only: s1, s7." in line for line in report.findings)
    assert report["curve"]["1 person", "mean pose"] == pytest.approx(10.0)
    assert own["the person's first half, on others", "mean pose"] == pytest.approx(10.0)


def test_the_mean_pose_stands_beside_other_data_sets(data, tmp_path, monkeypatch):
    monkeypatch.setattr(cross_dataset, "run_jobs", made_up_scores)
    folders = [
        write_people(tmp_path / name, persons, n_frames=60, first=first)
        for first, name, persons in ((0, "x", "ab"), (2, "y", "cd"))
    ]
    added = (str(data / "mocap_berkeley_mhad"),)
    report = cross_dataset.run(folders, tmp_path / "out", progress=False, added=added)
    for table, row in (("cross", "x → y (d)"), ("added", "x: alone")):
        assert report[table][row, "mean pose"] == pytest.approx(10.0)
        assert report[table][row, "filtered"] == pytest.approx(5.0)


def test_no_filter_that_draws_is_calibrated(data, tmp_path, monkeypatch):
    """None of them tracks the person who is left out."""
    asked = []

    def run_jobs(jobs, *_):
        asked.extend(jobs)
        return made_up_scores(jobs)

    monkeypatch.setattr(leave_one_person_out, "run_jobs", run_jobs)
    leave_one_person_out.run(data / "kinect_utd_mhad", tmp_path, progress=False)
    assert {job.settings["calibration_folds"] for job in asked} == {6}
    assert {job.settings["drawn_pieces"] for job in asked} == {0}


def test_recordings_are_curated_as_for_a_fit(tmp_path):
    """A hand that is elsewhere for a frame is neither fitted to nor scored; hands beside wrists are taken."""
    folder = write_people(tmp_path, ("ann", "bob"), n_frames=FRAMES)
    file = next(folder.glob("ann*"))
    with np.load(file) as archive:
        arrays = {key: archive[key].copy() for key in archive}
    arrays["joints"][12, arrays["names"].tolist().index("left_hand")] += 1.5
    np.savez(file, **arrays)
    write_mocap(tmp_path / "mocap", ("carl",))
    known = persons_module.read_known_persons(folder)
    assert [len(r) for r in known.recordings] == [FRAMES, FRAMES, 40]
    missing = known.recordings[0].upper_body().joints.isnan().any(-1).nonzero().tolist()
    assert missing == [[12, UPPER_BODY.index("hand_left")]]
    assert "Curation left out 1 joint (jump)" in known.notes[-1]
    plain = persons_module.read_known_persons(folder, curated=False)
    assert not plain.recordings[0].upper_body().joints.isnan().any()
    assert not any("Curation" in note for note in plain.notes)


def test_a_copy_is_not_in_the_other_half_of_a_person(data, tmp_path, monkeypatch):
    monkeypatch.setattr(learning_curve, "run_jobs", made_up_scores)
    home = shutil.copytree(data / "kinect_utd_mhad", tmp_path / "home")
    shutil.copy(home / "s1_a01_t0.npz", home / "s1_a01_t9.npz")
    options = {"progress": False, "counts": (1,), "n_subsets": 1, "recipes": [("r", recipe)]}
    with pytest.raises(OverlapError, match=r"s1_a01_t9.*would be in the test"):
        learning_curve.run(home, tmp_path / "out", curate=False, **options)
    learning_curve.run(home, tmp_path / "out", n_own=0, curate=False, **options)
    curated = learning_curve.run(home, tmp_path / "out", **options)
    assert (
        f"Curation left out {FRAMES} frames (duplicate); `torchpose fit` says"
        in curated.findings[-1]
    )


def test_learning_curve_of_any_recordings(data, tmp_path):
    """Folders of other names, with counts that go with the persons, and persons of a third folder."""
    one = write_people(tmp_path / "mine" / "a", ("ann", "bob"), n_frames=FRAMES)
    two = write_people(tmp_path / "mine" / "b", ("carl",), n_frames=FRAMES, first=2)
    report = learning_curve.run(
        [one, two], tmp_path / "out", progress=False, n_own=0, n_subsets=1, recipes=[("r", recipe)]
    )
    assert list(report["curve"].rows) == ["1 person", "2 persons"]
    assert report.settings["persons"] == ["ann", "bob", "carl"] and "own" not in report
    report = learning_curve.run(
        [one, two], tmp_path / "out", progress=False, n_own=0, n_subsets=1, counts=(3,),
        more=(str(data / "burke_kinect"),), recipes=[("r", recipe)],
    )  # fmt: skip
    assert report.settings["further training persons"] == ["one"]
    with pytest.raises(InputError, match="two persons or more, got carl"):
        learning_curve.run(two, tmp_path / "out", progress=False)


def test_counts_double_up_to_all():
    assert [learning_curve._doubling(n) for n in (1, 2, 7, 8)] == [
        (1,), (1, 2), (1, 2, 4, 7), (1, 2, 4, 8)
    ]  # fmt: skip


def test_a_point_of_the_curve():
    def scored(error):
        values = torch.full((3, 8), error / 100)
        return unseen.Scored(values, values, values, values[:, 0], values[:, :2].long(), values)

    results = [
        {"b": scored(4.0), "c": scored(8.0)},
        {"a": scored(5.0), "c": scored(6.0)},
        {"a": scored(7.0), "b": scored(4.0)},
    ]
    mean, drawn, tested = learning_curve._point(results, "filtered")
    assert mean == pytest.approx((6 + 4 + 7) / 3)
    assert drawn == pytest.approx(math.sqrt((2 + 0 + 2) / 3))
    assert tested == pytest.approx(np.std([6, 4, 7], ddof=1))
    assert mean_error(results[0]["b"]) == pytest.approx(4.0)


def test_recipes_by_name(data, tmp_path):
    name, function = learning_curve._imported("x=torchpose.learning._recipes.fit_kinect_prior")
    assert name == "x" and function.__name__ == "fit_kinect_prior"
    for text in ("fit_kinect_prior", "x=torchpose.none.f", "x=torchpose.learning._recipes.none"):
        with pytest.raises(InputError, match="--compare"):
            learning_curve._imported(text)
    with pytest.raises(InputError, match="9 training persons"):
        learning_curve.run(data, tmp_path, progress=False, counts=(1, 9))
    with pytest.raises(InputError, match="names of their own, got this recipe, x, x"):
        learning_curve.run(data, tmp_path, progress=False, compare=("x=math.sin", "x=math.cos"))


def test_recipes_in_the_working_folder(tmp_path, monkeypatch):
    """As documented; the command `torchpose` did not look there."""
    (tmp_path / "recipe_of_mine.py").write_text("def fit(recordings, **settings): ...")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert learning_curve._imported("mine=recipe_of_mine.fit")[1].__module__ == "recipe_of_mine"


def test_a_recipe_that_was_edited_is_another_one(tmp_path, monkeypatch):
    """Priors of the text before were taken for its own."""
    monkeypatch.syspath_prepend(tmp_path)
    file, found = tmp_path / "edited_recipe.py", []
    for text in ("", "", "1  # tuned", "VERSION = 7", "VERSION = 7  # more"):
        file.write_text(f"{text}\ndef fit(recordings): ...\n")
        sys.modules.pop("edited_recipe", None)
        found.append(_version_of(import_module("edited_recipe").fit))
    assert found[0] == found[1] != found[2] and found[3:] == ["7", "7"]


def test_data_that_would_not_be_used_are_refused(data, tmp_path):
    more = (str(data / "burke_kinect"),)
    others = shutil.copytree(data / "kinect_utd_mhad", tmp_path / "others")
    with pytest.raises(
        InputError, match=r"counts beyond the 3 who .* got counts of 1, 2, 3; give larger"
    ):
        learning_curve.run([others], tmp_path, progress=False, more=more)
    for folders, part in (([others, more[0]], "cross"), ([data], "both")):
        with pytest.raises(InputError, match="added: motion capture is for the second part"):
            cross_dataset.run(folders, tmp_path, progress=False, part=part, added=more)
    with pytest.raises(InputError, match="mocap_share must be positive"):
        cross_dataset.run([data], tmp_path, progress=False, mocap_share=-1.0)


@pytest.mark.slow
def test_across_data_sets(data, tmp_path):
    report = cross_dataset.run(data, tmp_path, progress=False, part="cross", recipe=recipe)
    cross = report["cross"]
    for name in ("UTD → UTD (s7, s8)", "UTD → MHAD (s9, s10)", "MHAD → UTD (s7, s8)",
                 "MHAD → MHAD (s9, s10)", "UTD → MHAD, all persons"):  # fmt: skip
        assert cross[name, "filtered"] > 0
        assert math.isnan(cross[name, "head"])
    assert cross["UTD → MHAD, all persons", "persons"] == 3
    assert cross["UTD → UTD (s7, s8)", "frames"] == 4 * FRAMES
    assert (tmp_path / "cross-dataset.png").stat().st_size > 1000
    with pytest.raises(InputError, match="part must be"):
        cross_dataset.run(data, tmp_path, part="all")
    with pytest.raises(InputError, match="expected the folder"):
        cross_dataset.run(data / "burke_kinect", tmp_path, part="cross")


@pytest.mark.slow
def test_across_any_data_sets(data, tmp_path):
    """Three folders of other names: nothing has to be made up where all have the same joints."""
    folders = [
        write_people(tmp_path / name, persons, n_frames, first=first)
        for first, name, persons, n_frames in (
            (0, "x", "ab", 110),
            (4, "y", "cd", FRAMES),
            (8, "z", "ef", FRAMES),
        )
    ]
    report = cross_dataset.run(
        folders, tmp_path / "out", progress=False, recipe=recipe, tested=("c",)
    )
    with pytest.raises(InputError, match="there is no cc; the persons are a, b, c, d, e, f"):
        cross_dataset.run(folders, tmp_path / "out", progress=False, tested=("c", "cc"))
    cross = report["cross"]
    assert {f"{a} → {b} ({p})" for a in "xyz" for b, p in zip("xyz", "bcf", strict=True)} < {
        *cross.rows
    }
    assert cross["x → y, all persons", "persons"] == 2 and cross["x → y (c)", "head"] > 0
    assert "completion" not in report and len(report.findings) == 6
    assert "wrists" not in cross.title and report.settings["part"] == "cross"
    mocap = data / "mocap_berkeley_mhad"
    report = cross_dataset.run([folders[0], mocap], tmp_path / "out", progress=False, recipe=recipe)
    assert math.isnan(report["cross"]["mocap_berkeley_mhad → x (b)", "head"])
    assert list(report["completion"].rows) == ["heads of mocap_berkeley_mhad"]


@pytest.mark.slow
def test_motion_capture_added_to_any_data_sets(data, tmp_path):
    folders = [
        write_people(tmp_path / name, persons, n_frames=60, first=first)
        for first, name, persons in ((0, "x", "ab"), (2, "y", "cd"))
    ]
    mocap = str(data / "mocap_berkeley_mhad")
    report = cross_dataset.run(
        folders, tmp_path / "out", progress=False, recipe=recipe, part="added", added=(mocap,)
    )
    rows = [f"{name}: {label}" for name in "xy" for label in ("alone", "with mocap_berkeley_mhad")]
    assert list(report["added"].rows) == rows
    frames = {row: report["added"][row, "training frames"] for row in rows}
    assert frames["x: alone"] == 120 < frames["x: with mocap_berkeley_mhad"]
    with pytest.raises(InputError, match="with --added, got none"):
        cross_dataset.run(folders, tmp_path / "out", progress=False, part="added")
    with pytest.raises(InputError, match="told apart by their folders' names"):
        cross_dataset.run([folders[0], folders[0]], tmp_path / "out", progress=False)
    headless = [mocap, shutil.copytree(mocap, tmp_path / "again")]
    with pytest.raises(InputError, match="heads are missing in all data sets"):
        cross_dataset.run(headless, tmp_path / "out", progress=False)


def test_no_head_of_a_tested_person_is_learnt_from(data):
    split = cross_dataset._crossed(cross_dataset._read([data], (), "cross", True), (), 1)
    sets = cross_dataset._with_same_joints(split, 0)
    tested = {r.person_id for group in split["UTD"].tested.values() for r in group}
    assert sets.completion.persons and not set(sets.completion.persons) & tested
    # the mean head is for tests; training recordings have residuals, and nothing else differs
    mean, drawn = sets.mean["MHAD"].train["s1"][0].joints, sets.drawn["MHAD"]["s1"][0].joints
    assert bool((mean[:, [0, 1, 2, 5, 6, 7]] == drawn[:, [0, 1, 2, 5, 6, 7]]).all())


def test_motion_capture_is_thinned_to_a_share(data):
    (recording, *_) = read_recordings(data / "kinect_utd_mhad")
    fast = replace(recording, fps=120.0)
    assert len(cross_dataset._at_most([recording] * 10, 5 * FRAMES)) == 5
    assert len(cross_dataset._at_most([fast] * 10, 5 * FRAMES)) == 10  # a quarter of the seconds
    assert cross_dataset._at_most([recording] * 3, 10_000) == [recording] * 3


@pytest.mark.slow
def test_uncommon_poses(data, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.ub_people.TRAIN_PERSONS", ("s1", "s2"))
    shares = [
        uncommon_poses.raised_share(r)
        for person in ("s1", "s2")
        for r in persons_module.by_person(read_recordings(data / "kinect_utd_mhad"))[person]
    ]
    report = uncommon_poses.run(
        data, tmp_path, progress=False, raised=float(np.median(shares)), recipe=recipe
    )
    errors = report["errors"]
    kept = errors["no raised arms", "recordings"]
    assert 0 < kept < 4 == errors["all recordings", "recordings"]
    assert errors["as many at random", "frames"] >= errors["no raised arms", "frames"]
    assert len(report["pose_classes"].rows) == 12
    with pytest.raises(InputError, match="choose another --raised"):
        uncommon_poses.run(data, tmp_path, progress=False, raised=1.0)


def test_raised_share_counts_frames_of_either_hand(data):
    (recording, *_) = read_recordings(data / "kinect_utd_mhad")
    body = torch.stack([poses(1, 0)[0]] * 4)
    body[:, [0, 7], 1] = body[:, [2, 5], 1] + 0.4
    body[0, 0, 1] -= 0.8
    body[1, 7, 1] -= 0.8
    names = ("hand_left", "elbow_left", "shoulder_left", "head", "neck", "shoulder_right",
             "elbow_right", "hand_right")  # fmt: skip
    assert uncommon_poses.raised_share(replace(recording, joints=body, names=names)) == 0.5


@pytest.mark.data
@pytest.mark.slow
def test_real_data_sets(tmp_path):
    folder = few_recordings(
        "kinect_utd_mhad", tmp_path / "data", 24, ("s01", "s02", "s03", "s07", "s08")
    )
    few_recordings("mocap_berkeley_mhad", tmp_path / "data", 9, ("s01", "s02", "s09"))
    report = cross_dataset.run(
        folder.parent, tmp_path / "out", progress=False, quick=True, part="cross", recipe=recipe
    )
    cross = report["cross"]
    own, far = (cross[f"{name} → UTD (s7, s8)", "filtered"] for name in ("UTD", "MHAD"))
    assert 2 < own < far < 30


def test_folders_on_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in "abc":
        (tmp_path / name).mkdir()
    several = evaluate.PROTOCOLS["leave-one-person-out"]
    parser = evaluate.build("evaluate leave-one-person-out", several)
    line = ["a", "b", "--out", "o", "--workers", "2"]
    args = parser.parse_args(line)
    assert evaluate.checked_data("recordings", args) == [Path("a"), Path("b")]
    assert args.workers == 2
    more = parser.parse_args([*line, "--data", "c"])
    assert evaluate.checked_data("recordings", more)[-1] == Path("c")
    with pytest.raises(InputError, match="got none"):
        evaluate.checked_data("recordings", parser.parse_args(["--out", "o"]))
    with pytest.raises(InputError, match="d: no such folder or file of recordings"):
        evaluate.checked_data("recordings", parser.parse_args(["d", "--out", "o"]))
