"""The report page: what is in the file, read by an HTML parser, and what a browser makes of it."""

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest
import torch

from tests.upper_body.test_bvh import track_of as of_joints
from torchpose.body import BODY_15, Body
from torchpose.body._feet import FEET
from torchpose.camera import CameraRig, PinholeCamera
from torchpose.demo import performer
from torchpose.errors import InputError, OutputError, ShapeError
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import PoseTrack
from torchpose.viz._report import packing, page, write_report
from torchpose.whole_body import BodyTrack

HOSTILE = (
    "</script><script>alert(1)</script><img src=x onerror=alert(2)> & \"quotes\" 'too' {{data}}"
)


class Page(HTMLParser):
    """Tags, and the text of each element that has an id."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []
        self.by_id: dict[str, str] = {}
        self._id = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self._id = dict(attrs).get("id") or ""

    def handle_endtag(self, tag):
        self._id = ""

    def handle_data(self, data):
        self.texts.append(data)
        if self._id:
            self.by_id[self._id] = self.by_id.get(self._id, "") + data

    @property
    def data(self) -> dict:
        return json.loads(self.by_id["data"])


def track_of(n: int = 20, seed: int = 0, fps: float | None = 30.0) -> PoseTrack:
    g = torch.Generator().manual_seed(seed)
    joints = performer(n_frames=n).joints
    root = 0.1 * torch.randn(1, n, 8, 3, 3, generator=g, dtype=torch.float64)
    observed = torch.rand(1, n, 8, generator=g) < 0.7
    observed[..., 1] = False
    return replace(of_joints(joints, fps), covariance3d=root @ root.mT, observed=observed)


def unpack(packed: dict) -> np.ndarray:
    raw = base64.b64decode(packed["base64"])
    return np.frombuffer(raw, dtype=packed["type"]).reshape(packed["shape"])


def read(path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def test_the_page_holds_the_poses(tmp_path):
    track = track_of()
    assert write_report(tmp_path / "a.html", [track]) == tmp_path / "a.html"
    data = read(tmp_path / "a.html").data
    (person,) = data["people"]
    assert np.array_equal(unpack(person["joints"]), track.joints3d[0].float().numpy())
    C = track.covariance3d[0].float().numpy()
    half = np.stack([C[..., i, j] for i in range(3) for j in range(i, 3)], -1)
    assert np.array_equal(unpack(person["covariance"]), half)
    bits = np.unpackbits(unpack(person["observed"])[:, None], axis=1, bitorder="little")
    assert np.array_equal(bits.astype(bool), track.observed[0].numpy())
    assert person["measured"] == pytest.approx(track.observed[0].double().mean(0).tolist())
    assert (person["first"], person["frames"], person["stride"]) == (0, 20, 1)
    assert person["there"] is None and person["truth"] is None
    assert (data["fps"], data["frames"]) == (30.0, 20)
    assert data["names"][0] == "left hand" and data["sides"][7] == "right"


def test_names_of_a_whole_body_begin_with_the_side_too(tmp_path):
    names = ("left_wrist", "right_upper_arm", "neck", "knee_left", "mid_hip", "a", "b", "c")
    write_report(tmp_path / "a.html", [replace(track_of(2), names=names)])
    data = read(tmp_path / "a.html").data
    assert data["names"][:5] == ["left wrist", "right upper arm", "neck", "left knee", "mid hip"]
    assert data["sides"][:5] == ["left", "right", "middle", "left", "middle"]


def test_a_body_has_its_own_bones(tmp_path):
    body = Body.of_height(BODY_15, 1.75)
    state = torch.zeros(2, body.dim).double()
    nothing = torch.zeros(2).double()
    track = BodyTrack(
        body, state, state, body.joints(state), torch.zeros(2, 15, 3, 3).double(), nothing,
        nothing, nothing > 0, nothing > 0,
    )  # fmt: skip
    camera = PinholeCamera(80, 80, 39.5, 29.5, 80, 60)
    with pytest.raises(InputError, match="camera must be one PinholeCamera, got CameraRig"):
        track.seen_by(CameraRig([camera]))
    seen = track.seen_by(camera)
    limbs = read(write_report(tmp_path / "a.html", [seen])).data["limbs"]
    pairs = {(BODY_15.names[a], BODY_15.names[b]) for a, b in limbs}
    assert len(limbs) == 14 and {("pelvis", "left_hip"), ("left_elbow", "left_wrist")} <= pairs
    feet = replace(
        seen, names=(*seen.names, *FEET), joints3d=torch.zeros(1, 2, 21, 3),
        covariance3d=torch.zeros(1, 2, 21, 3, 3), observed=torch.ones(1, 2, 21).bool(),
    )  # fmt: skip
    assert len(read(write_report(tmp_path / "b.html", [feet])).data["limbs"]) == 14 + 8
    other = replace(seen, names=seen.names[::-1])
    for people, limbs, said in (
        ([track], None, "give track.seen_by"),
        ([other], None, "limbs must be given for the joints right_ankle"),
        ([seen], [(0, 15)], "limbs must be of joints 0 to 14"),
        ([seen, other], None, "must be of the same joints"),
    ):
        with pytest.raises(InputError, match=said):
            write_report(tmp_path / "c.html", people, limbs=limbs)


def test_it_needs_no_network(tmp_path):
    write_report(tmp_path / "a.html", [track_of()], facts={"prior": "x"}, notes=["y"])
    text = (tmp_path / "a.html").read_text()
    assert not re.search(r"https?://(?!www\.w3\.org/)", text)
    assert not re.search(
        r"<(link|iframe|object|embed|base)\b|@import|\bfetch\(|XMLHttpRequest", text
    )
    assert "src=" not in text and "default-src 'none'" in text


@pytest.mark.parametrize("where", ["title", "facts", "notes", "labels"])
def test_names_from_outside_stay_text(tmp_path, where):
    plain = write_report(tmp_path / "plain.html", [track_of()], facts={"a": "b"}, notes=["c"])
    given = {"title": HOSTILE, "facts": {HOSTILE: HOSTILE}, "notes": [HOSTILE], "labels": [HOSTILE]}
    options = {"facts": {"a": "b"}, "notes": ["c"]} | {where: given[where]}
    path = write_report(tmp_path / "hostile.html", [track_of()], **options)
    hostile = read(path)
    assert hostile.tags == read(plain).tags
    assert HOSTILE in (hostile.texts if where != "labels" else [hostile.data["people"][0]["label"]])


def test_a_file_name_that_is_no_unicode_is_no_trouble(tmp_path):
    name = b"caf\xe9.mp4".decode("utf-8", "surrogateescape")
    path = write_report(tmp_path / "a.html", [track_of()], title=name, labels=[name])
    assert "caf?.mp4" in read(path).texts


def test_the_overlay_is_embedded_whole(tmp_path, monkeypatch):
    video = bytes(range(256)) * 40 + b"rest"
    (tmp_path / "overlay.mp4").write_bytes(video)
    monkeypatch.setattr(page, "_CHUNK", 3 * 100)
    path = write_report(tmp_path / "a.html", [track_of()], overlay=tmp_path / "overlay.mp4")
    found = read(path)
    assert found.data["video"] == "embedded"
    assert base64.b64decode(found.by_id["video-data"], validate=True) == video


def test_a_large_overlay_is_linked_and_the_page_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MAX_EMBEDDED", 999)
    folder = tmp_path / "out put"
    folder.mkdir()
    (folder / "overlay #1.mp4").write_bytes(b"0" * 1000)
    path = write_report(folder / "a.html", [track_of()], overlay=folder / "overlay #1.mp4")
    found = read(path)
    assert found.data["video"] == "overlay%20%231.mp4"
    assert found.by_id.get("video-data", "") == ""
    assert any("it is linked" in text and "overlay #1.mp4" in text for text in found.texts)
    elsewhere = write_report(tmp_path / "b.html", [track_of()], overlay=folder / "overlay #1.mp4")
    assert read(elsewhere).data["video"] == "out%20put/overlay%20%231.mp4"


def test_long_tracks_are_thinned_without_losing_a_peak(tmp_path, monkeypatch):
    monkeypatch.setattr(packing, "CURVE_POINTS", 40)
    monkeypatch.setattr(page, "MAX_POSES", 50)
    n = 211
    track = track_of(n)
    track.joints3d[0, 100, 0, 0] = 5.0  # a peak of one frame
    track.joints3d[0, 40:44] = torch.nan
    path = write_report(tmp_path / "a.html", [track])
    found = read(path)
    (person,) = found.data["people"]
    assert (person["stride"], person["bucket"]) == (5, 11)
    expected = track.joints3d[0, ::5].float().numpy()
    assert np.array_equal(unpack(person["joints"]), expected, equal_nan=True)
    assert len(unpack(person["observed"])) == n
    assert np.flatnonzero(unpack(person["there"]) == 0).tolist() == [40, 41, 42, 43]
    low, high, lower, upper = unpack(person["curves"])
    assert high[0, 0, 100 // 11] == 5.0 and low.shape == (8, 3, 20)
    joints = track.joints3d[0].numpy()
    half = 1.6449 * np.sqrt(np.diagonal(track.covariance3d[0].numpy(), axis1=-2, axis2=-1))
    for bucket in (0, 7, 19):
        rows = slice(11 * bucket, 11 * bucket + 11)
        assert low[3, :, bucket] == pytest.approx(np.nanmin(joints[rows, 3], 0))
        assert high[3, :, bucket] == pytest.approx(np.nanmax(joints[rows, 3], 0))
        assert lower[2, :, bucket] == pytest.approx(
            np.nanmin((joints - half)[rows, 2], 0), abs=1e-4
        )
        assert upper[2, :, bucket] == pytest.approx(
            np.nanmax((joints + half)[rows, 2], 0), abs=1e-4
        )
    assert sum("Thinned for this page" in text for text in found.texts) == 2
    assert not any("poses.npz" in text for text in found.texts)  # that of bodies is body.npz
    assert any("every 5th pose" in text and "every 11 frames" not in text for text in found.texts)


def test_an_hour_is_a_few_megabytes(tmp_path):
    n, short = 108_000, track_of(600)
    times = n // 600
    long = replace(
        short,
        **{
            name: getattr(short, name).repeat(1, times, *[1] * (getattr(short, name).ndim - 2))
            for name in ("joints2d", "joints3d", "covariance2d", "covariance3d", "observed",
                         "log_evidence")
        },
        lengths=torch.tensor([n]),
    )  # fmt: skip
    path = write_report(tmp_path / "a.html", [long])
    assert path.stat().st_size < 6e6
    (person,) = read(path).data["people"]
    assert len(unpack(person["joints"])) <= packing.MAX_POSES
    assert 2 * unpack(person["curves"]).shape[-1] <= packing.CURVE_POINTS


def test_several_persons_begin_where_they_come(tmp_path):
    second = track_of(8, seed=1)
    second.joints3d[0, 5:] = torch.nan
    second = replace(second, failed_at=torch.tensor([5]))
    truth = performer(n_frames=20).joints
    path = write_report(
        tmp_path / "a.html", [track_of(), second], first_frames=[2, 30], n_frames=50, truth=truth,
        labels=["Ann", "Ben"],
    )  # fmt: skip
    found = read(path)
    ann, ben = found.data["people"]
    assert (ann["first"], ben["first"], found.data["frames"]) == (2, 30, 50)
    assert np.array_equal(unpack(ann["truth"]), truth.float().numpy()) and ben["truth"] is None
    assert unpack(ben["there"]).tolist() == [1] * 5 + [0] * 3
    assert ben["measured"] == pytest.approx(second.observed[0, :5].double().mean(0).tolist())
    assert any("Ben degenerated at its frame 5" in text for text in found.texts)
    assert read(write_report(tmp_path / "b.html", [second], first_frames=[30])).data["frames"] == 38


def test_one_frame_and_nobody_are_pages_too(tmp_path):
    one = read(write_report(tmp_path / "a.html", [track_of(1, fps=None)]))
    assert one.data["people"][0]["frames"] == 1
    assert any("frame rate is unknown" in text for text in one.texts)
    nobody = read(write_report(tmp_path / "b.html", [], notes=["No face."], n_frames=90))
    assert nobody.data["people"] == [] and nobody.data["frames"] == 90
    assert any("Nobody was tracked" in text for text in nobody.texts)


def test_wrong_input_is_refused(tmp_path):
    track, path = track_of(), tmp_path / "a.html"
    two = replace(track, **{n: getattr(track, n).repeat(2, *[1] * (getattr(track, n).ndim - 1))
                            for n in ("joints3d", "observed", "lengths")})  # fmt: skip
    with pytest.raises(InputError, match=r"people\[0\] must be one sequence"):
        write_report(path, [two])
    with pytest.raises(InputError, match="must be a list of tracks, got PoseTrack"):
        write_report(path, track)
    with pytest.raises(InputError, match=r"people\[0\] must be a PoseTrack, got Tensor"):
        write_report(path, [track.joints3d])
    with pytest.raises(InputError, match="first_frames"):
        write_report(path, [track], first_frames=[1, 2])
    with pytest.raises(InputError, match="negative"):
        write_report(path, [track], first_frames=[-1])
    with pytest.raises(InputError, match="labels"):
        write_report(path, [track], labels=[])
    with pytest.raises(InputError, match="frame rate"):
        write_report(path, [track, track_of(fps=25.0)])
    with pytest.raises(InputError, match="one frame"):
        write_report(path, [track, replace(track, frame="body")])
    with pytest.raises(InputError, match="no such file"):
        write_report(path, [track], overlay=tmp_path / "none.mp4")
    with pytest.raises(ShapeError, match="truth"):
        write_report(path, [track], truth=torch.zeros(3, 8, 3))
    with pytest.raises(OutputError):
        write_report(tmp_path / "nowhere" / "a.html", [track])
    assert list(tmp_path.iterdir()) == []


def test_the_templates_are_part_of_the_package():
    template = files("torchpose.viz._report").joinpath("template.html").read_text(encoding="utf-8")
    keys = {"title", "summary", "style", "script", "facts", "notes", "data", "video"}
    assert set(re.findall(r"\{\{(\w+)\}\}", template)) == keys
    assert UPPER_BODY[0] not in template


_PAGE = """
const elements = {};
const document = { getElementById(id) {
  return elements[id] ??= { textContent: id === "data" ? process.argv[2] : "" };
} };
const getComputedStyle = () => ({ getPropertyValue: () => "" });
SCRIPTS
"""
_VALUES = (
    _PAGE
    + """
writeValues();
console.log($("curve-values").textContent);
"""
)
_ELLIPSOIDS = (
    _PAGE
    + """
console.log(data.names.map((_, j) => hasEllipsoid(people[0], 0, j)).join(" "));
"""
)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, 0.0])
def test_a_joint_of_unknown_deviation_is_shown_with_a_question_mark(tmp_path, value):
    track = track_of(3)
    track.covariance3d[:] = value
    said = run_in_node(track, _VALUES, tmp_path)
    assert said.count("± ?" if value else "± 0.0") == 3, said


@pytest.mark.parametrize("outlined", [True, False])
def test_ellipsoids_are_of_inferred_joints_or_of_all_that_outlines_measure(tmp_path, outlined):
    track = track_of(3)
    track.observed[:] = True
    if not outlined:
        track.observed[:, 0, 2:] = False
    said = run_in_node(track, _ELLIPSOIDS, tmp_path).split()
    inferred = (~track.observed[0, 0]).tolist()
    assert said == ["true" if outlined or there else "false" for there in inferred]


def run_in_node(track, program, folder):
    """Return what a program prints that knows the scripts of the page of a track."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not on the PATH")
    data = read(write_report(folder / "a.html", [track])).by_id["data"]
    scripts = [files("torchpose.viz._report").joinpath(name).read_text(encoding="utf-8")
               for name in ("numbers.js", "plots.js", "player.js")]  # fmt: skip
    code = program.replace("SCRIPTS", "\n".join(scripts).replace("\nsetUp();\n", "\n"))
    (folder / "program.js").write_text(code, encoding="utf-8")
    command = [node, str(folder / "program.js"), data]
    run = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", timeout=60)
    assert run.returncode == 0, run.stderr
    return run.stdout


_PROBE = """<script>
const out = document.body.dataset;
window.addEventListener("error", (event) => { out.error = event.message; });
const press = (key) => document.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
const byId = (id) => document.getElementById(id);
byId("body").dispatchEvent(new KeyboardEvent("keydown", { key: "3" }));
byId("body").dispatchEvent(new WheelEvent("wheel", { deltaY: 120 }));
byId("strips").children[1].children[0].click();
byId("show-ellipsoids").click();
byId("person").selectedIndex = byId("person").length - 1;
byId("person").dispatchEvent(new Event("change"));
press("End"); press("ArrowLeft"); press("ArrowRight"); press(" "); press(" ");
window.dispatchEvent(new Event("resize"));
out.title = byId("curve-title").textContent;
const pixels = byId("curves").getContext("2d").getImageData(0, 0, byId("curves").width, 400).data;
out.drawn = String(pixels.some((value) => value > 0));
</script></body>"""


@pytest.mark.parametrize("kind", ["plain", "long", "nan", "unsure", "one frame", "nobody"])
def test_a_browser_runs_it_without_an_error(tmp_path, monkeypatch, kind):
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not on the PATH")
    if kind == "long":
        monkeypatch.setattr(packing, "CURVE_POINTS", 10)
        monkeypatch.setattr(page, "MAX_POSES", 7)
    people = [] if kind == "nobody" else [track_of(1 if kind == "one frame" else 20)]
    if kind == "nan":
        people[0].joints3d[0, 4:] = torch.nan
        people[0].covariance3d[0, 4:] = torch.nan
        people.append(track_of(5))
    if kind == "unsure":
        people[0].covariance3d[:] = torch.inf
    truth = performer(n_frames=20).joints if kind in ("plain", "long") else None
    path = write_report(tmp_path / "a.html", people, truth=truth, title=HOSTILE)
    path.write_text(path.read_text().replace("</body>", _PROBE))
    command = [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
               "--virtual-time-budget=500", f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom",
               path.as_uri()]  # fmt: skip
    run = subprocess.run(command, capture_output=True, text=True, timeout=60)
    body = re.search(r"<body[^>]*>", run.stdout)
    assert body is not None, run.stderr[-2000:]
    assert 'data-ready="true"' in body[0] and "data-error" not in body[0], body[0]
    assert not [line for line in run.stderr.splitlines() if "CONSOLE" in line]
    if people:
        chosen = "Left elbow" if len(people) == 1 else "Left elbow, person 2"
        assert f'data-title="{chosen}"' in body[0]
        assert 'data-drawn="true"' in body[0]
