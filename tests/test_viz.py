"""Pictures: what is drawn where, missing values, no global state, whole files or none."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from torchpose import demo, metrics, viz
from torchpose.errors import InputError, MissingDependencyError, OutputError, ShapeError
from torchpose.viz import _style as style
from torchpose.viz._body_picture import plot_body_strip
from torchpose.viz._charts import _spans
from torchpose.viz._skeletons import as_drawn


@pytest.fixture(scope="module")
def scene() -> SimpleNamespace:
    truth = demo.performer(120).joints
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(0)).double()
    observed = torch.zeros(120, 8, dtype=torch.bool)
    observed[:, [0, 3, 4, 7]] = True
    observed[30:60, 7] = False
    covariance = (0.03**2 * torch.eye(3).double()).expand(120, 8, 3, 3)
    return SimpleNamespace(
        truth=truth, joints=truth + 0.03 * noise, covariance=covariance, observed=observed
    )


@pytest.fixture(scope="module")
def pictures(scene) -> dict[str, object]:
    """One picture of each kind, drawn in few pixels."""
    made = make_pictures(scene)
    for figure in made.values():
        figure.set_dpi(30)
        figure.canvas.draw()
    return made


def make_pictures(scene) -> dict[str, object]:
    errors = {
        "tracker": metrics.joint_errors_3d(scene.joints, scene.truth),
        "mean pose": metrics.joint_errors_3d(
            scene.truth.mean(0).expand_as(scene.truth), scene.truth
        ),
    }
    errors["tracker"][5:9] = torch.nan
    pixels = 525 * scene.joints[..., :2] / scene.joints[..., 2:]
    arm = torch.cat([scene.truth[:6, :5].reshape(6, 15), torch.zeros(6, 6)], 1)
    mixture = SimpleNamespace(weights=torch.full((6,), 1 / 6), means=arm)
    curves = metrics.reliability(scene.joints, scene.covariance, scene.truth)
    pcp = {"tracker": metrics.pcp(scene.joints, scene.truth)}
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    flat = scene.covariance[0, :, :2, :2]
    return {
        "pose": viz.plot_pose(pixels[0], flat, scene.observed[0], image_size=(640, 480)),
        "pose image": viz.plot_pose(pixels[0], image=image),
        "pose 3d": viz.plot_pose_3d(
            scene.joints[0], scene.covariance[0], scene.observed[0], scene.truth[0]
        ),
        "strip 2d": viz.plot_pose_strip(pixels, n_frames=4),
        "strip 3d": viz.plot_pose_strip(
            scene.joints, frames=range(0, 120, 10), observed=scene.observed, truth=scene.truth
        ),
        "curves": viz.plot_joint_curves(
            scene.joints, scene.covariance, scene.observed, scene.truth
        ),
        "curves 2d": viz.plot_joint_curves(pixels),
        "errors": viz.plot_errors_over_time(errors, bound=20),
        "bars": viz.plot_error_bars(errors),
        "pcp": viz.plot_pcp(pcp, by_limb=True),
        "reliability": viz.plot_reliability(curves),
        "prior": viz.plot_prior_means({"left arm": mixture, "right arm": mixture}),
    }


def test_every_picture_can_be_drawn_and_is_not_blank(pictures) -> None:
    for name, figure in pictures.items():
        pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
        inked = (pixels < 250).any(-1).mean()
        assert 0.005 < inked < 0.9, name


def test_labels_carry_units_and_legends_stay_out_of_the_data(pictures) -> None:
    figure = viz.plot_errors_over_time({"a": torch.rand(30, 8), "b": torch.rand(30, 8)})
    figure.canvas.draw()
    assert figure.axes[0].get_ylabel() == "error (cm)"
    assert figure.axes[-1].get_xlabel() == "time (s)"
    for figure in pictures.values():
        for legend in figure.legends:
            box = legend.get_window_extent()
            assert not any(box.overlaps(ax.get_window_extent()) for ax in figure.axes)
            assert box.x0 >= 0 and box.x1 <= figure.bbox.x1


def test_a_narrow_figure_becomes_as_wide_as_its_title_and_legend(scene) -> None:
    title = "The tracked pose of a person"
    for words in (title, None):
        figure = viz.plot_pose_strip(
            scene.joints[:1], observed=scene.observed[:1], truth=scene.truth[:1], title=words
        )
        figure.canvas.draw()
        texts = [*figure.legends[0].get_texts(), *([figure._suptitle] if words else [])]
        for box in (text.get_window_extent() for text in texts):
            assert box.x0 >= 0 and box.x1 <= figure.bbox.x1
    assert style.new_figure(9.2, 2.0, title).get_figwidth() == 9.2
    assert style.new_figure(1.0, 2.0).get_figwidth() == 1.0


def test_curves_show_the_band_and_the_gap(scene) -> None:
    figure = viz.plot_joint_curves(
        scene.joints, scene.covariance, scene.observed, show=("hand_right", "elbow_left")
    )
    first = figure.axes[0]
    band = first.collections[0].get_paths()[0].vertices[:, 1]
    centre = scene.joints[:, 7, 0].numpy()
    assert band.max() == pytest.approx((centre + 1.6448536 * 0.03).max())  # 90 % of a normal
    gap = first.patches[0].get_extents().transformed(first.transData.inverted())
    assert (gap.x0, gap.x1) == pytest.approx((29.5 / 30, 59.5 / 30))
    assert "inferred throughout" in figure.axes[3].get_ylabel()
    assert not figure.axes[3].patches


def test_times_are_those_of_the_recording(scene) -> None:
    curves = viz.plot_joint_curves(scene.joints, None, scene.observed, first_frame=60)
    first = curves.axes[0]
    assert first.get_lines()[0].get_xdata()[[0, -1]] == pytest.approx([2.0, (60 + 119) / 30])
    hand = curves.axes[6]
    gap = hand.patches[0].get_extents().transformed(hand.transData.inverted())
    assert (gap.x0, gap.x1) == pytest.approx((2 + 29.5 / 30, 2 + 59.5 / 30))
    strip = viz.plot_pose_strip(scene.joints, n_frames=2, first_frame=60)
    assert [text.get_text() for text in strip.axes[0].texts[1:]] == ["2.0 s", "6.0 s"]


def test_no_pose_of_a_strip_is_cut_off_or_runs_into_its_neighbour(scene) -> None:
    """From the side an arm stretched to the camera is wider than anything from the front."""
    joints = scene.joints.clone()
    joints[0, 7, 2] -= 2.0
    figure = viz.plot_pose_strip(joints[:3], n_frames=3)
    figure.canvas.draw()
    for ax in figure.axes:
        starts = [c.get_offsets()[:, 0] for c in ax.collections if len(c.get_offsets()) == 8]
        assert len(starts) == 3
        for column, xs in enumerate(starts):
            left, right = (ax.get_xlim()[1] * (column + side) / 3 for side in (0, 1))
            assert left < xs.min() and xs.max() < right


def test_inferred_joints_of_a_body_are_hollow() -> None:
    joints = torch.randn(2, 15, 3, generator=torch.Generator().manual_seed(0))
    observed = torch.ones(2, 15).bool()
    observed[1, 3] = False
    figure = plot_body_strip(joints, observed=observed)
    white = [(ax.collections[-1].get_facecolor()[:, :3] == 1).all(-1).nonzero()[0].tolist()
             for ax in figure.axes]  # fmt: skip
    assert white == [[], [3], [], [3]]
    assert [text.get_text() for text in figure.legends[0].get_texts()][2:] == [
        "measured",
        "inferred",
    ]


def test_spans_of_a_flag() -> None:
    flag = torch.tensor([1, 1, 0, 0, 1, 0, 1]).bool()
    assert _spans(flag) == [(-0.5, 1.5), (3.5, 4.5), (5.5, 6.5)]
    assert _spans(torch.zeros(4).bool()) == []


def test_ellipse_holds_its_probability() -> None:
    """Share of Gaussian draws inside the drawn 90 % ellipse."""
    figure = style.new_figure(3, 3)
    ax = figure.add_subplot()
    root = torch.tensor([[30.0, 0.0], [20.0, 8.0]]).double()
    viz.draw_skeleton(
        ax, torch.zeros(1, 2).double(), (root @ root.mT)[None], colors=["#000000"], limbs=()
    )
    ellipse = ax.patches[0]
    draws = torch.randn(20_000, 2, generator=torch.Generator().manual_seed(0)).double() @ root.mT
    path = ellipse.get_path().transformed(ellipse.get_patch_transform())
    assert path.contains_points(draws.numpy()).mean() == pytest.approx(0.9, abs=0.01)


def test_missing_joints_are_left_out_and_nothing_at_all_is_an_error(scene) -> None:
    holed = scene.joints.clone()
    holed[0, :3] = torch.nan
    covariance = scene.covariance.clone()
    covariance[0, 0] = torch.nan
    viz.plot_pose_3d(holed[0], covariance[0]).canvas.draw()
    with pytest.raises(InputError, match="not NaN"):
        viz.plot_pose_3d(torch.full((8, 3), torch.nan))


@pytest.mark.slow
def test_pictures_leave_global_settings_and_pyplot_alone() -> None:
    code = (
        "import sys; import torchpose, torchpose.viz as viz\n"
        "assert 'matplotlib' not in sys.modules\n"
        "import matplotlib; before = matplotlib.rcParams.copy()\n"
        "from torchpose import demo\n"
        "viz.plot_pose_strip(demo.performer(9).joints).canvas.draw()\n"
        "assert matplotlib.rcParams.copy() == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_figures_are_saved_whole_or_not_at_all(tmp_path, scene) -> None:
    figure = viz.plot_pose_strip(scene.joints, n_frames=3)
    path = viz.save_figure(figure, tmp_path / "strip.png", dpi=40)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in tmp_path.iterdir()] == ["strip.png"]
    with pytest.raises(OutputError):
        viz.save_figure(figure, tmp_path / "nowhere" / "strip.png")
    with pytest.raises(InputError, match="expected a suffix among"):
        viz.save_figure(figure, tmp_path / "strip.xyz")


def test_bad_input_is_named(scene) -> None:
    with pytest.raises(ShapeError, match=r"joints must be \[T, 8, 2\]"):
        viz.plot_pose_strip(torch.zeros(5, 7, 3))
    with pytest.raises(InputError, match="indices below 120"):
        viz.plot_pose_strip(scene.joints, frames=[120])
    for joints, n_frames in ((scene.joints, 0), (scene.joints, -1), (scene.joints[:0], 8)):
        with pytest.raises(InputError, match="at least"):
            viz.plot_pose_strip(joints, n_frames=n_frames)
        with pytest.raises(InputError, match="at least"):
            plot_body_strip(joints.repeat(1, 2, 1)[:, :15], n_frames=n_frames)
    with pytest.raises(InputError, match="a word for each of 120 frames, got 2"):
        viz.plot_pose_strip(scene.joints, labels=["a", "b"])
    with pytest.raises(InputError, match="at least one frame"):
        viz.plot_error_bars({"a": torch.zeros(0, 8)})
    with pytest.raises(ShapeError, match=r"joints must be \[T, 8, 2\]"):
        viz.plot_joint_curves(torch.zeros(5, 8, 4))
    with pytest.raises(InputError, match="expected names among"):
        viz.plot_joint_curves(scene.joints, show=["foot"])
    with pytest.raises(InputError, match="at least one"):
        viz.plot_pcp({})


@pytest.mark.parametrize(
    "draw", [viz.plot_pose, viz.plot_pose_3d, viz.plot_pose_strip, viz.plot_joint_curves]
)
def test_a_track_in_place_of_joints_and_other_sizes_beside_them_are_named(scene, draw) -> None:
    one = draw in (viz.plot_pose, viz.plot_pose_3d)
    joints = scene.joints[0, :, : 2 if draw is viz.plot_pose else 3] if one else scene.joints
    track = SimpleNamespace(joints3d=scene.joints[None])
    with pytest.raises(
        InputError, match=r"joints must be a tensor, .* such as track.joints3d\[0\]"
    ):
        draw(track)
    with pytest.raises(InputError, match="truth must be a tensor, got SimpleNamespace"):
        draw(joints, truth=track)
    with pytest.raises(ShapeError, match="truth must have shape"):
        draw(joints, truth=joints[:3])
    with pytest.raises(ShapeError, match="observed must have shape"):
        draw(joints, observed=torch.ones(3, dtype=torch.bool))
    if draw is not viz.plot_pose_strip:
        with pytest.raises(ShapeError, match="covariance must have shape"):
            draw(joints, covariance=torch.eye(3))


def test_many_methods_do_not_look_alike() -> None:
    errors = {str(i): torch.rand(3, 8).double() for i in range(20)}
    styles = style.method_styles(list(errors))
    assert len({(s["color"], s["linestyle"]) for s in styles.values()}) == 20
    bars = viz.plot_error_bars(errors).legends[0].get_patches()
    assert len({(bar.get_facecolor(), bar.get_hatch()) for bar in bars}) == 20


def test_arrays_are_drawn_as_tensors_are() -> None:
    drawn = as_drawn([None, 2], np.zeros((3, 2)), observed=np.ones(3, bool))
    assert torch.equal(drawn[0], torch.zeros(3, 2).double()) and bool(drawn[2].all())
    assert drawn[1] is None and drawn[3] is None


@pytest.mark.parametrize(
    "draw",
    [
        viz.plot_errors_over_time, viz.plot_error_bars, viz.plot_pcp, viz.plot_reliability,
        viz.plot_prior_means,
    ],
)  # fmt: skip
def test_curves_without_names_and_tracks_in_their_place_are_named(scene, draw) -> None:
    track = SimpleNamespace(joints3d=scene.joints[None])
    for given in (track, scene.joints):
        with pytest.raises(InputError, match=r"must go by names, as in \{"):
            draw(given)
    if draw is not viz.plot_prior_means:
        with pytest.raises(InputError, match=r"\['a'\] must be the result of torchpose.metrics"):
            draw({"a": track})


@pytest.mark.parametrize("draw", [viz.plot_joint_curves, viz.plot_pose_strip])
def test_without_matplotlib_the_error_says_what_to_install(draw, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingDependencyError, match="pip install matplotlib"):
        draw(torch.zeros(5, 8, 3))
