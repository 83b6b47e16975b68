"""TRC, C3D and BVH files of whole bodies, read back by parsers of the tests' own."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.io.c3d_parser import parse_c3d
from tests.upper_body.bvh_reader import pose, read_bvh
from torchpose.body import BODY_15, Body
from torchpose.errors import InputError, OutputError, ShapeError
from torchpose.io._c3d_file import write_c3d
from torchpose.io._trc_file import write_trc
from torchpose.whole_body import BodyTrack
from torchpose.whole_body._body_files import marker_names

T, FPS, FIRST = 7, 50.0, 3
Z_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # x is y, y is z, z is x


def track_of(frame: str = "parent", std: float = 0.004) -> BodyTrack:
    """Somebody who moves all limbs at random."""
    g = torch.Generator().manual_seed(0)
    body = Body.of_height(BODY_15, 1.8, frame=frame)
    if frame == "body":
        centres = torch.cat([torch.zeros(1, 3), 0.2 * torch.randn(10, 3, generator=g)])
        body = body.altered(centres=centres.double())
    state = 0.3 * torch.randn(T, body.dim, generator=g, dtype=torch.float64)
    flags = torch.zeros(T, dtype=torch.bool)
    return BodyTrack(
        body, state, torch.zeros_like(state), body.joints(state),
        (std**2 * torch.eye(3).double()).expand(T, 15, 3, 3), torch.zeros(T), torch.zeros(T), flags,
        flags, FPS, first_frame=FIRST,
    )  # fmt: skip


def turned(joints: torch.Tensor, up: str | None) -> np.ndarray:
    return joints.numpy() @ (Z_UP.T if up == "z" else np.eye(3))


def read_trc(path) -> tuple[dict[str, str], list[str], np.ndarray]:
    """The facts of the header, names of markers, and the table with NaN where a cell is empty."""
    lines = path.read_text().split("\n")
    assert lines[0].split("\t") == ["PathFileType", "4", "(X/Y/Z)", path.name]
    facts = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    heads = lines[3].split("\t")
    assert heads[:2] == ["Frame#", "Time"]
    assert lines[5] == "" and lines[-1] == ""
    width = 2 + 3 * int(facts["NumMarkers"])
    assert len(heads) == len(lines[4].split("\t")) == width
    assert lines[4].split("\t")[2:6] == ["X1", "Y1", "Z1", "X2"]
    rows = [[float(c) if c else np.nan for c in line.split("\t")] for line in lines[6:-1]]
    return facts, [name for name in heads[2:] if name], np.array(rows)


@pytest.mark.parametrize("up", [None, "y", "z"])
def test_trc(tmp_path, up):
    track = track_of()
    track.export(tmp_path / "body.trc", up=up)
    facts, names, rows = read_trc(tmp_path / "body.trc")
    assert facts["Units"] == "m"
    assert (facts["DataRate"], facts["CameraRate"], facts["NumFrames"]) == ("50", "50", str(T))
    assert {"RHip", "RKnee", "RAnkle", "LHip", "Neck", "Head", "RShoulder", "RElbow", "RWrist",
            "CHip"} <= set(names)  # fmt: skip
    assert rows[:, 0].tolist() == list(range(FIRST + 1, FIRST + 1 + T))
    assert rows[:, 1] == pytest.approx(np.arange(FIRST, FIRST + T) / FPS)
    back = rows[:, 2:].reshape(T, 15, 3)
    assert np.abs(back - turned(track.joints3d, up)).max() < 1e-6


def test_markers_that_are_missing_are_empty_cells(tmp_path):
    joints = torch.ones(2, 3, 3)
    joints[1, 2] = torch.nan
    write_trc(tmp_path / "a.trc", joints, ("a", "b", "c"), 29.97)
    facts, _, rows = read_trc(tmp_path / "a.trc")
    assert facts["DataRate"] == "29.97"
    assert np.isnan(rows[1, -3:]).all() and np.isfinite(rows[:, :-3]).all()


@pytest.mark.parametrize("up", [None, "z"])
def test_c3d(tmp_path, up):
    track = track_of()
    track.export(tmp_path / "body.c3d", up=up)
    found = parse_c3d(tmp_path / "body.c3d")
    assert found.parameters["POINT:LABELS"] == list(marker_names(BODY_15.names))
    assert found.parameters["POINT:UNITS"] == ["mm"]
    assert (found.parameters["POINT:USED"], found.parameters["POINT:FRAMES"]) == (15, T)
    assert found.parameters["POINT:RATE"] == found.rate == FPS
    assert (found.first, found.last) == (FIRST + 1, FIRST + T)
    assert found.parameters.get("POINT:Y_SCREEN") == (None if up is None else ["+Y"])
    assert np.abs(found.points[..., :3] / 1000 - turned(track.joints3d, up)).max() < 1e-6
    assert (found.points[..., 3] == 4).all()  # millimetres


def test_residuals_of_missing_and_of_unsure_points(tmp_path):
    joints = torch.zeros(2, 3, 3)
    joints[0, 1] = torch.nan
    std = torch.tensor([[0.0, 0.1, 0.0204], [1e-5, 3.0, 0.1]])
    write_c3d(tmp_path / "a.c3d", joints, ("a", "b", "c"), 30.0, std=std)
    found = parse_c3d(tmp_path / "a.c3d").points
    assert found[..., 3].tolist() == [[1, -1, 20], [1, 255, 100]]
    assert np.isfinite(found).all()


def test_long_recordings_count_frames_beyond_16_bits(tmp_path):
    n = 70_000
    joints = torch.arange(n, dtype=torch.float64)[:, None, None].expand(n, 1, 3) / 1000
    write_c3d(tmp_path / "long.c3d", joints, ("a",), 100.0)
    found = parse_c3d(tmp_path / "long.c3d")
    assert len(found.points) == n and found.points[-1, 0, 0] == n - 1
    low, high = found.parameters["TRIAL:ACTUAL_END_FIELD"]
    assert low + (high << 16) == n


@pytest.mark.parametrize("up", [None, "y", "z"])
@pytest.mark.parametrize("frame", ["parent", "body"])
def test_bvh(tmp_path, frame, up):
    track = track_of(frame)
    track.export(tmp_path / "body.bvh", up=up)
    motion = read_bvh(tmp_path / "body.bvh")
    assert motion.frame_time == pytest.approx(1 / FPS)
    back = [[pose(motion, t)[name] / 100 for name in BODY_15.names] for t in range(T)]
    assert np.abs(np.array(back) - turned(track.joints3d, up)).max() < 1e-3
    nodes = {node.name: node for node in motion.nodes}
    assert np.linalg.norm(nodes["left_knee"].offset) == pytest.approx(180 * 0.245, abs=1e-4)
    parents = {node.name: motion.nodes[node.parent].name for node in motion.nodes[1:]}
    assert parents["left_elbow"] == "left_shoulder" and parents["left_shoulder"] == "neck"
    assert parents["left_hip"] == "pelvis" and parents["neck"] == "torso_base"


def test_other_readers_of_the_package_take_them(tmp_path):
    from torchpose.io._formats.mocap_files import read_bvh as read_nodes
    from torchpose.io._formats.mocap_files import read_c3d_points

    pytest.importorskip("c3d")
    pytest.importorskip("bvhio")
    track = track_of()
    for kind in ("c3d", "bvh"):
        track.export(tmp_path / f"body.{kind}", up="z")
    points = read_c3d_points(tmp_path / "body.c3d")
    assert (points.up, points.unit, points.rate) == ("+Y", "mm", FPS)
    assert np.abs(points.points / 1000 - turned(track.joints3d, "z")).max() < 1e-6
    [nodes] = read_nodes(tmp_path / "body.bvh")
    wrists = nodes.joints[:, nodes.names.index("wrist_left")]
    expected = turned(track.joints3d, "z")[:, BODY_15.joint("left_wrist")]
    assert np.abs(wrists / 100 - expected).max() < 1e-3


def test_what_cannot_be_written_is_refused(tmp_path):
    track = track_of()
    with pytest.raises(InputError, match="one of trc, c3d, bvh"):
        track.export(tmp_path / "body.fbx")
    with pytest.raises(InputError, match="up must be one of z, y"):
        track.export(tmp_path / "body.trc", up="x")
    with pytest.raises(OutputError):
        track.export(tmp_path / "nowhere" / "body.c3d")
    with pytest.raises(ShapeError):
        write_trc(tmp_path / "a.trc", track.joints3d, ("a",), FPS)
    with pytest.raises(InputError, match="1 to 255 points"):
        write_c3d(tmp_path / "a.c3d", torch.zeros(1, 300, 3), [str(i) for i in range(300)], FPS)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_rate_is_written_as_30(tmp_path):
    replace(track_of(), fps=None).export(tmp_path / "body.trc")
    assert read_trc(tmp_path / "body.trc")[0]["DataRate"] == "30"
