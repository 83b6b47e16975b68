"""`torchpose info`: every kind of file, and what is none."""

import numpy as np
import pytest

from tests.cli.conftest import keypoints
from torchpose.camera import PinholeCamera
from torchpose.io import write_keypoints


def test_installation(torchpose):
    done = torchpose("info")
    assert done.code == 0
    assert [line.split()[0] for line in done.out.splitlines()][:2] == ["torchpose", "torch"]
    assert "priors" in done.out


def test_prior(torchpose, files):
    done = torchpose("info", files / "prior.safetensors")
    assert done.code == 0
    facts = dict(line.split("  ", 1) for line in done.out.splitlines())
    facts = {key: value.strip() for key, value in facts.items()}
    assert facts["prior"] == "tiny"
    assert facts["components"] == "4 left, 4 right, right arm mirrored from the left"
    assert facts["camera"] == "f = (525, 525), centre (319.5, 239.5) pixels"
    assert facts["persons"] == "2: site:set#p1, site:set#p2"


def test_poses(torchpose, files, tmp_path):
    line = ("--prior", files / "prior.safetensors", "--pictures", "false", "--out", tmp_path)
    assert torchpose("track", files / "keypoints.npz", *line).code == 0
    done = torchpose("info", tmp_path / "poses.npz")
    assert done.code == 0
    assert "90 (3.0 s at 30 fps)" in done.out
    row = next(line for line in done.out.splitlines() if line.startswith("hand_right"))
    assert row.split()[1] == "88.9"


def test_keypoints(torchpose, files, tmp_path):
    done = torchpose("info", files / "keypoints.npz")
    assert done.code == 0 and "hand_right 88.9 %" in done.out and "f = (525, 525)" in done.out
    write_keypoints(tmp_path / "k.csv", keypoints(K=None, image_size=None))
    done = torchpose("info", tmp_path / "k.csv")
    assert done.code == 0 and "not stated: give --camera" in done.out


def test_recordings_and_cameras(torchpose, files, tmp_path):
    for what, frames in ((files / "recordings", "900"), (files / "recordings" / "p1.npz", "450")):
        done = torchpose("info", what)
        assert done.code == 0 and f"{frames} (" in done.out and "upper-body-8" in done.out
    PinholeCamera(600, 610, 330, 250, name="door").save(tmp_path / "cameras.toml")
    done = torchpose("info", tmp_path / "cameras.toml")
    assert done.out == "door  f = (600, 610), centre (330, 250) pixels\n"


def test_config(torchpose, files, tmp_path):
    (tmp_path / "info.yaml").write_text(f"what: {files / 'prior.safetensors'}\n")
    assert torchpose("info", "--config", tmp_path / "info.yaml").out.startswith("prior")


@pytest.mark.parametrize(
    "name, message",
    [
        ("nothing", "expected the name of a prior"),
        ("other.npz", "got the keys a"),
        ("cut.npz", "truncated"),
        ("text.csv", "text.csv"),
        ("notes.txt", "expected keypoints as"),
        ("empty", "found none"),
        ("cut.safetensors", "truncated or of another kind"),
    ],
)
def test_refusals(name, message, torchpose, files, tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "cut.npz").write_bytes((files / "keypoints.npz").read_bytes()[:200])
    (tmp_path / "cut.safetensors").write_bytes((files / "prior.safetensors").read_bytes()[:2000])
    (tmp_path / "text.csv").write_text("a,b\n1,2\n")
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty").mkdir()
    done = torchpose("info", tmp_path / name)
    assert done.code == 2 and message in done.err and len(done.err.splitlines()) == 1
