"""Golden outputs: numbers of one checkout, to be compared with those of another.

For changes that are to leave every number alone. Not a test: it takes two checkouts and some minutes.

    PYTHONPATH=CHECKOUT python benchmarks/golden.py write OUT.pt [--only PATTERN ...]
    python benchmarks/golden.py compare A.pt B.pt [--only PATTERN ...] [--tolerance 1e-10] [--strict-text]
    PYTHONPATH=CHECKOUT python benchmarks/golden.py list

Every name of torchpose comes from `get`, which finds it wherever it is defined, so that modules may move.
Where a name changes on purpose, its new one goes into ALIASES.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_OPENCL_RUNTIME", "disabled")

import argparse
import contextlib
import dataclasses
import fnmatch
import functools
import importlib
import inspect
import io
import json
import math
import pkgutil
import random
import re
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np
import torch

torch.set_num_threads(1)

# Old public name -> new public name, for what a refactor renames on purpose.
ALIASES: dict[str, str] = {}
FACADES = (
    "filters",
    "body",
    "priors",
    "measure",
    "io",
    "curation",
    "recipes",
    "rendering",
    "video",
    "viz",
    "report",
    "metrics",
    "calibration",
    "rotations",
    "rotation_gaussians",
    "unscented",
    "camera",
    "camera_rig",
    "skeleton",
    "demo",
    "tracking",
)

# --- names ----------------------------------------------------------------------------------------


@functools.cache
def modules():
    """All modules of torchpose and benchmarks that can be imported, those of the package first."""
    found = []
    for root in ("torchpose", "benchmarks"):
        try:
            package = importlib.import_module(root)
        except ImportError:
            continue
        found.append(package)
        for info in pkgutil.walk_packages(package.__path__, f"{root}.", onerror=lambda name: None):
            if info.name.endswith("__main__") or root == "benchmarks":
                continue
            with contextlib.suppress(ImportError):
                found.append(importlib.import_module(info.name))
    return found


@functools.cache
def _benchmark_modules():
    found = []
    with contextlib.suppress(ImportError):
        package = importlib.import_module("benchmarks")
        for info in pkgutil.iter_modules(package.__path__, "benchmarks."):
            with contextlib.suppress(BaseException):
                found.append(importlib.import_module(info.name))
    return found


def _parameters(value):
    try:
        return set(inspect.signature(value).parameters)
    except (TypeError, ValueError):
        return set()


def get(name, has=(), where=None):
    """The public object of this name.

    has: names of parameters (attributes of a class) that it must have, where several modules define the
    name. where: any other condition on it.
    """
    return _get(ALIASES.get(name, name), tuple(has), where)


@functools.cache
def _get(name, has, where):
    def suits(value):
        if has and not set(has) <= _parameters(value) | set(getattr(value, "__annotations__", {})):
            return False
        try:
            return where is None or bool(where(value))
        except Exception:
            return False

    root = importlib.import_module("torchpose")
    places = [root]
    for facade in FACADES:
        with contextlib.suppress(ImportError):
            places.append(importlib.import_module(f"torchpose.{facade}"))
    for place in places:
        if name in getattr(place, "__all__", ()) and suits(getattr(place, name)):
            return getattr(place, name)
    for spelled in (name, f"_{name}"):
        defined, seen = [], []
        for module in (*modules(), *_benchmark_modules()):
            if spelled not in vars(module):
                continue
            value = vars(module)[spelled]
            if inspect.ismodule(value) or not suits(value):
                continue
            home = getattr(value, "__module__", None)
            own = home == module.__name__ and home.startswith(("torchpose", "benchmarks"))
            (defined if own else seen).append(value)
        if defined or seen:
            return (defined or seen)[0]
    raise NameError(f"torchpose has no {name!r} with {has or 'any parameters'}")


class _Names:
    """tp.NAME is get("NAME")."""

    def __getattr__(self, name):
        return get(name)


tp = _Names()

# --- what is recorded -----------------------------------------------------------------------------


def record(out, **values):
    """Put tensors of nested values into a dictionary, by names such as track.joints3d."""
    for name, value in values.items():
        _flatten(out, name, value)
    return out


def _flatten(out, name, value):
    if value is None:
        return
    if isinstance(value, torch.Tensor):
        out[name] = value.detach().cpu().clone().contiguous()
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "USO":
            out[name] = "\n".join(map(str, value.ravel().tolist()))
        else:
            out[name] = torch.from_numpy(np.array(value, order="C"))
    elif isinstance(value, bool | int | float | np.generic):
        out[name] = torch.as_tensor(value, dtype=torch.float64)
    elif isinstance(value, str | Path):
        out[name] = str(value)
    elif isinstance(value, torch.nn.Module):
        for key, tensor in sorted(value.state_dict().items()):
            if isinstance(tensor, torch.Tensor):
                _flatten(out, f"{name}.{key}", tensor)
    elif isinstance(value, dict):
        for key, one in value.items():
            _flatten(out, f"{name}.{key}", one)
    elif hasattr(value, "_fields"):
        for key in value._fields:
            _flatten(out, f"{name}.{key}", getattr(value, key))
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if not field.name.startswith("_"):
                _flatten(out, f"{name}.{field.name}", getattr(value, field.name))
    elif isinstance(value, list | tuple | set | frozenset | range):
        items = sorted(value) if isinstance(value, set | frozenset) else list(value)
        if all(isinstance(one, str) for one in items):  # none at all, too
            out[name] = "\n".join(items)
        elif all(isinstance(one, bool | int | float) for one in items):
            out[name] = torch.tensor(items, dtype=torch.float64)
        else:
            for i, one in enumerate(items):
                _flatten(out, f"{name}[{i}]", one)


CAPABILITIES = {}


def capability(name):
    """Register a function of a temporary folder that returns named values."""

    def register(function):
        CAPABILITIES[name] = function
        return function

    return register


def gen(seed=0):
    return torch.Generator().manual_seed(seed)


def rng(seed=0):
    return np.random.default_rng(seed)


def normal(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=gen(seed), dtype=dtype)


def attempt(out, name, function):
    """Record what a function gives, or that it refuses with which error."""
    try:
        record(out, **{name: function()})
    except Exception as error:  # an error is an output, too
        out[f"{name}.error"] = type(error).__name__


# --- made-up inputs -------------------------------------------------------------------------------

UPPER = (
    "hand_left",
    "elbow_left",
    "shoulder_left",
    "head",
    "neck",
    "shoulder_right",
    "elbow_right",
    "hand_right",
)
K = np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]])


def moving(n_frames=200, seed=0, size=1.0, noise=0.003):
    """Eight joints [T, 8, 3] in camera axes, metres: arms that swing."""
    r = rng(seed)
    t = np.arange(n_frames) / 30
    joints = np.zeros((n_frames, 8, 3))
    neck = np.array([0.0, -0.3, 2.0]) + 0.05 * np.sin(t * 0.7)[:, None] * r.normal(size=3)
    joints[:, 4], joints[:, 3] = neck, neck + np.array([0, -0.2, 0])
    for sign, (hand, elbow, shoulder) in ((1, (0, 1, 2)), (-1, (7, 6, 5))):
        a, b = r.uniform(0.3, 1.2, 2)
        up = 1.2 * np.sin(a * t + r.uniform(0, 6)) - 0.3
        aside = 0.8 * np.sin(b * t + r.uniform(0, 6))
        ahead = np.stack(
            [sign * np.cos(up) * np.cos(aside), -np.sin(up), -np.cos(up) * np.sin(aside)], -1
        )
        joints[:, shoulder] = neck + np.array([sign * 0.18, 0.1, 0])
        joints[:, elbow] = joints[:, shoulder] + 0.28 * ahead
        joints[:, hand] = joints[:, elbow] + 0.26 * ahead
    joints = neck[:, None] + size * (joints - neck[:, None])
    return torch.from_numpy(joints + noise * r.normal(size=joints.shape))


def pixels(joints, noise=2.0, seed=0):
    uv = (joints.numpy() @ K.T)[..., :2] / joints.numpy()[..., 2:]
    return torch.from_numpy(uv + noise * rng(seed).normal(size=uv.shape))


def clips(batch=3, n_frames=12):
    """Keypoints [B, T, 8, 2] of all joints."""
    return torch.stack(
        [pixels(moving(n_frames, seed=i, size=1 + 0.04 * i), seed=i) for i in range(batch)]
    )


def recordings(n=2, n_frames=120, **facts):
    return [
        get("Recording", has=("joints", "person"))(
            moving(n_frames, seed=i), UPPER, 30.0, f"p{i}", "wave", "site:set@1:file", **facts
        )
        for i in range(n)
    ]


def mixture(k=4, dim=3, seed=0, spread=2.0):
    g = gen(seed)
    weights = torch.rand(k, generator=g, dtype=torch.float64) + 0.3
    factor = torch.randn(k, dim, dim, generator=g, dtype=torch.float64)
    covs = factor @ factor.mT + 0.3 * torch.eye(dim, dtype=torch.float64)
    means = spread * torch.randn(k, dim, generator=g, dtype=torch.float64)
    return tp.GaussianMixture(weights / weights.sum(), means, covs)


def parameters(gmm):
    """Weights, means, covariances by name."""
    return dict(zip(("weights", "means", "covariances"), gmm.parameters_tuple(), strict=True))


@functools.cache
def prior(name):
    return tp.load_prior(name)


# --- the upper-body tracker -----------------------------------------------------------------------

HANDS = ("head", "hand_left", "hand_right")
PRIORS = ("kinect-upper-body", "kinect-upper-body-small")
METHODS = (
    "window-mixture",
    "mkf-fixed",
    "mkf-sampled",
    "mkf-split",
    "pf-mixture",
    "pf-walk",
    "pf-walk-unscaled",
)


def own_options(method):
    wide = {"dtype": torch.float64}
    return wide | {"n_particles": 200} if method.startswith("pf") else wide


def tracker(name, method, **options):
    one = prior(name)
    return tp.UpperBodyTracker(
        one, options.pop("camera", one.camera), method, **(own_options(method) | options)
    )


def gaps(uv):
    """The keypoints with NaN, a mask, confidences and covariances."""
    uv = uv.clone()
    batch, n, joints, _ = uv.shape
    uv[0, 3:6, 0] = torch.nan
    uv[1, 7] = torch.nan
    r = rng(5)
    mask = torch.from_numpy(r.random((batch, n, joints)) > 0.2)
    confidence = torch.from_numpy(r.uniform(0.2, 1.0, (batch, n, joints)))
    confidence[2, 2, 1] = 0
    confidence[0, 8, 1] = torch.nan
    factor = torch.from_numpy(r.normal(size=(batch, n, joints, 2, 2)))
    cov = 3 * factor @ factor.mT + 4 * torch.eye(2, dtype=torch.float64)
    return uv, mask, confidence, cov


def tracker_methods():
    def make(name, method):
        def function(folder):
            return track_with(name, method)

        return function

    for name in PRIORS:
        for method in METHODS:
            CAPABILITIES[f"tracker/{name}/{method}"] = make(name, method)


def track_with(name, method):
    out = {}
    uv, mask, confidence, cov = gaps(clips())
    model = tracker(name, method)
    record(
        out,
        all_joints=model(uv, mask=mask, generator=gen(1)),
        measurement_cov=model.measurement_cov,
    )
    picked = [UPPER.index(n) for n in HANDS]
    hands, sure, sizes = uv[:, :, picked], confidence[:, :, picked], cov[:, :, picked]
    given = {"names": HANDS}
    lengths = torch.tensor([12, 9, 5])
    record(
        out,
        confidences=model(hands, sure, generator=gen(2), **given),
        covariances=model(hands, covariance=sizes, generator=gen(3), **given),
        lengths=model(hands, generator=[gen(i) for i in range(3)], lengths=lengths, **given),
    )
    state = model.init(3, HANDS, gen(4))
    live = []
    for t in range(12):
        extra = (
            {"confidence": sure[:, t]}
            if t % 3 == 1
            else {"covariance": sizes[:, t]}
            if t % 3
            else {}
        )
        state, pose = model.step(state, hands[:, t], mask=mask[:, t][:, picked], **extra)
        live.append(pose)
    for field in live[0]._fields:
        record(out, **{f"live.{field}": torch.stack([getattr(p, field) for p in live], 1)})
    state = model.init(3, HANDS, gen(4))
    for i, rows in enumerate((slice(0, 5), slice(5, 12))):
        state, block = model.advance(state, hands[:, rows], covariance=sizes[:, rows])
        record(out, **{f"advance{i}": block})
    record(
        out,
        body_frame=tracker(
            name, method, frame="body", measurement_std=[2.0, 3, 4, 5, 6], calibrated=False
        )(hands, generator=gen(5), **given),
    )
    if method in ("window-mixture", "mkf-fixed"):
        for lag in ("full", 3 if method == "mkf-fixed" else 16):
            smoother = tracker(name, method, smoothing=lag)
            record(out, **{f"smooth_{lag}": smoother(hands, lengths=lengths, **given)})
        single = tracker(name, method, dtype=torch.float32)
        record(out, single_precision=single(hands.float(), **given))
        record(out, differentiated=gradients(name, method, hands))
        own = tp.PinholeCamera(600, 610, 300, 250, 640, 480)
        record(
            out,
            slower=tracker(name, method, fps=15.0, camera=own)(hands, **given),
            static_camera=tracker(name, method, static_camera=True)(hands, **given),
            one_frame=model(hands[:, :1], **given),
        )
    if method == "window-mixture":
        record(
            out,
            unsteady=tracker(name, method, steady=False)(hands, **given),
            powered=tracker(name, method, likelihood_power=0.7)(hands, **given),
            default=tp.UpperBodyTracker(prior(name), prior(name).camera)(hands, **given),
            neck=tracker(name, method, neck="mid-shoulder")(
                uv[:, :, [3, 4, 0, 7]], names=("head", "neck", *HANDS[1:])
            ),
            long=model(clips(1, 40)[:, :, picked], **given),
        )
    if method.startswith("pf"):
        narrow = tp.UpperBodyTracker(prior(name), prior(name).camera, method, n_particles=100)
        record(out, single_precision=narrow(hands, generator=gen(6), **given))
    if method == "mkf-fixed":
        for transition, options in (("stationary", {}), ("ou", {"gamma": 0.1})):
            attempt(
                out,
                f"transition_{transition}",
                lambda t=transition, o=options: tracker(name, method, transition=t, **o)(
                    hands, **given
                ),
            )
    return out


def gradients(name, method, hands):
    uv = hands[:2, :8].clone()
    known = uv.isfinite().all(-1, keepdim=True)
    free = uv.nan_to_num(0).requires_grad_()
    std = torch.tensor([3.0, 3, 3, 3, 3], dtype=torch.float64, requires_grad=True)
    model = tracker(name, method, measurement_std=torch.nn.Parameter(std.detach().clone()))
    track = model(torch.where(known, free, torch.nan), names=HANDS)
    scalar = (
        track.joints3d.square().sum()
        + track.log_evidence.sum() * 1e-3
        + track.covariance3d.diagonal(dim1=-2, dim2=-1).sum()
    )
    wanted = [p for p in model.parameters() if p.requires_grad]
    found = torch.autograd.grad(scalar, [free, *wanted], allow_unused=True)
    named = {"scalar": scalar, "keypoints": found[0]}
    for i, value in enumerate(found[1:]):
        if value is not None:
            named[f"parameter{i}"] = value
    return named


tracker_methods()


@capability("tracker/files")
def tracker_files(folder):
    out = {}
    uv = gaps(clips())[0]
    track = tracker(PRIORS[1], "window-mixture")(uv)
    track.save(folder / "three.npz")
    record(out, three=tp.PoseTrack.load(folder / "three.npz"), npz=load_npz(folder / "three.npz"))
    one = track.sequence(1)
    one.save(folder / "one.npz")
    record(
        out,
        one=tp.PoseTrack.load(folder / "one.npz"),
        cut=track.sequence(-1),
        narrow=track.in_precision(torch.float32),
    )
    tp.write_bvh(one, folder / "one.bvh")
    tp.write_pose_csv(one, folder / "one.csv")
    record(
        out,
        bvh=numbers_of(folder / "one.bvh"),
        bvh_text=(folder / "one.bvh").read_text(),
        csv=numbers_of(folder / "one.csv"),
        csv_text=(folder / "one.csv").read_text(),
        motion=tp.joints_to_bvh(one.joints3d[0]),
    )
    return out


@capability("tracker/state")
def tracker_state(folder):
    """Registered tensors, options, what is chosen, what is refused."""
    out = {}
    for name in PRIORS:
        model = tp.UpperBodyTracker(prior(name), prior(name).camera)
        record(
            out,
            **{
                f"{name}.method": model.method,
                f"{name}.prior": prior(name),
                f"{name}.info": prior(name).info,
                f"{name}.noise": prior(name).noise,
            },
        )
    for method in METHODS:
        record(out, **{f"options.{method}": tp.method_options(method)})
    for i, (smoothing, fps) in enumerate(((None, 30.0), ("full", 30.0), (4, 30.0), (40, 60.0))):
        chosen = tp.choose_method(prior(PRIORS[0]), None, smoothing, fps, ())
        record(out, **{f"chosen{i}": chosen})
    model = tp.UpperBodyTracker(prior(PRIORS[1]), prior(PRIORS[1]).camera)
    attempt(out, "infinite", lambda: model(torch.full((1, 2, 8, 2), math.inf)))
    attempt(out, "nothing", lambda: model(torch.full((1, 2, 8, 2), math.nan)))
    attempt(out, "unknown", lambda: model(torch.zeros(1, 2, 1, 2), names=["tail"]))
    attempt(out, "shape", lambda: model(torch.zeros(1, 2, 8, 3)))
    attempt(out, "no_method", lambda: tracker(PRIORS[1], "kalman"))
    attempt(out, "no_option", lambda: tracker(PRIORS[1], "window-mixture", n_tracks=3))
    return out


def load_npz(path):
    with np.load(path, allow_pickle=False) as arrays:
        return {key: arrays[key] for key in sorted(arrays.files)}


NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w])")


def numbers_of(path):
    """All numbers of a text file, in their order."""
    text = Path(path).read_text()
    return torch.tensor([float(v) for v in NUMBER.findall(text)], dtype=torch.float64)


# --- filters --------------------------------------------------------------------------------------

DIM, OBSERVED = 4, [0, 2]


def small_problem(batch=2, n_frames=14, seed=0):
    r = rng(seed)
    process = torch.from_numpy(np.diag(r.uniform(0.2, 1.0, DIM)))
    root = torch.from_numpy(r.normal(size=(2, 2)))
    noise = root @ root.mT + 0.5 * torch.eye(2, dtype=torch.float64)
    z = torch.from_numpy(1.5 * r.standard_normal((batch, n_frames, 2)))
    mask = torch.from_numpy(r.random((batch, n_frames, 2)) > 0.3)
    each = torch.from_numpy(r.normal(size=(batch, n_frames, 2, 2)))
    each = each @ each.mT + 0.3 * torch.eye(2, dtype=torch.float64)
    return mixture(5, DIM), process, noise, z, mask, each


def run_filter(model, z, mask, each, out, name, lengths=None):
    batch = len(z)
    record(
        out,
        **{
            f"{name}.plain": model(z, generator=gen(1), return_cov=True),
            f"{name}.gaps": model(z, mask, generator=gen(2), return_cov=True),
            f"{name}.noise": model(z, mask, each, generator=gen(3)),
            f"{name}.lengths": model(
                z, mask, lengths=lengths, generator=[gen(i) for i in range(batch)]
            ),
        },
    )
    state = model.init(batch, gen(4))
    steps = []
    for t in range(z.shape[1]):
        extra = {"measurement_cov": each[:, t]} if t > 8 else {}
        state, step = model.step(
            state, z[:, t], mask[:, t], generator=gen(t), return_cov=True, **extra
        )
        steps.append(step)
    for field in ("mean", "log_weights", "log_evidence", "cov"):
        if getattr(steps[0], field) is not None:
            record(
                out, **{f"{name}.step.{field}": torch.stack([getattr(s, field) for s in steps], 1)}
            )


def ess(output):
    value = output.effective_sample_size
    return value() if callable(value) else value


@capability("filters/mkf")
def mkf(folder):
    out = {}
    gmm, process, noise, z, mask, each = small_problem()
    lengths = torch.tensor([14, 6])
    common = (gmm, process, noise, OBSERVED)
    kinds = {
        "fixed": {},
        "fixed_paper": {"transition": "paper", "uniform_weight": 0.0},
        "stationary": {"transition": "stationary"},
        "ou": {"transition": "ou", "gamma": 0.2},
        "subspace": {"transition": "ou", "gamma": 0.3, "subspace": 2},
        "burn_in": {"burn_in": 4},
        "initial": {"initial_cov": 3 * torch.eye(DIM, dtype=torch.float64)},
        "power": {"likelihood_power": 0.5, "reset_below": 1e-6},
        "single": {"dtype": torch.float32},
        "frame": {"weighting": "frame", "likelihood_power": 0.6},
        "sampled": {"tracks": "sampled", "n_tracks": 8},
        "split": {"tracks": "split", "n_tracks": 6},
        "sampled_all": {"tracks": "sampled", "resample_threshold": 1.0, "burn_in": 3},
    }
    for name, options in kinds.items():
        model = tp.MixtureKalmanFilter(*common, **options)
        run_filter(model, z, mask, each, out, name, lengths)
    record(out, ess=ess(tp.MixtureKalmanFilter(*common)(z)))
    for name in ("fixed", "ou", "power", "frame"):
        model = tp.MixtureKalmanFilter(*common, **kinds[name])
        for lag in (0, 1, 4, None):
            attempt(
                out,
                f"smooth.{name}.{lag}",
                lambda m=model, g=lag: m.smooth(z, mask, lag=g, return_cov=True),
            )
            attempt(
                out,
                f"smooth_noise.{name}.{lag}",
                lambda m=model, g=lag: m.smooth(z, mask, each, lengths, lag=g),
            )
    # a long batch, whose blocks go through the scan
    long_z = normal(3, 90, 2, seed=8)
    model = tp.MixtureKalmanFilter(*common)
    record(
        out,
        scan=model(long_z, return_cov=False),
        scan_cov=model(long_z, return_cov=True).cov[:, ::10],
        scan_frame=tp.MixtureKalmanFilter(
            *common, weighting="frame", transition="ou", gamma=0.0, uniform_weight=None
        )(long_z),
    )
    # points as geometric medians, where frames are alone
    gmm6 = mixture(4, 6, seed=3)
    attempt(
        out,
        "medians",
        lambda: tp.MixtureKalmanFilter(
            gmm6,
            torch.ones(6, dtype=torch.float64),
            torch.ones(2, dtype=torch.float64),
            [0, 3],
            transition="ou",
            gamma=0.0,
            weighting="frame",
            medians=[0, 3],
        )(normal(2, 5, 2, seed=9), return_cov=True),
    )
    return out


@capability("filters/mkf gradients")
def mkf_gradients(folder):
    out = {}
    gmm, process, noise, z, mask, each = small_problem()
    for name, options in {
        "fixed": {},
        "frame": {"weighting": "frame"},
        "split": {"tracks": "split"},
        "ou": {"transition": "ou", "gamma": 0.2},
    }.items():
        for given in ("shared", "each"):
            free_z = z.clone().requires_grad_()
            R = noise.clone().requires_grad_()
            Q = process.diagonal().clone().requires_grad_()
            cov = each.clone().requires_grad_() if given == "each" else None
            model = tp.MixtureKalmanFilter(gmm, Q, R, OBSERVED, **options)
            found = model(free_z, mask, cov, return_cov=True)
            scalar = found.mean.square().sum() + found.log_evidence.sum() + found.cov.sum()
            wanted = {"z": free_z, "R": R, "Q": Q, "each": cov}
            wanted = {key: value for key, value in wanted.items() if value is not None}
            grads = torch.autograd.grad(scalar, list(wanted.values()), allow_unused=True)
            record(out, **{f"{name}.{given}.value": scalar})
            record(
                out,
                **{f"{name}.{given}.{key}": grad for key, grad in zip(wanted, grads, strict=True)},
            )
    return out


@capability("filters/particle")
def particle(folder):
    out = {}
    gmm, process, noise, z, mask, each = small_problem()
    for proposal in ("mixture", "random-walk", "random-walk-unscaled"):
        model = tp.BootstrapParticleFilter(
            gmm, process, noise, OBSERVED, proposal, 150, dtype=torch.float64
        )
        run_filter(model, z, mask, each, out, proposal, torch.tensor([14, 6]))
    for name, options in {
        "single": {},
        "stratified": {"resampling": "stratified"},
        "residual": {"resampling": "residual"},
        "multinomial": {"resampling": "multinomial"},
        "measured": {"start": "measured"},
        "ou": {"transition": "ou", "gamma": 0.2},
        "stationary": {"transition": "stationary"},
        "burn_in": {"proposal": "random-walk", "burn_in": 5},
        "always": {"resample_threshold": 1.0},
        "initial": {"initial_cov": torch.eye(DIM, dtype=torch.float64)},
    }.items():
        model = tp.BootstrapParticleFilter(
            gmm, process, noise, OBSERVED, n_particles=100, **options
        )
        attempt(out, name, lambda m=model: m(z, mask, generator=gen(1), return_cov=True))
    return out


@capability("filters/others")
def other_filters(folder):
    out = {}
    z = normal(2, 20, 3, seed=1).cumsum(1)
    model = tp.ConstantVelocityFilter(1e4, 30.0)
    record(out, forward=model(z), full=model.smooth(z))
    for lag in (0, 1, 5, None):
        record(out, **{f"smooth.{lag}": model.smooth(z, torch.tensor([20, 11]), lag)})
    state, steps = model.init(z[:, 0]), []
    for t in range(1, 20):
        state, value = model.step(state, z[:, t])
        steps.append(value)
    record(out, steps=torch.stack(steps, 1), last=state)
    state = model.init(z[:, 0])
    state, block = model.advance(state, z[:, 1:8])
    record(out, advance=block)
    gmm = mixture(3, 4, seed=2)
    walks = 0.3 * normal(4, 25, 4, seed=3).cumsum(1)
    record(
        out,
        gamma=tp.fit_gamma(gmm, walks),
        shared=tp.fit_gamma(gmm, walks, shared=True),
        subspace=tp.fit_gamma(gmm, walks, subspace=2, n_iterations=20),
        lengths=tp.fit_gamma(gmm, walks, torch.tensor([25, 20, 10, 5])),
    )
    logw = normal(3, 40, seed=4).log_softmax(-1)
    for method in ("systematic", "stratified", "multinomial", "residual"):
        resample = get("resample", has=("log_weights",))
        record(
            out,
            **{
                f"resample.{method}": resample(logw, method, gen(5)),
                f"resample_few.{method}": resample(logw, method, [gen(i) for i in range(3)], 7),
            },
        )
    logl = 3 * normal(2, 50, seed=6)
    record(
        out,
        survival=tp.survival_rate(logl),
        exponent=tp.survival_exponent(logl, 0.4),
        per_frame=tp.survival_rate_per_frame(0.2, 60.0),
        ess=get("effective_sample_size", has=("log_weights",))(logw),
    )
    record(
        out,
        systematic=tp.systematic(logw, gen(1)),
        stratified=tp.stratified(logw, gen(1)),
        multinomial=tp.multinomial(logw, gen(1)),
        residual=tp.residual(logw, gen(1)),
    )
    for kind, options in {
        "paper": {},
        "stationary": {},
        "ou": {"gamma": torch.full((3,), 0.3).double()},
    }.items():
        parts = parameters(gmm)
        record(
            out,
            **{
                f"transition.{kind}": tp.make_transition(
                    kind,
                    parts["means"],
                    parts["covariances"],
                    torch.eye(4, dtype=torch.float64),
                    **options,
                )
            },
        )
    found = tp.geometric_median(
        torch.rand(6, 3, generator=gen(1)).double(),
        normal(6, 3, 2, 3, seed=2),
        torch.rand(3, 2, generator=gen(3)).double() + 0.1,
        normal(6, 2, 3, seed=4),
    )
    return record(out, median=found)


@capability("gaussian")
def gaussian_functions(folder):
    out = {}
    a, b = normal(5, 4, 4, seed=1), normal(5, 4, 4, seed=2)
    eye = torch.eye(4, dtype=torch.float64)
    A, B, x, y = a @ a.mT + eye, b @ b.mT + eye, normal(5, 4, seed=3), normal(5, 4, seed=4)
    chol = torch.linalg.cholesky(A)
    index = torch.tensor([0, 2])
    singular = A.clone()
    singular[0] = torch.ones(4, 4).double()
    record(
        out,
        symmetrised=tp.symmetrise(a),
        cholesky=tp.safe_cholesky(A),
        mended=tp.mended_cholesky(singular),
        product=get("product", has=("mean_a", "cov_b"))(x, A, y, B),
        marginal=get("marginal", has=("mean", "cov"))(x, A, index),
        condition=get("condition", has=("mean", "cov"))(x, A, index, y[:, :2]),
        log_prob=get("log_prob", has=("x", "mean", "cholesky"))(x, y, chol),
        predict=tp.kalman_predict(x, A, a, y, B),
        update=tp.kalman_update(
            x, A, y[:, :2], B[:, :2, :2], index, torch.tensor([[True, True]] * 4 + [[True, False]])
        ),
        mixture_moments=tp.mixture_moments(y[:, 0].log_softmax(0), x, A),
    )
    return out


# --- bodies and their filters ----------------------------------------------------------------------

HEIGHT, WIDTH = 60, 80


@functools.cache
def walker():
    return tp.Body.of_height(get("BODY_15"), 1.75)


@functools.cache
def rig(n=3):
    """Cameras around the origin of a room whose y axis points up."""
    import cv2

    cameras = []
    for i in range(n):
        angle = 2 * math.pi * i / 3 + 0.4
        ahead = np.array([-math.sin(angle), 0.0, -math.cos(angle)])
        down = np.array([0.0, -1.0, 0.0])
        R = np.stack([np.cross(down, ahead), down, ahead])
        centre = np.array([0.0, 0.95, 0.0]) - 3.5 * ahead
        cameras.append(
            tp.PinholeCamera(
                90,
                90,
                (WIDTH - 1) / 2,
                (HEIGHT - 1) / 2,
                WIDTH,
                HEIGHT,
                f"c{i}",
                rotation=cv2.Rodrigues(R)[0].ravel().tolist(),
                translation=(-R @ centre).tolist(),
            )
        )
    return tp.CameraRig(cameras)


def strides(n_frames, seed=0, speed=0.02, phase=0.0, heading=0.3):
    """States [T, 36] of a walk of `walker`, at 60 Hz."""
    body = walker()
    t = torch.arange(n_frames, dtype=torch.float64)
    angle = phase + 2 * math.pi * t / 60
    states = torch.zeros(n_frames, body.dim, dtype=torch.float64)
    along = torch.tensor([math.sin(heading), 0.0, math.cos(heading)], dtype=torch.float64)
    states[:, :3] = (t - n_frames / 2)[:, None] * speed * along
    states[:, 1] = 0.93 + 0.02 * (2 * angle).cos()
    states[:, 4] = math.sin(heading / 2)
    swings = {
        "left_thigh": 0.5 * angle.sin(),
        "right_thigh": -0.5 * angle.sin(),
        "left_shank": 0.5 + 0.4 * angle.cos(),
        "right_shank": 0.5 - 0.4 * angle.cos(),
        "left_upper_arm": -0.5 * angle.sin(),
        "right_upper_arm": 0.5 * angle.sin(),
        "left_forearm": -0.5 - 0.2 * angle.sin(),
        "right_forearm": -0.5 + 0.2 * angle.sin(),
    }
    for part, swing in swings.items():
        states[:, 3 + 3 * body.skeleton.part(part)] = (swing / 2).sin()
    rate, shift = torch.rand(2, body.dim, generator=gen(seed), dtype=torch.float64).unbind()
    drift = 0.03 * (2 * math.pi * (t[:, None] * (0.2 + rate) / 60 + shift)).sin()
    states[:, 6:] += drift[:, 6:]
    return states


@functools.cache
def seen_walk(n_cameras=3, n_frames=6):
    """The state before, and silhouettes [T, C, H, W] with nobody in the fourth frame."""
    states = strides(n_frames + 1)
    silhouettes = tp.render(walker(), states[1:], rig(n_cameras), HEIGHT, WIDTH)
    silhouettes[3] = False
    return states[0], states[1:], silhouettes


def run_body(out, name, model, start, silhouettes, cameras, body=None):
    track = model(silhouettes, cameras, start, gen(1))
    record(out, **{name: track, f"{name}.step_std": model.step_std})
    if track.mean.shape[-1] == walker().dim:
        poses = tp.track_body(
            model,
            iter(silhouettes),
            cameras,
            start,
            gen(1),
            fps=60.0,
            initial_std=0.02 * torch.ones(walker().dim, dtype=torch.float64),
        )
        record(
            out,
            **{
                f"{name}.streamed": {
                    f.name: getattr(poses, f.name)
                    for f in dataclasses.fields(poses)
                    if f.name != "body"
                }
            },
        )
    state = model.init(torch.stack([start, start]), [gen(2), gen(3)])
    steps = []
    for t in range(2):
        state, step = model.step(
            state, torch.stack([silhouettes[t]] * 2), cameras, [gen(4 + t), gen(9)]
        )
        steps.append(step)
    record(out, **{f"{name}.batched": steps})
    return out


def body_options():
    step = tp.motion_std(walker(), strides(60, seed=3), floor=1e-3)
    return {"process_cov": step.square(), "sharpness": 60.0}


@capability("body/sir")
def body_sir(folder):
    out, (start, _, silhouettes) = {}, seen_walk()
    options = body_options()
    limits = tp.JointLimits.fit(strides(90, seed=5))
    for name, more in {
        "plain": {},
        "overlap": {"likelihood": "overlap", "sharpness": 30.0},
        "map": {"estimate": "map"},
        "limits": {"limits": limits},
        "discard": {"limits": limits, "limit_mode": "discard"},
        "survival": {"survival_rate": 0.3},
        "swap": {"leg_swap": 0.3},
        "rectangles": {"limb_shape": "rectangles"},
        "residual": {"resampling": "residual", "resample_threshold": 0.5},
    }.items():
        try:
            model = tp.SIRParticleFilter(walker(), 60, **(options | more))
        except Exception as error:
            out[f"{name}.error"] = type(error).__name__
            continue
        run_body(out, name, model, start, silhouettes, rig())
    start, _, silhouettes = seen_walk(2)
    run_body(out, "two", tp.SIRParticleFilter(walker(), 60), start, silhouettes, rig(2))
    model = tp.SIRParticleFilter(tp.Body.of_height(get("BODY_15"), 1.75).float(), 60)
    record(out, single=model(silhouettes, rig(2), start.float(), gen(1)))
    return out


@capability("body/annealed")
def body_annealed(folder):
    out, (start, _, silhouettes) = {}, seen_walk()
    for name, more in {
        "plain": {},
        "schedule": {"schedule": (0.1, 0.4, 1.0)},
        "decay": {"noise_decay": 0.5, "survival_rate": 0.3},
    }.items():
        model = tp.AnnealedParticleFilter(walker(), 30, n_layers=3, **(body_options() | more))
        run_body(out, name, model, start, silhouettes, rig())
    return out


@capability("body/manifold")
def body_manifold(folder):
    out, (start, _, silhouettes) = {}, seen_walk()
    manifold = tp.load_manifold("walk")
    record(out, shipped=manifold, info=manifold.info)
    body = walker().altered(
        frame=manifold.info.frame,
        centres=torch.tensor(manifold.info.centres).double() if manifold.info.centres else None,
    )
    start = walker().convert(start, body)
    poses = body.relative(walker().convert(strides(8), body))
    z = manifold.to_latent(poses)
    record(
        out,
        latent=z,
        mean=manifold.pose_mean(z),
        pose=manifold.to_pose(z),
        back=manifold.reconstruct(poses),
        forward=manifold(poses),
        error=manifold.reconstruction_error(poses),
        at_rate=manifold.at_rate(30.0),
        start=start,
    )
    for name, more in {
        "plain": {},
        "published": {"weights": "published"},
        "30": {"fps": 30.0},
    }.items():
        own = manifold.at_rate(30.0) if "fps" in more else manifold
        try:
            model = tp.ManifoldParticleFilter(body, own, 60, sharpness=60.0, **more)
        except Exception as error:
            out[f"{name}.error"] = type(error).__name__
            continue
        run_body(out, name, model, start, silhouettes, rig())
    for proposal in ("product", "diffusion"):
        attempt(
            out,
            f"proposal_{proposal}",
            lambda p=proposal: tp.ManifoldParticleFilter(body, manifold, 40, proposal=p)(
                silhouettes, rig(), start, gen(1)
            ),
        )
    manifold.save(folder / "m.safetensors")
    record(out, loaded=tp.BackConstrainedGPLVM.load(folder / "m.safetensors"))
    return out


@capability("body/root uncertainty")
def body_root(folder):
    out, (start, _, silhouettes) = {}, seen_walk()
    for kind in ("walk", "exercises"):
        conditionals = tp.load_limb_conditionals(kind)
        record(
            out,
            **{
                f"shipped.{kind}": conditionals,
                f"info.{kind}": conditionals.info,
                f"at_rate.{kind}": conditionals.at_rate(25.0),
            },
        )
        body = walker().altered(frame="body", centres=conditionals.centres)
        begin = walker().convert(start, body)
        mean, cov = begin[6:].view(-1, 3), 0.01 * torch.eye(3, dtype=torch.float64).expand(10, 3, 3)
        record(out, **{f"diffused.{kind}": conditionals.diffuse(mean, cov)})
        for name, more in {
            "plain": {},
            "body": {"weighting": "body"},
            "published": dict(get("PUBLISHED")),
            "mean": {"estimate": "mean", "leg_swap": 0.3},
            "sum": {"camera_rule": "sum"},
        }.items():
            if kind == "exercises" and name != "plain":
                continue
            noise = torch.full((body.dim,), 0.01).square()
            model = tp.RootUncertaintyTracker(
                body, conditionals, 21, fps=60.0, process_cov=noise, **more
            )
            run_body(out, f"{kind}.{name}", model, begin, silhouettes, rig())
    conditionals.save(folder / "c.safetensors")
    record(out, loaded=tp.LimbConditionals.load(folder / "c.safetensors"))
    groups = tp.part_groups(get("BODY_15"))
    points = 0.1 * normal(2, 10, 7, 3, seed=3)
    counts = tp.count_positions(
        body, torch.stack([begin] * 2), points, rig(), tp.prepare_silhouettes(silhouettes[0])
    )
    logs = {
        f"{n}.{c}": tp.part_log_likelihood(counts, normalisation=n, cameras=c)
        for n in ("published", "share")
        for c in ("product", "sum")
    }
    observed = tp.observation_gaussians(
        points, logs["share.product"], points.mean(-2), cov.expand(2, 10, 3, 3), 0.02
    )
    return record(out, groups=groups, counts=counts, part_log=logs, observed=observed)


@capability("body/constrained")
def body_constrained(folder):
    out, (start, _, silhouettes) = {}, seen_walk()
    bank = tp.load_action("exercises")
    record(out, shipped=bank, names=bank.names, info=bank.info)
    body = walker()
    step = tp.constant_velocity_std(body, strides(40), 60.0, 60.0, floor=0.01)
    record(out, step=step, rescaled=tp.rescale_std(step, 1 / 60, 1 / 25))
    postures = [
        get("state_postures")(body, strides(36 + i, seed=i, phase=0.1 * i)) for i in range(6)
    ]
    space = tp.ActionSpace.fit(postures, 4, name="walk", fps=60.0)
    own = tp.ActionBank([space, tp.ActionSpace.fit(postures[1:], 3, name="again", fps=60.0)])
    for name, action in {"shipped": bank, "space": space, "bank": own, "none": None}.items():
        for weights in ("published", "normalised"):
            try:
                model = tp.ConstrainedParticleFilter(
                    body,
                    action,
                    60,
                    process_cov=step.square(),
                    fps=60.0,
                    weights=weights,
                    likelihood="overlap",
                    max_redraws=10,
                )
            except Exception as error:
                out[f"{name}.{weights}.error"] = type(error).__name__
                continue
            run_body(
                out, f"{name}.{weights}", model, start, silhouettes[:, :2], rig().select([0, 1])
            )
    return out


@capability("body/first pose")
def body_first_pose(folder):
    out = {}
    truth = strides(6, phase=1.0)
    silhouettes = tp.render(walker(), truth, rig(), HEIGHT, WIDTH)
    quick = {"n_particles": 200, "n_tracking": 40, "n_frames": 3}
    found = tp.find_first_pose(walker(), silhouettes, rig(), None, gen(0), fps=60.0, **quick)
    record(out, first=found)
    manifold = tp.load_manifold("walk")
    body = walker().altered(
        frame=manifold.info.frame,
        centres=torch.tensor(manifold.info.centres).double() if manifold.info.centres else None,
    )
    record(
        out,
        with_manifold=tp.find_first_pose(
            body, silhouettes, rig(), manifold, gen(0), fps=60.0, **quick
        ),
    )
    record(
        out,
        candidates=tp.find_candidates(
            walker(), silhouettes[:1], rig(), None, gen(0), n_particles=150
        ),
        pose=tp.find_pose(
            walker(), silhouettes[:1], rig(), None, gen(0), n_particles=150, n_layers=4
        ),
        turned=tp.turned_round(walker(), truth),
        legs=tp.leg_angle(walker(), truth),
        exchanged=tp.exchange_legs(walker(), truth),
        up=tp.upward_direction(rig()),
        evidence=tp.facing_evidence(walker(), truth, torch.tensor([0.0, 1, 0]).double()),
        place=tp.place_from_silhouettes(silhouettes, rig(), 1.75),
    )
    return out


@capability("body/kinematics")
def body_kinematics(folder):
    out, body, states = {}, walker(), strides(7)
    other = body.altered(
        frame="body",
        centres=0.1 * torch.cat([torch.zeros(1, 3), normal(10, 3, seed=1).float()]).double(),
    )
    step = 0.05 * normal(7, body.dim, seed=2)
    logw = normal(7, seed=3).log_softmax(-1)
    record(
        out,
        body=body,
        joints=body.joints(states),
        rotations=body.part_rotations(states),
        limbs=body.limbs(states),
        forward=body(states),
        perturbed=body.perturb(states, step),
        difference=body.difference(states, states.flip(0)),
        mean=body.mean(states, logw),
        relative=body.relative(states),
        with_relative=body.with_relative(states, body.relative(states.flip(0))),
        state_of=body.state_of(states[:, :3], body.part_rotations(states)),
        height=body.height,
        converted=body.convert(states, other),
        other=other,
        other_joints=other.joints(body.convert(states, other)),
        centres=tp.centres_of(body, states),
    )
    joints = body.joints(states)
    fitted = tp.fit_body(joints)
    again = tp.fit_state(fitted, joints)
    record(
        out,
        fitted=fitted,
        fitted_states=again,
        head=tp.fit_body(joints, head_top=0.1),
        errors=get("joint_errors", has=("body", "state"))(fitted, again, joints),
    )
    limits = tp.JointLimits.fit(strides(60))
    far = states + 0.5 * normal(7, body.dim, seed=4)
    record(
        out,
        limits=limits,
        inside=limits.inside(far),
        clamped=limits.clamp(far),
        log_limits=limits.log_prob(far),
        limit_forward=limits(far),
    )
    free = states.clone().requires_grad_()
    (grad,) = torch.autograd.grad(
        body.joints(free).square().sum() + limits.log_prob(free).sum(), free
    )
    record(out, gradient=grad)
    a, b = 0.5 * normal(6, 3, seed=5).tanh(), 0.5 * normal(6, 3, seed=6).tanh()
    R = tp.quaternion_vector_to_matrix(a)
    record(
        out,
        compose=tp.compose(a, b),
        conjugate=tp.conjugate(a),
        matrix=R,
        back=tp.matrix_to_quaternion_vector(R),
        quaternion=tp.vector_to_quaternion(a),
        vector=tp.quaternion_to_vector(tp.vector_to_quaternion(a)),
        ball=tp.within_unit_ball(3 * a),
        cross=tp.cross_matrix(a),
        minimal=tp.minimal_rotation(a, b),
        mean_rotation=tp.mean_rotation(0.3 * a, torch.rand(6, generator=gen(1)).double()),
    )
    return out


@capability("body/silhouettes")
def body_silhouettes(folder):
    out, (_, states, _) = {}, seen_walk()
    body, cameras = walker(), rig()
    truth = tp.render(body, states, cameras, HEIGHT, WIDTH)
    moved = states[:, None] + 0.03 * normal(6, 5, body.dim, seed=1)
    for shape in ("cylinders", "rectangles"):
        counts = tp.count_pixels(body, moved, cameras, truth, limb_shape=shape)
        record(
            out,
            **{
                f"{shape}.render": tp.render(
                    body, states, cameras, HEIGHT, WIDTH, limb_shape=shape
                ),
                f"{shape}.counts": counts,
                f"{shape}.bidirectional": tp.bidirectional(counts),
                f"{shape}.iou": tp.intersection_over_union(counts),
            },
        )
        for kind in ("bidirectional", "overlap"):
            record(out, **{f"{shape}.{kind}.log": tp.silhouette_log_likelihood(counts, kind, 20.0)})
    prepared = tp.prepare_silhouettes(truth)
    record(
        out,
        prepared_counts=tp.count_pixels(body, moved, cameras, prepared, chunk=3),
        limbs=tp.render_limbs(body.limbs(states), cameras, HEIGHT, WIDTH),
    )
    noisy = tp.add_faults(truth, 1.0, gen(3))
    radii = tp.fit_radii(body, states, truth, cameras, n_frames=2, n_candidates=10, n_rounds=3)
    record(out, faults=noisy, radii=radii)
    out["mean_error"] = tp.mean_joint_error(body, states, body.joints(states.flip(0)))
    sequence = get("ValidationSequence")(truth, cameras, states=states, initial_state=states[0])
    fit = tp.fit_sharpness(
        lambda s: tp.SIRParticleFilter(body, 30, sharpness=s), [sequence], n_values=3, seeds=1
    )
    return record(out, sharpness=fit, grid=tp.log_grid(1.0, 100.0, 4))


@capability("body/files")
def body_files(folder):
    out, (start, _, silhouettes) = {}, seen_walk()
    model = tp.SIRParticleFilter(walker(), 30)
    poses = tp.track_body(model, iter(silhouettes), rig(), start, gen(1), fps=60.0)
    poses.save(folder / "body.npz")
    found = tp.BodyPoses.load(folder / "body.npz")
    camera = tp.PinholeCamera(
        400, 400, 320, 240, 640, 480, rotation=[math.pi, 0, 0], translation=[0, 1, 4]
    )
    return record(
        out,
        npz=load_npz(folder / "body.npz"),
        loaded=found.state,
        body=tp.load_body(folder / "body.npz"),
        seen=vars(found.seen_by(camera)),
    )


# --- priors ---------------------------------------------------------------------------------------


@capability("priors/mixture")
def priors_mixture(folder):
    out, truth = {}, mixture(3, 4)
    x = truth.sample((600,), gen(0))
    weight = torch.rand(600, generator=gen(1)).double()
    record(
        out,
        sample=x[:20],
        log_prob=truth.log_prob(x),
        each=truth.component_log_prob(x[:9]),
        forward=truth(x[:9]),
        moments=truth.moments(),
        cholesky=truth.cholesky(),
        marginal=parameters(truth.marginal([0, 2])),
        condition=truth.condition([0, 2], x[:5, [0, 2]]),
        rounded=parameters(truth.rounded()),
    )
    for name, options in {
        "plain": {},
        "weighted": {"sample_weight": weight},
        "random": {"init": "random"},
        "restarts": {"n_init": 2, "max_iter": 8},
        "single": {"dtype": torch.float32},
    }.items():
        fitted = tp.GaussianMixture.fit(x, 3, seed=2, **options)
        record(
            out, **{name: parameters(fitted), f"{name}.report": getattr(fitted, "fit_report", None)}
        )
    stats = tp.e_step(x, truth.parameters_tuple(), weight)
    floor = 1e-6 * torch.eye(4, dtype=torch.float64)
    record(
        out,
        e_step=stats,
        packed=stats.pack(),
        m_step=tp.m_step(stats, floor),
        em=tp.expectation_maximisation(x, truth.parameters_tuple(), max_iter=5),
    )
    free = x[:9].clone().requires_grad_()
    record(out, gradient=torch.autograd.grad(truth.log_prob(free).sum(), free)[0])
    k = get("k_means")(x, 3, gen(3), torch.full((600,), 1 / 600).double())
    return record(out, k_means=k)


@capability("priors/streamed")
def priors_streamed(folder):
    out, truth = {}, mixture(3, 4, seed=4)
    x = truth.sample((9000,), gen(0))
    source = tp.TensorSource(x)
    fitted = tp.fit_streamed(source, 3, seed=1, max_iter=5)
    record(out, streamed=parameters(fitted), report=getattr(fitted, "fit_report", None))
    weights = torch.rand(9000, generator=gen(1)).double().sub(0.2).clamp_min(0)
    record(
        out,
        weighted=parameters(tp.fit_streamed(tp.TensorSource(x, weights), 3, seed=1, max_iter=3)),
    )
    em = tp.StreamedEM.start(source, 3, seed=2, init="random")
    record(
        out,
        history=tp.stepwise_pass(em, source, 5, blocks_per_step=1),
        stepwise=parameters(em.mixture()),
        em=em,
    )
    tp.run_streamed(em, source, max_iter=2)
    record(out, after=em)
    chosen = tp.select_n_components(
        source, [tp.TensorSource(x[:900] * 1.01), tp.TensorSource(x[900:1800])], [2, 3], max_iter=4
    )
    record(out, selection=chosen.rows, best=chosen.best, table=[str(chosen.table())])
    return record(
        out,
        sizes=tp.block_sizes(20001),
        seed=tp.derived_seed(3, "start pose"),
        cached=tp.cached(source).block(0),
    )


def tiny_recipe(**more):
    return tp.UpperBodyRecipe(
        **(
            {
                "n_components": 3,
                "n_samples": 1200,
                "pose_steps": 4,
                "window_components": 4,
                "window_samples": 1000,
                "window_steps": 3,
                "calibration_folds": 2,
                "drawn_pieces": 1,
            }
            | more
        )
    )


@functools.cache
def tiny_prior():
    return tiny_recipe(calibration_folds=0).fit(recordings(2), name="tiny")


def whole_prior(one):
    values = {
        "prior": one,
        "noise": one.noise,
        "left": parameters(one.left),
        "right": parameters(one.right),
    }
    info = {f.name: getattr(one.info, f.name) for f in dataclasses.fields(one.info)}
    values["info"] = {k: v for k, v in info.items() if k not in ("command", "extra")}
    values["extra"] = json.dumps(info.get("extra", {}), sort_keys=True, default=str)
    for name, window in one.windows.items():
        values[f"windows.{name}"] = {
            "left": parameters(window.left),
            "right": parameters(window.right),
            "settings": dict(window.settings),
            "layout": window.layout,
        }
    return values


@capability("priors/upper body")
def priors_upper_body(folder):
    out = {}
    plain = tp.fit_upper_body_prior(recordings(2), 3, seed=0, n_samples=1000, name="plain")
    zyx = tp.fit_upper_body_prior(
        recordings(2), 2, seed=1, n_samples=500, rotation_order="zyx", mirror=False
    )
    record(
        out,
        plain=whole_prior(plain),
        zyx=whole_prior(zyx),
        mirrored=parameters(plain.mirrored().left),
    )
    fitted = tp.fit_kinect_prior(
        recordings(2),
        3,
        0,
        n_samples=1200,
        pose_steps=4,
        window_components=4,
        window_samples=1000,
        window_steps=3,
        calibration_folds=2,
        drawn_pieces=1,
    )
    record(out, recipe=whole_prior(fitted))
    fitted.save(folder / "p.safetensors")
    record(
        out,
        loaded=whole_prior(tp.UpperBodyPrior.load(folder / "p.safetensors")),
        card=tp.model_card(fitted),
    )
    uv = clips(1)[:, :, [3, 0, 7]]
    record(out, track=tp.UpperBodyTracker(fitted, fitted.camera)(uv, names=HANDS).joints3d)
    record(
        out,
        renewed=whole_prior(
            tp.renew_noise(tiny_prior(), recordings(2), calibration_folds=2, drawn_pieces=0)
        ),
    )
    record(
        out,
        earlier=whole_prior(
            tp.fit_recipe_2(
                recordings(2),
                n_components=2,
                n_samples=500,
                pose_steps=2,
                window_components=2,
                window_samples=300,
                window_steps=2,
                calibration_folds=0,
            )
        ),
    )
    return out


@capability("priors/training states")
def priors_states(folder):
    out = {}
    poses = tp.collect_poses(recordings(2))
    matrix = torch.from_numpy(K)
    arms = tp.arm_sources(poses, matrix, seed=1, n_samples=200)
    record(
        out,
        joints=poses.joints,
        weight=poses.weight,
        left=arms.left.block(0),
        right=arms.right and arms.right.block(0),
    )
    layout = tp.WindowLayout((4, 10), (0, 10), torso=True)
    frames = poses.frames()
    views = get("TRAINING_VIEWS")
    for side in ("left", "right"):
        source = tp.WindowSource(
            matrix,
            views,
            "zxy",
            50,
            0,
            False,
            frames,
            frames.complete(layout),
            layout,
            side,
            body_size=0.3,
            bone_lengths=0.05,
            mirror_share=0.25,
        )
        record(out, **{f"window.{side}": tp.all_samples(source)})
    seen = tp.sample_viewpoints(20, generator=gen(1))
    state = tp.arm_states(poses.joints[:20], seen, matrix)
    record(
        out,
        views=seen,
        states=state,
        mirrored=tp.mirror_arm_state(state[0], 319.5),
        mirror_mixture=parameters(tp.mirror_mixture(prior(PRIORS[1]).left, 319.5)),
        increments=tp.increment_covs(poses, matrix, views, "zxy", True, 0),
        fraction=tp.learn_neck_fraction(poses.joints),
        offset=tp.learn_neck_offset(poses.joints),
        placed=tp.place_neck(poses.joints[:5], tp.learn_neck_offset(poses.joints)),
    )
    one = prior(PRIORS[1])
    record(
        out,
        process={
            f"{s}.{m}": tp.process_cov(one, s, m)
            for s in ("left", "right")
            for m in ("mkf-fixed", "pf-walk")
        },
        walk=tp.default_walk_cov(tiny_prior(), "left"),
        default=tp.default_process_cov(tiny_prior()),
        released=tp.released_process_cov(),
    )
    return out


@capability("priors/fine tuning")
def priors_fine_tuning(folder):
    out, one = {}, tiny_prior()
    sequences = [r.upper_body().joints for r in recordings(2)]
    batch = tp.draw_sequences(
        sequences, one, 3, gen(0), frames=20, body_size=0.1, bone_lengths=0.02
    )
    record(out, batch=batch)
    model = tp.TunableKalman(one, mixtures=True, evidence=0.1)
    loss = model.loss(batch)
    loss.backward()
    record(
        out,
        loss=loss,
        error=model.error(batch),
        prior=parameters(model.prior().left),
        gradients={n: p.grad for n, p in model.named_parameters()},
    )
    poses = tp.collect_poses(recordings(2))
    frames, layout = poses.frames(), one.windows["causal"].layout
    sources = {
        side: tp.WindowSource(
            torch.from_numpy(K),
            get("TRAINING_VIEWS"),
            "zxy",
            100,
            0,
            True,
            frames,
            frames.complete(layout),
            layout,
            side,
        )
        for side in ("left", "right")
    }
    windows = tp.draw_windows(sources, 0, n=12)
    model = tp.TunableWindow(one, "causal", evidence=0.1)
    loss = model.loss(windows, gen(1))
    loss.backward()
    return record(
        out,
        windows=windows,
        window_loss=loss,
        window_error=model.error(windows, gen(2)),
        window=parameters(model.window().left),
        window_gradients={n: p.grad for n, p in model.named_parameters()},
    )


def cyclic(frames, phase=0.0, seed=0, speed=1.0, noise=0.01):
    """Poses [frames, 30] of a cyclic motion."""
    sizes = torch.tensor([0.25, 0.25, 0.08, 0.08, 0.03, 0.03], dtype=torch.float64)
    g = gen(0)
    weights = torch.randn(6, 30, generator=g, dtype=torch.float64) * sizes[:, None]
    rest = 0.1 * torch.randn(30, generator=g, dtype=torch.float64)
    angle = phase + speed * 2 * math.pi * torch.arange(frames, dtype=torch.float64) / 66
    waves = [wave for n in (1, 2, 3) for wave in ((n * angle).sin(), (n * angle).cos())]
    return rest + torch.stack(waves, 1) @ weights + noise * normal(frames, 30, seed=100 + seed)


@capability("priors/gplvm")
def priors_gplvm(folder):
    out, train = {}, [cyclic(40), cyclic(30, 0.7, 1)]
    for name, options in {
        "lbfgs": {},
        "adam": {"optimiser": "adam", "smoothness": 1.0},
        "standard": {"standardise": True, "gamma_x": 0.5},
        "starts": {"n_init": 2},
    }.items():
        try:
            found = tp.BackConstrainedGPLVM.fit(train, steps=3, seed=1, **options)
        except Exception as error:
            out[f"{name}.error"] = type(error).__name__
            continue
        noisy = found.fit_noise([cyclic(35, 0.3, 2)], fps=60.0)
        z = noisy.to_latent(cyclic(9, 0.2, 3))
        record(
            out,
            **{
                name: found,
                f"{name}.noisy": noisy,
                f"{name}.z": z,
                f"{name}.pose": noisy.to_pose(z),
                f"{name}.rate": noisy.at_rate(25.0),
                f"{name}.paths": list(noisy.trajectories)
                if not callable(noisy.trajectories)
                else list(noisy.trajectories()),
            },
        )
    poses, latents = normal(12, 5, seed=1), normal(12, 2, seed=2)
    kernel = tp.KernelParameters(
        *torch.tensor([0.3, -1.2, 0.4, -0.9], dtype=torch.float64).unbind()
    )
    record(
        out,
        likelihood=get("log_likelihood", has=("poses", "latents"))(poses, latents, kernel),
        objective=get("objective", has=("poses", "latents"))(poses, latents, kernel),
        median=tp.median_gamma(poses),
        start=tp.principal_start(poses, 2),
        rbf=tp.rbf(poses[:4], poses, kernel.log_gamma),
    )
    return out


@capability("priors/limbs")
def priors_limbs(folder):
    out = {}
    states = [strides(60, seed=s, phase=s, speed=0.01) for s in (1, 2)]
    body, own = tp.in_body_frame([(walker(), states)])
    found = tp.LimbConditionals.fit(body, own, 60.0, least_std=0.02)
    n = len(body.skeleton.parts)
    tree = tp.message_tree(found.edges, n)
    mean, cov = (
        0.2 * normal(n, 3, seed=1).tanh(),
        0.01 * torch.eye(3, dtype=torch.float64).expand(n, 3, 3).contiguous(),
    )
    return record(
        out,
        body=body,
        states=own,
        conditionals=found,
        info=found.info,
        slower=found.at_rate(20.0),
        tree=tree,
        messages=tp.propagate(mean, cov, tree, found.transport),
    )


def exercises(count=8, action=0, frames=40, noise=2.0, seed=0):
    """Made-up performances of 36 angles."""
    shape, g, found = gen(1000 + action), gen(seed), []
    loadings = torch.randn(4, 36, generator=shape, dtype=torch.float64)
    rest = 10 * torch.randn(36, generator=shape, dtype=torch.float64)
    scale = torch.tensor([30.0, 15.0, 8.0, 4.0], dtype=torch.float64)
    for _ in range(count):
        length = frames + int(torch.randint(-frames // 4, frames // 4, (), generator=g))
        early = 0.25 * (torch.rand((), generator=g, dtype=torch.float64) - 0.5)
        t = torch.linspace(0, 1, length, dtype=torch.float64)
        phase = 2 * math.pi * (t + early * t * (1 - t))
        waves = torch.stack([1 - phase.cos(), phase.sin(), (2 * phase).sin(), (2 * phase).cos()], 1)
        style = 1 + 0.05 * torch.randn(4, generator=g, dtype=torch.float64)
        offset = noise * torch.randn(36, generator=g, dtype=torch.float64)
        shaken = 0.1 * noise * torch.randn(length, 36, generator=g, dtype=torch.float64)
        found.append(rest + offset + (waves * scale * style) @ loadings / 2 + shaken)
    return found


@capability("priors/actions")
def priors_actions(folder):
    out = {}
    space, together = tp.ActionSpace.fit_synchronised(exercises(), 5, name="a", fps=30.0)
    others = [
        tp.ActionSpace.fit(exercises(action=i, frames=30 + 6 * i), 4 + i, name=f"b{i}", fps=30.0)
        for i in (1, 2)
    ]
    bank = tp.ActionBank([space, *others], spread=1.3, background=1.5)
    postures = torch.cat([exercises(1, i, seed=9)[0][:12] for i in range(3)])
    z, j = space.project(postures), space.best_match(space.project(postures))
    record(
        out,
        space=space,
        synchronised=together,
        info=space.info,
        small=space.with_dimensions(2),
        z=z,
        best=j,
        back=space.reconstruct(z),
        match=space.match(z, gen(1)),
        log_match=space.log_match(z),
        inside=space.inside(z, j),
        clamp=space.clamp(z + 30, j),
        clamped=space.clamp_postures(postures + 20, j),
        acceptance=space.acceptance(postures, generator=gen(2)),
    )
    actions, uniform = torch.arange(36) % 4, torch.rand(36, generator=gen(3)).double()
    match = bank.match(postures, actions, uniform=uniform)
    record(
        out,
        bank=bank,
        names=bank.names,
        project=bank.project(postures),
        bank_match=match,
        bank_inside=bank.inside(postures, actions, match),
        bank_clamped=bank.clamp_postures(postures + 20, actions, match),
        log_likelihood=bank.log_likelihood(postures),
        transition=bank.transition(60.0),
        start=bank.start(),
        share=bank.evidence_share(60.0),
        recognised=bank.recognise(postures[None], 30.0),
    )
    space.save(folder / "s.safetensors")
    bank.save(folder / "b.safetensors")
    record(
        out,
        one=tp.ActionSpace.load(folder / "s.safetensors"),
        loaded=tp.ActionBank.load(folder / "b.safetensors"),
    )
    states = strides(8)
    angles = tp.state_postures(walker(), states)
    record(
        out,
        angles=angles,
        of_joints=tp.posture_angles(walker().joints(states)),
        root=tp.posture_root(walker().joints(states)),
        normal=tp.normalise_postures(angles + 400),
        to_state=tp.posture_to_state(walker(), angles, states),
        part=tp.PartPostures(walker(), torch.float64)(states),
        spline=tp.natural_spline(angles, torch.linspace(0, 7, 20).double()),
        repetitions=[
            [s.start, s.stop] for s in tp.split_repetitions(torch.cat(exercises(4)), 30.0)
        ],
    )
    return out


@capability("curation")
def curation(folder):
    out = {}
    Recording = get("Recording", has=("joints", "person"))

    def one(person, name, joints, **facts):
        return Recording(
            joints,
            UPPER,
            30.0,
            person,
            path=Path(f"/recordings/{person}/{name}.csv"),
            skeleton="upper-body-8",
            **facts,
        )

    people = [one(f"p{i}", "a", moving(150, seed=i, size=1 + 0.05 * i)) for i in range(3)]
    joints = moving(150, seed=7)
    joints[40, 0] += 0.4
    joints[60:63, 3] += torch.tensor([0.0, 0, 0.3]).double()
    joints[90] = joints[90, 4] + 0.01 * normal(8, 3, seed=1)
    bad = one("eve", "take", joints, first_frame=100)
    copy = one("p0", "b", people[0].joints[20:140].clone())
    for name, settings in {
        "default": {},
        "all": {"face_camera": "pose", "harmonise": True, "mirror": True},
        "turned": {"face_camera": "recording"},
        "lenient": {"jump_speeds": None, "bone_ratios": None},
    }.items():
        found = tp.curate([*people, bad, copy], tp.CurationSettings(**settings))
        record(
            out,
            **{
                f"{name}.joints": [r.joints for r in found.recordings],
                f"{name}.text": found.report.text(),
                f"{name}.facts": json.dumps(found.report.facts(), sort_keys=True),
                f"{name}.sizes": [found.report.before, found.report.after],
            },
        )
    bones = tp.person_bones(people)
    record(
        out,
        bones=list(bones.values()),
        lengths=tp.bone_lengths(joints),
        jumps=tp.find_jumps(joints, 30.0),
        wrong=tp.find_wrong_joints(joints, next(iter(bones.values()))),
        mirrored=tp.mirrored(bad).joints,
        faced=tp.face_camera(people[1]).joints,
        harmonised=[r.joints for r in tp.harmonise_bones(people)],
        duplicates=tp.find_duplicates([*people, copy]),
        persons=tp.persons_of(people),
        runs=[r.joints for r in tp.complete_runs(tp.curate([*people, bad]).recordings[-1])],
        splits=[[*s.persons] for s in tp.leave_one_person_out(people)],
    )
    return out


@capability("calibration")
def calibration(folder):
    out = {}
    estimate, truth = normal(40, 8, 3, seed=1), normal(40, 8, 3, seed=2)
    factor = normal(40, 8, 3, 3, seed=3)
    cov = factor @ factor.mT + 0.2 * torch.eye(3, dtype=torch.float64)
    mask = torch.rand(40, 8, generator=gen(4)) > 0.2
    curve = tp.reliability(estimate, cov, truth, mask=mask)
    record(
        out,
        coverage=tp.coverage(estimate, cov, truth, mask=mask),
        reliability=curve,
        error=tp.calibration_error(curve),
        mahalanobis=tp.mahalanobis_squared(estimate, cov, truth, mask),
        cdf=tp.chi2_cdf(torch.linspace(0, 20, 30).double()),
        quantile=tp.chi2_quantile(torch.linspace(0.01, 0.99, 30).double()),
        predictive=tp.predictive_log_likelihood(
            normal(40, 8, seed=5).log_softmax(-1), estimate, cov, truth[:, 0]
        ),
        fitted=tp.fit_calibration(estimate - truth, cov),
    )
    return out


@capability("metrics")
def metrics(folder):
    out = {}
    truth = moving(30)
    estimate = (
        truth @ tp.euler_to_matrix(torch.tensor([0.1, 0.2, -0.1]).double()).mT
        + 0.05 * normal(30, 8, 3, seed=2)
        + 0.1
    )
    mask = torch.rand(30, 8, generator=gen(3)) > 0.1
    cov = 0.01 * torch.eye(3).double().expand(30, 8, 3, 3)
    errors = tp.joint_errors_3d(estimate, truth, mask)
    record(
        out,
        errors=get("joint_errors", has=("estimate", "truth"))(estimate, truth, mask),
        aligned=errors,
        plain=tp.joint_errors_3d(estimate, truth, procrustes=False),
        flat=tp.joint_errors_2d(estimate[..., :2], truth[..., :2]),
        all=tp.joint_errors_3d(estimate, truth, joints=None),
        procrustes=tp.procrustes(estimate, truth, mask),
        align=tp.align(estimate, truth, covariance=cov),
        summary=tp.summarise_errors(errors),
        below=tp.share_below(errors, 0.08),
        pcp=tp.pcp(estimate, truth, mask=mask),
        jitter=tp.jitter(estimate, 30.0),
    )
    for name, metric, given in (
        ("mpje", tp.MeanPerJointError(procrustes=True, per_joint=True), (estimate, truth, mask)),
        ("pcp_metric", tp.PercentageOfCorrectParts(per_limb=True), (estimate, truth, mask)),
        ("ellipsoids", tp.EllipsoidCoverage(per_joint=True), (estimate, cov, truth, mask)),
    ):
        metric = metric.double()
        metric.set_dtype(torch.float64)
        metric.update(*given)
        metric.update(*(g[:7] for g in given))
        record(out, **{name: metric.compute()})
    return out


@capability("rotations")
def rotations(folder):
    out = {}
    angles = normal(9, 3, seed=1)
    for order in ("zxy", "zyx"):
        R = tp.euler_to_matrix(angles, order)
        record(out, **{f"{order}.matrix": R, f"{order}.back": tp.matrix_to_euler(R, order)})
    record(out, rotvec=tp.rotvec_to_matrix(angles))
    mean, factor = 0.3 * normal(4, 3, seed=2).tanh(), 0.1 * normal(4, 3, 3, seed=3)
    cov = factor @ factor.mT + 1e-4 * torch.eye(3, dtype=torch.float64)
    turn, centre, new = (0.4 * normal(4, 3, seed=s).tanh() for s in (4, 5, 6))
    vectors = 0.4 * normal(4, 20, 3, seed=7).tanh()
    record(
        out,
        safe=tp.safe_centre(vectors),
        edge=tp.angle_to_edge(vectors),
        fitted=tp.fit_gaussian(vectors, tp.safe_centre(vectors), normal(4, 20, seed=8)),
        rotated=tp.rotate_gaussian(turn, mean, cov, centre=centre, new_centre=new),
        right=tp.gaussian_rotate(mean, cov, turn, centre=centre, new_centre=new),
        turned=tp.turn_gaussian(mean, cov, left=turn, right=centre),
        sigma=tp.sigma_quaternions(mean, cov),
        moments=tp.quaternion_moments(tp.sigma_quaternions(mean, cov)),
        left_matrix=tp.left_matrix(tp.sigma_quaternions(mean, cov)[:, 0]),
        right_matrix=tp.right_matrix(tp.sigma_quaternions(mean, cov)[:, 0]),
    )
    for directions in ("eigen", "cholesky", "axes"):
        attempt(
            out,
            f"directions_{directions}",
            lambda d=directions: tp.rotate_gaussian(turn, mean, cov, directions=d),
        )

    def function(x):
        return torch.stack([x[..., 0] * x[..., 1], x[..., 2].sin()], -1)

    points = tp.sigma_points(mean, cov, centre=True)
    noise = 0.01 * torch.eye(2, dtype=torch.float64).expand(4, 2, 2)
    return record(
        out,
        points=points,
        point_moments=get("moments", has=("points",))(points[:, 1:]),
        transform=tp.unscented_transform(function, mean, cov),
        update=tp.unscented_update(function, mean, cov, normal(4, 2, seed=9), noise),
        floor=tp.floor_eigenvalues(cov, 0.005),
    )


@capability("cameras")
def cameras(folder):
    out = {}
    made = [
        tp.PinholeCamera(
            400.0 + 20 * i,
            410.0,
            321.0,
            238.5,
            640,
            480,
            name,
            skew=9.0 * i,
            rotation=(0.1 * i, -0.2, 0.3),
            translation=(0.1, 0.2 * i, 3.0),
            distortions=(-0.25, 0.08, 0.002, -0.001),
        )
        for i, name in enumerate(("left", "front", "right"))
    ]
    points = normal(4, 5, 3, seed=1)
    tp.save_cameras(made, folder / "c.toml")
    loaded = tp.load_cameras(folder / "c.toml")
    group = tp.CameraRig.load(folder / "c.toml")
    record(
        out,
        projected=[c(points) for c in made],
        toml=numbers_of(folder / "c.toml"),
        text=(folder / "c.toml").read_text(),
        loaded=list(loaded.values()),
        rig=group,
        view=group(points),
        small=group.scaled(120, 160),
        some=group.select([2, 0]),
        from_size=tp.PinholeCamera.from_image_size(640, 480),
        one=tp.PinholeCamera.load(folder / "c.toml", "front"),
    )
    image = rng(0).integers(0, 255, (3, 480, 640, 3)).astype(np.uint8)
    attempt(
        out,
        "undistorted",
        lambda: [np.asarray(i)[::16, ::16].copy() for i in group.undistort(list(image))],
    )
    Kt = torch.from_numpy(K)
    R, t = (
        tp.rotvec_to_matrix(normal(3, seed=2)),
        normal(3, seed=3) + torch.tensor([0, 0, 6.0]).double(),
    )
    uvl = tp.project(points, Kt, R, t)
    own = torch.tensor([[600.0, 2, 300], [0, 590, 250], [0, 0, 1]]).double()
    cov = torch.eye(2).double() + torch.tensor([[0, 0.2], [0.2, 0.5]]).double()
    record(
        out,
        uvl=uvl,
        back=tp.backproject(uvl, Kt),
        lifted=tp.lift(uvl, Kt, R, t),
        mapped=tp.map_pixels(uvl[..., :2], Kt, own),
        mapped_cov=tp.map_pixel_covariance(cov, Kt, own),
    )
    one = prior(PRIORS[1])
    parts = parameters(one.left)
    record(
        out,
        camera_frame=tp.arm_in_camera_frame(parts["means"], parts["covariances"], Kt),
        body_frame=tp.arm_in_body_frame(
            parts["means"], parts["covariances"], Kt, one.info.rotation_order
        ),
        lifted_covs=tp.pixel_covariances(parts["covariances"][None]),
    )
    joints = moving(20)
    record(
        out,
        mirrored=tp.mirror_pose(joints),
        scaled=tp.scale_bones(joints, torch.linspace(0.8, 1.2, 7).double()),
        upper=tp.to_upper_body(joints, UPPER),
        neck=str(tp.measure_neck_kind(joints)),
        torso=tp.in_torso_axes(joints),
        onto=tp.onto_torso(
            joints, 0.01 * torch.eye(3).double().expand(20, 8, 3, 3), moving(20, seed=3)
        ),
        rotation=tp.torso_rotation(joints[:, 2] - joints[:, 5]),
    )
    return out


@capability("demo performer")
def demo_performer(folder):
    out = {}
    shown = tp.performer(40, seed=3)
    record(
        out,
        performer=shown,
        keypoints=tp.noisy_keypoints(shown.joints, gap=None, seed=3),
        gap=tp.noisy_keypoints(tp.performer(120).joints),
        camera=tp.demo_camera(),
    )
    for name in get("PERFORMANCES", where=_has_clapping):
        record(out, **{name: tp.performance(name, n_frames=25).joints})
    record(out, pair=[p.joints for p in tp.crossing(20)])
    walk = get("walk", has=("cadence",))(0.5, 30.0)
    clip = tp.walk_clip(walk)
    around = tp.cameras_around(clip)
    return record(
        out,
        states=walk.states,
        walked=walk.joints,
        body=walk.body,
        cameras=around,
        hands=tp.hands_to_arms(moving(9)[:, [0, 7]] - moving(9)[:, 4:5]),
        truth=get("performance_truth")(shown, tp.demo_camera()),
    )


def _has_clapping(value):
    return "clapping" in value


# --- measurements from images ---------------------------------------------------------------------


@functools.cache
def rendered(n=22, distance=1.6):
    from itertools import islice

    shown = tp.performer(n, distance=distance)
    frames = tp.render_performance(
        shown, tp.demo_camera(), scene=tp.Scene(clutter=False, exposure=0.0)
    )
    return list(islice(frames, n))


@capability("measure/rendering")
def measure_rendering(folder):
    from itertools import islice

    out = {}
    both = list(
        islice(tp.render_performance(tp.crossing(4), tp.demo_camera(), scene=tp.Scene()), 4)
    )
    sleeves = (
        list(tp.render_performance(tp.performer(2), tp.demo_camera(), look="short sleeves"))
        if "short sleeves" in get("LOOKS")
        else []
    )
    return record(
        out,
        plain=np.stack(rendered()[::7])[:, ::2, ::2],
        crossing=np.stack(both[::3])[:, ::2, ::2],
        sleeves=sleeves and np.stack(sleeves)[:, ::2, ::2],
    )


@capability("measure/measurer")
def measure_measurer(folder):
    out, frames = {}, rendered()
    for name, options, n in (
        ("grid", {}, 20),
        ("mean-shift", {"hands": "mean-shift"}, 20),
        ("all", {"background": True, "elbows": True, "max_persons": 1}, 12),
    ):
        model = tp.UpperBodyMeasurer(prior(PRIORS[1]), 30.0, **options)
        state, found = model.init(), []
        for image in frames[:n]:
            state, measured = model.step(state, image)
            found.append(measured)
        record(out, **{name: found, f"{name}.faces": state.faces, f"{name}.persons": state.persons})
    return out


@capability("measure/video tracker")
def measure_video(folder):
    out, frames = {}, rendered()
    for name, options, n in (
        ("plain", {}, 20),
        ("smooth", {"smoothing": "full", "edges": True}, 20),
        ("paper", {"hands": "mean-shift", "method": "mkf-fixed"}, 20),
        ("candidates", {"candidates": True}, 18),
    ):
        model = tp.VideoTracker(prior(PRIORS[1]), tp.demo_camera(), **options)
        record(out, **{name: model(frames[:n])})
    model = tp.VideoTracker(prior(PRIORS[1]), tp.demo_camera())
    state, live = model.init(), []
    for image in frames[:10]:
        state, people = model.step(state, image)
        live.append([p.pose.joints3d for p in people])
    return record(out, live=live)


@capability("measure/colours")
def measure_colours(folder):
    out = {}
    skin, cloth, wall = (0.80, 0.60, 0.50), (0.15, 0.20, 0.45), (0.75, 0.75, 0.70)
    image = torch.empty(3, 120, 160)
    image[:] = torch.tensor(wall)[:, None, None]
    image[:, 70:, 50:110] = torch.tensor(cloth)[:, None, None]
    image[:, 22:60, 66:94] = torch.tensor(skin)[:, None, None]
    image[:, 80:96, 20:34] = torch.tensor(skin)[:, None, None]
    image = (image + 0.01 * torch.randn(image.shape, generator=gen(0))).clamp(0, 1)[None]
    face = torch.tensor([[80.0, 40.0, 32.0]])
    lab = tp.rgb_to_lab(image)
    record(
        out,
        lab=lab[:, :, ::4, ::4],
        kornia=tp.rgb_to_lab(image.clone().requires_grad_())[:, :, ::4, ::4],
    )
    import cv2

    drawn = np.zeros((130, 160), np.uint8)
    cv2.rectangle(drawn, (62, 48), (98, 130), 255, -1)
    for shoulder, elbow, hand in (((96, 54), (114, 90), (86, 92)), ((64, 54), (46, 90), (74, 92))):
        cv2.line(drawn, shoulder, elbow, 255, 9)
        cv2.line(drawn, elbow, hand, 255, 9)
    outline = torch.from_numpy(drawn > 0)[None].float()
    model = tp.SkinModel()
    state = model.init(1)
    for i in range(3):
        state, found = model.step(state, lab + i, face)
    record(
        out,
        skin=state,
        found=found,
        ratio=model.log_ratio(state),
        clothes=tp.clothes_likelihood(model, state, model.bins(lab)),
        elbows=tp.elbows_from_torso(outline, torch.tensor([[80.0, 24.0, 20.0]])),
    )
    for dtype in (torch.float32, torch.float64):
        mixed = tp.SkinMixtureModel().to(dtype)
        state = mixed.init(1)
        for _ in range(3):
            state, found = mixed.step(state, lab.to(dtype), face.to(dtype))
        record(out, **{f"mixture.{dtype}": state, f"mixture.{dtype}.found": found})
    frames = (120 + 40 * torch.rand(20, 3, 24, 32, generator=gen(1))).round().to(torch.uint8)
    background = tp.BrightnessBackground().fit(frames[:15])
    record(
        out,
        background=background,
        kinds=background(frames[15:]),
        distortion=background.distortion(frames[15:]),
    )
    r = rng(0)
    scene = r.integers(90, 220, (120, 160, 3)).astype(np.uint8)
    plain, masks = tp.BackgroundModel(), []
    for t in range(40):
        shot = np.clip(scene + r.normal(0, 2, scene.shape), 0, 255).astype(np.uint8)
        if t > 32:
            shot[60:90, 10 * (t - 32) : 10 * (t - 32) + 20] = (250, 50, 30)
        masks.append(plain.step(shot, face))
    record(out, mog=np.stack(masks[-8:]), region=tp.person_region(face, 120, 160))
    return record(
        out, colours=tp.clothes_colours((255 * image[0].permute(1, 2, 0)).byte().numpy(), face)
    )


@capability("measure/edges")
def measure_edges(folder):
    import cv2

    out = {}
    places = {
        "hand_left": (200, 150),
        "elbow_left": (230, 110),
        "shoulder_left": (190, 70),
        "head": (160, 30),
        "neck": (160, 55),
        "shoulder_right": (130, 70),
        "elbow_right": (90, 110),
        "hand_right": (70, 150),
    }
    image = np.full((200, 320), 150.0)
    for side in ("left", "right"):
        for a, b in (("shoulder", "elbow"), ("elbow", "hand")):
            cv2.line(image, places[f"{a}_{side}"], places[f"{b}_{side}"], 60.0, 14)
    image = (
        (cv2.GaussianBlur(image, (3, 3), 0.8) + rng(0).normal(0, 3, image.shape))
        .clip(0, 255)
        .astype(np.uint8)
    )
    pose = torch.tensor([places[n] for n in UPPER]).float()
    other = pose.clone()
    other[[0, 7]] = pose[[7, 0]]
    for backend in ("opencv", "kornia"):
        given = image if backend == "opencv" else torch.from_numpy(image).float()
        record(
            out,
            **{
                f"{backend}.edges": tp.edge_map(given, backend=backend),
                f"{backend}.segments": tp.find_segments(image, backend),
            },
        )
    found = tp.find_segments(image)
    record(
        out,
        votes=tp.limb_votes(found, pose[[2, 5]], pose[[1, 6]], 16.0),
        arms=tp.segments_of_arms(image, torch.stack([pose, other])[None], 40.0),
    )
    model = tp.HandAssociation()
    state = model.init()
    both = torch.stack([torch.stack([pose, other]), torch.stack([other, pose])])
    for _ in range(3):
        state = model.step(state, image, both, torch.tensor([40.0, 40.0]), torch.tensor([4, 9]))
    hands = tp.HandPrior.from_prior(prior(PRIORS[1]))
    faces = torch.tensor([[160.0, 30.0, 40.0]])
    record(
        out,
        state=state,
        hand_prior=hands.table[:, :, ::5, ::5],
        offsets=hands(torch.randn(9, 2, generator=gen(1))),
    )
    maps = torch.rand(3, 60, 80, generator=gen(2)).double() ** 4
    for kernel in ("box", "gaussian"):
        attempt(
            out,
            f"mean_shift_{kernel}",
            lambda k=kernel: tp.mean_shift(
                maps, 30 + 5 * normal(3, 2, seed=3), torch.full((3, 2), 21.0).double(), k
            ),
        )
    record(
        out,
        head_neck=tp.HeadNeck()(faces, 0.1 * torch.eye(3)[None]),
        blur=get("blur", has=("maps", "sigma"))(maps.float(), 1.5),
        bump=tp.gaussian_bump(torch.tensor([[20.0, 10]]), 9 * torch.eye(2)[None], (30, 40)),
    )
    return out


@capability("measure/hands and faces")
def measure_hands(folder):
    import cv2

    out = {}

    def draw(hands, seed):
        shown = np.full((240, 320, 3), (190, 190, 180), np.uint8)
        cv2.rectangle(shown, (120, 104), (200, 240), (40, 50, 110), -1)
        cv2.ellipse(shown, (160, 60), (20, 28), 0, 0, 360, (205, 155, 130), -1)
        for hand in hands:
            cv2.circle(shown, tuple(round(float(c)) for c in hand), 12, (205, 155, 130), -1)
        return (shown + rng(seed).normal(0, 3, shown.shape)).clip(0, 255).astype(np.uint8)

    t = np.arange(12)
    left = np.stack([240 + 30 * np.cos(t / 6), 150 + 30 * np.sin(t / 6)], 1)
    right = np.stack([80 + 1.0 * t, 200 - 3.0 * t], 1)
    frames = [draw(pair, i) for i, pair in enumerate(zip(left, right, strict=True))]
    faces, identity = torch.tensor([[160.0, 60.0, 40.0]]), torch.tensor([0])
    hand_prior = tp.HandPrior.from_prior(prior(PRIORS[1]))
    for name, model in {
        "back": tp.MeanShiftHandTracker(),
        "ratio": tp.MeanShiftHandTracker("ratio"),
        "prior": tp.MeanShiftHandTracker(prior=hand_prior),
        "grid": tp.HandTracker(hand_prior),
        "slow": tp.HandTracker(hand_prior, fps=15.0),
    }.items():
        state, found = model.init(), []
        for frame in frames:
            state, hands = model.step(state, frame, faces, identity)
            found.append(hands)
        record(out, **{name: found})
    moving_faces = np.array([[200 + 3 * i, 150 - i, 80] for i in range(12)]) + rng(0).normal(
        0, 2, (12, 3)
    )

    def detector(image, region=None):
        return torch.from_numpy(moving_faces[int(image[0, 0])][None])

    tracker_ = tp.FaceTracker(detector)
    state, states = tracker_.init(), []
    for i in range(12):
        shown = np.zeros((480, 640), np.uint8)
        shown[0, 0] = i
        state = tracker_.step(state, shown)
        states.append(state)
    record(
        out,
        faces=states,
        haar=tp.HaarFaceDetector()(cv2.cvtColor(rendered()[0], cv2.COLOR_RGB2GRAY)),
    )
    register, people, numbers = tp.PersonRegister(within=100), None, []
    people = register.init()
    for when, frame in enumerate(frames[:4]):
        people, owner = register.step(people, frame, faces, identity + when // 2, when)
        numbers.append(owner)
    return record(out, owners=numbers, colours=people.colours)


@capability("measure/silhouettes")
def measure_silhouettes(folder):
    import cv2

    out = {}
    small = rng(0).integers(90, 200, (12, 16, 3)).astype(np.uint8)
    scene = cv2.resize(small, (320, 240), interpolation=cv2.INTER_LINEAR)
    shots = []
    for x in (120, 160, 200):
        shot = scene.copy()
        cv2.ellipse(shot, (x, 130), (22, 60), 0, 0, 360, (210, 30, 160), -1)
        shots.append(shot)
    camera = tp.PinholeCamera(300, 300, 159.5, 119.5, 320, 240, "a")
    view = tp.fit_view(camera, (320, 240), 120, 160)
    noisy = [
        np.clip(scene + rng(i).normal(0, 2, scene.shape), 0, 255).astype(np.uint8) for i in range(5)
    ]
    measurer = tp.SilhouetteMeasurer(view, empty=noisy)
    record(
        out,
        masks=np.stack([measurer(s) for s in shots]),
        view=view,
        padded=tp.fit_view(camera, (320, 240), 100, 200),
        cleaned=tp.clean_silhouette(np.random.default_rng(1).random((60, 80)) > 0.4),
    )
    return out


# --- files ----------------------------------------------------------------------------------------

_CENTRAL = {
    "head": (0, -0.28),
    "neck": (0, -0.1),
    "shoulder_center": (0, -0.1),
    "nose": (0, -0.26),
    "spine_shoulder": (0, 0.0),
    "spine": (0, 0.3),
    "spine_chest": (0, 0.15),
    "spine_navel": (0, 0.3),
    "hip_center": (0, 0.5),
}
_SIDED = {
    "clavicle": (0.08, -0.02),
    "shoulder": (0.18, 0.0),
    "elbow": (0.26, 0.26),
    "wrist": (0.3, 0.48),
    "hand": (0.31, 0.55),
    "hand_tip": (0.31, 0.62),
    "thumb": (0.28, 0.57),
    "hip": (0.09, 0.5),
    "knee": (0.1, 0.9),
    "ankle": (0.1, 1.3),
    "foot": (0.11, 1.35),
    "eye": (0.03, -0.3),
    "ear": (0.07, -0.28),
}


def somebody(names, n_frames=6, place=(0.1, -0.2, 2.0), seed=0):
    """Joints [T, J, 3] in camera axes."""
    rest = []
    for name in tp.canonical_names(names):
        part, _, side = name.rpartition("_")
        if side in ("left", "right"):
            x, y = _SIDED[part]
            rest.append((x if side == "left" else -x, y, 0.01))
        else:
            rest.append((*_CENTRAL[name], 0.01))
    return np.array(rest) + np.array(place) + 0.01 * rng(seed).normal(size=(n_frames, len(rest), 3))


def rows_of(joints, mark=",", first=None):
    return (
        "\n".join(
            mark.join(
                [*([f"{first[t]:g}"] if first is not None else []), *(f"{v:.7g}" for v in row)]
            )
            for t, row in enumerate(joints.reshape(len(joints), -1))
        )
        + "\n"
    )


def ntu_text(joints):
    lines = [str(len(joints))]
    for row in joints:
        lines += ["1", "72057594037931101 0 1 1 1 1 0 -0.0049 -0.02 2", "25"]
        lines += [
            f"{x:.7f} {y:.7f} {z:.7f} 250.1 200.2 900.3 500.4 0.1 0.2 0.3 0.4 {2 if j else 1}"
            for j, (x, y, z) in enumerate(row)
        ]
    return "\n".join(lines) + "\n"


def azure_text(joints, names):
    frames = [
        {
            "frame_id": t,
            "timestamp_usec": 1000 + 33333 * t,
            "num_bodies": 1,
            "bodies": [
                {
                    "body_id": 1,
                    "joint_positions": (1000 * row).tolist(),
                    "joint_orientations": [[1.0, 0, 0, 0]] * len(names),
                }
            ],
        }
        for t, row in enumerate(joints)
    ]
    return json.dumps({"joint_names": list(names), "bone_list": [], "frames": frames})


def table_text(joints, names):
    lines = [
        "# fps = 25",
        "# person = eve",
        "# axes = camera",
        ",".join(["frame", *(f"{n}_{a}" for n in names for a in "xyz")]),
    ]
    return (
        "\n".join(
            [
                *lines,
                *(
                    ",".join([str(t), *(f"{v:.7g}" for v in row.ravel())])
                    for t, row in enumerate(joints)
                ),
            ]
        )
        + "\n"
    )


BVH = """HIERARCHY
ROOT Hips
{
OFFSET 0 0 0
CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
JOINT Spine
{
OFFSET 0 20 0
CHANNELS 3 Zrotation Xrotation Yrotation
JOINT Neck
{
OFFSET 0 30 0
CHANNELS 3 Zrotation Xrotation Yrotation
JOINT Head
{
OFFSET 0 10 0
CHANNELS 3 Zrotation Xrotation Yrotation
End Site
{
OFFSET 0 20 0
}
}
}
%s}
}
"""
ARM = (
    "".join(
        f"JOINT %(side)s{name}\n{{\nOFFSET {offset} 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
        for name, offset in (
            ("Shoulder", "%(x)s 10"),
            ("Arm", "%(sign)s15 0"),
            ("ForeArm", "%(sign)s28 0"),
            ("Hand", "%(sign)s25 0"),
        )
    )
    + "End Site\n{\nOFFSET %(sign)s8 0 0\n}\n"
    + "}\n" * 4
)


def bvh_text(n=5):
    arms = "".join(
        ARM % {"side": s, "sign": m, "x": f"{m}3"} for s, m in (("Left", ""), ("Right", "-"))
    )
    r = rng(0)
    frames = np.concatenate(
        [[0, 95, 0] + 5 * r.normal(size=(n, 3)), r.uniform(-30, 30, (n, 36))], 1
    )
    rows = "\n".join(" ".join(f"{v:g}" for v in row) for row in frames)
    return f"{BVH % arms}MOTION\nFrames: {n}\nFrame Time: 0.025\n{rows}\n"


@capability("io/recordings")
def io_recordings(folder):
    out, sets = {}, get("SKELETONS")
    v1, v2, azure = (sets[n].joints for n in ("kinect-v1-20", "kinect-v2-25", "azure-32"))
    kinect = np.array([-1, -1, 1])
    path = folder / "alice"
    path.mkdir()
    texts = {
        "v1.csv": rows_of(somebody(v1) * kinect),
        "v1.txt": rows_of(somebody(v1, seed=1) * kinect, " ", range(5, 11)),
        "v2.csv": rows_of(somebody(v2) * kinect, ",", [10_000_000 + 333_333 * i for i in range(6)]),
        "S001C002P013R001A023.skeleton": ntu_text(somebody(v2) * kinect),
        "azure.json": azure_text(somebody(azure), azure),
        "table.csv": table_text(somebody(UPPER), UPPER),
        "a.bvh": bvh_text(),
    }
    lines = ["6 20"]
    for row in somebody(v1, seed=2) * kinect:
        lines += [
            "40",
            *(
                line
                for x, y, z in row
                for line in (f"{x:.7f} {y:.7f} {z:.7f} 1", "0.5123 0.4321 1234 1")
            ),
        ]
    texts["a01_s01_e01_skeleton.txt"] = "\n".join(lines) + "\n"
    eight = somebody(UPPER, 8)
    values = ", ".join(f"{v:.6f}" for v in eight.reshape(8, -1).ravel())
    texts["kinect.yaml"] = (
        f"%YAML:1.0\n---\nKinect: !!opencv-matrix\n   rows: 8\n   cols: 24\n   dt: f\n   data: [ {values} ]\n"
    )
    for name, text in texts.items():
        (path / name).write_text(text)
    np.savez(
        path / "a.npz",
        joints=somebody(UPPER),
        names=np.array(UPPER),
        fps=30.0,
        subject="p1",
        axes="camera",
        action="wave",
    )
    np.savez(
        path / "mm.npz",
        joints=1000 * somebody(UPPER),
        names=np.array(UPPER),
        fps=30.0,
        subject="p2",
        axes="camera",
    )
    labels = ("LShoulder", "RShoulder", "LElbow", "RElbow", "LWrist", "RWrist", "Head", "Neck")
    try:
        write_c3d(
            path / "a.c3d",
            1000 * somebody(labels, place=(0, 0, 0))[..., [0, 2, 1]] * [1, 1, -1],
            labels,
        )
    except ImportError:
        out["c3d"] = "no c3d"
    for file in sorted(path.iterdir()):
        attempt(
            out,
            file.name,
            lambda f=file: [
                {k: v for k, v in vars(r).items() if k != "path"} for r in tp.read_recording(f)
            ],
        )
    attempt(out, "all", lambda: [r.joints for r in tp.read_recordings(folder)])
    record(out, files=[p.name for p in tp.find_recordings(folder)])
    return out


def write_c3d(path, joints, labels):
    import c3d

    writer = c3d.Writer(point_rate=100.0, point_units="mm  ")
    writer.set_point_labels([f"S01:{name}" for name in labels])
    writer.set_screen_axis("+X", "+Z")
    for t, frame in enumerate(joints):
        points = np.zeros((len(labels), 5), np.float32)
        points[:, :3] = frame
        points[4, 3] = -1 if t == 2 else 0
        writer.add_frames([(points, np.empty((0, 0)))])
    with path.open("wb") as stream:
        writer.write(stream)


@capability("io/mocap")
def io_mocap(folder):
    out, states = {}, strides(40)
    for i, up in enumerate(("y-up", "z-up")):
        joints = walker().joints(strides(40, seed=i)).numpy()
        joints = (
            joints
            if up == "y-up"
            else np.stack([joints[..., 0], -joints[..., 2], joints[..., 1]], -1)
        )
        np.savez(
            folder / f"w{i}.npz",
            joints=joints,
            names=np.array(get("BODY_15").names),
            fps=120.0 if i else 60.0,
            subject=f"s{i}",
            action="walk",
            source="example/x",
            axes=up,
        )
    found = tp.read_mocap(folder)
    record(
        out,
        clips=found,
        cut=found[0].cut(3, 9).joints,
        persons=sorted(tp.select_persons(found, ["s0"])),
        resampled=get("resample", has=("points", "target"))(states, 60.0, 25.0),
    )
    (folder / "C1.cal").write_text(
        "\r\n".join(
            f"{v:.8f}"
            for v in [700, 710, 320, 240, 0, 0.1, -0.2, 0, 0, 0, *np.eye(3).ravel(), 100, 200, 3000]
        )
    )
    (folder / "a.ofs").write_text("3\n1\n2\n")
    attempt(out, "calibration", lambda: tp.read_calibration(folder / "C1.cal"))
    attempt(out, "offset", lambda: tp.read_stream_offset(folder / "a.ofs"))
    return out


@capability("io/keypoints")
def io_keypoints(folder):
    out = {}
    uv = clips(1)[0][:, [3, 4, 0, 7]].numpy()
    uv[3, 2] = np.nan
    names = ("head", "neck", "lhand", "RWrist")
    np.savez(
        folder / "a.npz",
        keypoints=uv,
        names=np.array(names),
        confidence=rng(0).random((12, 4)),
        fps=25.0,
        K=K,
        image_size=[640, 480],
    )
    np.savez(folder / "b.npz", joints2d=uv, visibility=np.ones((12, 4)), names=np.array(names))
    head = ",".join(
        ["frame", *(f"{n}_{a}" for n in ("head", "neck", "hand_left", "hand_right") for a in "xy")]
    )
    rows = [
        ",".join([str(t), *("" if np.isnan(v) else f"{v:.4f}" for v in row.ravel())])
        for t, row in enumerate(uv)
    ]
    (folder / "c.csv").write_text(
        "\n".join(["# fps = 30", "# image_size = 640,480", head, *rows]) + "\n"
    )
    (folder / "d.csv").write_text(
        "frame,name,x,y,confidence\n"
        + "".join(
            f"{t},{n},{uv[t, i, 0]:.3f},{uv[t, i, 1]:.3f},0.9\n"
            for t in range(12)
            for i, n in enumerate(names)
            if uv[t, i, 0] > 0
        )
    )
    pose = folder / "openpose"
    pose.mkdir()
    for t in range(4):
        people = [
            {"pose_keypoints_2d": rng(10 * t + p).uniform(0.2, 600, 75).round(3).tolist()}
            for p in range(2)
        ]
        for one in people:
            one["pose_keypoints_2d"][2::3] = [0.9 - 0.01 * t] * 25
        (pose / f"v_{t:012d}_keypoints.json").write_text(
            json.dumps({"version": 1.3, "people": people})
        )
    mediapipe = (
        "nose",
        "left_eye_inner",
        "left_eye",
        "left_eye_outer",
        "right_eye_inner",
        "right_eye",
        "right_eye_outer",
        "left_ear",
        "right_ear",
        "mouth_left",
        "mouth_right",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
        "right_elbow",
        "left_wrist",
        "right_wrist",
        "left_pinky",
        "right_pinky",
        "left_index",
        "right_index",
        "left_thumb",
        "right_thumb",
    )
    np.savez(
        folder / "e.npz",
        keypoints=rng(3).uniform(100, 500, (4, len(mediapipe), 2)),
        names=np.array(mediapipe),
    )
    for path in (*sorted(folder.glob("?.*")), pose):
        attempt(
            out,
            path.name,
            lambda p=path: {k: v for k, v in vars(tp.read_keypoints(p)).items() if k != "path"},
        )
    found = tp.read_keypoints(folder / "a.npz")
    tp.write_keypoints(folder / "w.npz", found)
    tp.write_keypoints(folder / "w.csv", found)
    record(
        out,
        written=load_npz(folder / "w.npz"),
        csv=numbers_of(folder / "w.csv"),
        text=(folder / "w.csv").read_text(),
        names=tp.canonical_names(names),
        measured=found.measured,
    )
    return out


@capability("io/video")
def io_video(folder):
    out, frames = {}, rendered(4)
    with tp.VideoWriter(folder / "a.mp4", 30.0, (640, 480)) as writer:
        for image in frames:
            writer.write(image)
    with tp.open_video(folder / "a.mp4") as video:
        shown = [f for f in video]
        record(
            out,
            size=list(video.size),
            fps=video.fps,
            frames=np.stack([f.image if hasattr(f, "image") else f[0] for f in shown])[:, ::8, ::8],
            times=[float(f.time) if hasattr(f, "time") else float(f[1]) for f in shown],
        )
    import cv2

    images = folder / "images"
    images.mkdir()
    for i, image in enumerate(frames):
        cv2.imwrite(str(images / f"f{i}.png"), image[..., ::-1])
    with tp.open_video(images, fps=25.0) as video:
        record(out, folder=np.stack([f[0] for f in video])[:, ::8, ::8])
    track = tracker(PRIORS[1], "window-mixture")(clips(1))
    overlay = tp.draw_overlay(
        frames[0], track.joints2d[:, 0], track.covariance2d[:, 0], track.observed[:, 0]
    )
    return record(out, overlay=np.asarray(overlay)[::2, ::2])


# --- the command line -----------------------------------------------------------------------------


def torchpose(folder, *arguments, code=0):
    """Run the command in a folder; returns what it printed."""
    import importlib.util

    home = Path(importlib.util.find_spec("torchpose").origin).parents[1]
    environment = os.environ | {
        "PYTHONPATH": str(home),
        "COLUMNS": "200",
        "NO_COLOR": "1",
        "PYTHONWARNINGS": "ignore",
    }
    done = subprocess.run(
        [sys.executable, "-m", "torchpose", *map(str, arguments)],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    if done.returncode != code:
        raise RuntimeError(
            f"torchpose {arguments[0]} gave {done.returncode}: {done.stdout[-600:]} {done.stderr[-1500:]}"
        )
    return done.stdout


def written(out, name, folder):
    """Arrays of .npz and .safetensors, numbers of .csv and .bvh, and the list of files."""
    folder = Path(folder)
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    out[f"{name}.files"] = "\n".join(str(p.relative_to(folder)) for p in paths)
    for path in paths:
        key = f"{name}.{path.relative_to(folder)}"
        if path.suffix == ".npz":
            record(out, **{key: load_npz(path)})
        elif path.suffix == ".safetensors":
            from safetensors.torch import load_file

            record(out, **{key: load_file(path)})
        elif path.suffix in (".csv", ".bvh", ".toml"):
            record(out, **{key: numbers_of(path)})
    return out


def masked(text):
    """Printed text without times, paths and versions."""
    return re.sub(r"\d+(\.\d+)?\s?(ms|s|seconds?|fps|frames a second)\b", "#", text)


@capability("cli/help")
def cli_help(folder):
    out = {}
    for name in ("track", "track-body", "evaluate"):
        text = torchpose(folder, name, "--help")
        out[f"{name}.text"] = text
        out[f"{name}.options.files"] = "\n".join(
            sorted(set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", text)))
        )
        if name == "evaluate":
            out["protocols.files"] = "\n".join(
                sorted(set(re.findall(r"^\s*torchpose evaluate (\S+)", text, re.MULTILINE)))
            )
    return out


@capability("cli/demo keypoints")
def cli_demo(folder):
    out = {}
    out["text"] = masked(
        torchpose(
            folder,
            "demo",
            "--input",
            "keypoints",
            "--seconds",
            3,
            "--out",
            "out",
            "--pictures",
            "false",
        )
    )
    return written(out, "demo", folder / "out")


def clip_file(path):
    uv = clips(1, 40)[0][:, [3, 0, 7]].numpy()
    uv[20:25, 2] = np.nan
    np.savez(path, keypoints=uv, names=np.array(HANDS), fps=30.0, K=K, image_size=[640, 480])


@capability("cli/track")
def cli_track(folder):
    out = {}
    clip_file(folder / "k.npz")
    common = ("track", "k.npz", "--prior", PRIORS[1], "--pictures", "false")
    out["text"] = masked(torchpose(folder, *common, "--out", "a"))
    torchpose(
        folder,
        *common,
        "--out",
        "b",
        "--method",
        "pf-walk",
        "--n-particles",
        100,
        "--frame",
        "body",
        "--seed",
        3,
    )
    torchpose(
        folder,
        *common,
        "--out",
        "c",
        "--method",
        "mkf-fixed",
        "--smoothing",
        "full",
        "--camera",
        "600,600,320,240",
    )
    for name in "abc":
        written(out, name, folder / name)
    info = (
        torchpose(folder, "info", "k.npz"),
        torchpose(folder, "info", "a/poses.npz"),
        torchpose(folder, "info", PRIORS[1]),
    )
    return record(out, info_text=[masked(t) for t in info])


@capability("cli/track video")
def cli_track_video(folder):
    out = {}
    with tp.VideoWriter(folder / "a.mp4", 30.0, (640, 480)) as writer:
        for image in rendered():
            writer.write(image)
    out["text"] = masked(
        torchpose(
            folder,
            "track",
            "a.mp4",
            "--prior",
            PRIORS[1],
            "--overlay",
            "false",
            "--pictures",
            "false",
            "--out",
            "out",
        )
    )
    return written(out, "video", folder / "out")


@capability("cli/track-body")
def cli_track_body(folder):
    out = {}
    walk = get("walk", has=("cadence",))(0.3, 30.0, 1.8, 0)
    around = tp.cameras_around(tp.walk_clip(walk))
    videos, scenes = tp.render_body_video(folder, walk, around, 0)
    tp.save_cameras(around, folder / "cameras.toml")
    common = (
        "track-body",
        "cameras.toml",
        *(p.name for p in videos),
        "--background",
        *(p.name for p in scenes),
        "--height",
        1.8,
        "--rows",
        60,
        "--overlay",
        "false",
        "--pictures",
        "false",
    )
    out["text"] = masked(
        torchpose(folder, *common, "--manifold", "walk", "--n-particles", 60, "--out", "a")
    )
    start = ("--initial-pose", "a/body.npz")
    torchpose(folder, *common, *start, "--conditionals", "walk", "--n-particles", 147, "--out", "b")
    torchpose(folder, *common, *start, "--action", "exercises", "--n-particles", 60, "--out", "c")
    torchpose(folder, *common, *start, "--method", "apf", "--n-particles", 60, "--out", "d")
    for name in "abcd":
        written(out, name, folder / name)
    return out


def body_recordings(folder):
    """Three persons who walk, and two things that they do."""
    walks, acts = folder / "walks", folder / "acts"
    walks.mkdir()
    acts.mkdir()
    for person in range(3):
        body = tp.Body.of_height(get("BODY_15"), 1.6 + 0.1 * person)
        names = np.array(get("BODY_15").names)
        for trial in range(3):
            state = torch.zeros(80, body.dim, dtype=torch.float64)
            state[:, 1] = 0.9
            states = body.with_relative(
                state, 0.4 * cyclic(80, float(trial), 10 * person + trial, 0.5)
            )
            np.savez(
                walks / f"p{person}_{trial}.npz",
                joints=body.joints(states).numpy(),
                fps=120.0,
                action="walk",
                names=names,
                subject=f"p{person}",
                source="set",
                axes="y-up",
            )
        at_rest = torch.zeros(body.dim, dtype=torch.float64)
        rest = tp.posture_angles(body.joints(at_rest))
        for action in range(2):
            parts = exercises(3, action, 30, noise=1.0, seed=person)
            angles = rest + 0.4 * (torch.cat(parts) - parts[0].mean(0))
            states = tp.posture_to_state(body, angles.clamp(-80, 80), at_rest)
            states[:, 1] += 0.9
            np.savez(
                acts / f"p{person}_{action}.npz",
                joints=body.joints(states).numpy(),
                fps=30.0,
                action=f"action{action}",
                names=names,
                subject=f"p{person}",
                source="set",
                axes="y-up",
            )


@capability("cli/fit")
def cli_fit(folder):
    out = {}
    (folder / "recordings").mkdir()
    for i in range(2):
        np.savez(
            folder / "recordings" / f"p{i}.npz",
            joints=moving(150, seed=i).numpy(),
            names=np.array(UPPER),
            fps=30.0,
            subject=f"p{i}",
            axes="camera",
        )
    (folder / "out").mkdir()
    out["text"] = masked(
        torchpose(
            folder,
            "fit",
            "recordings",
            "--out",
            "out/a.safetensors",
            "--components",
            2,
            "--samples",
            500,
            "--window-components",
            2,
            "--drawn-pieces",
            0,
            "--folds",
            0,
            "--pictures",
            "false",
        )
    )
    torchpose(
        folder,
        "fit",
        "recordings",
        "--out",
        "out/b.safetensors",
        "--components",
        2,
        "--samples",
        500,
        "--noise",
        "none",
        "--pictures",
        "false",
        "--curate",
        "false",
        "--harmonise",
        "true",
    )
    written(out, "fit", folder / "out")
    record(out, card_text=(folder / "out" / "a.md").read_text())
    return out


@capability("cli/fit bodies")
def cli_fit_bodies(folder):
    out = {}
    body_recordings(folder)
    (folder / "out").mkdir()
    for kind, where, more in (
        (
            "manifold",
            "walks",
            ("--frames", 60, "--steps", 3, "--start", 1, "--validation", 1, "--pictures", "false"),
        ),
        ("limbs", "walks", ("--least-std", 0.02, "--held-out", "p2")),
        (
            "actions",
            "acts",
            (
                "--actions",
                "action1",
                "action0",
                "--n-dimensions",
                5,
                "--gate-dimensions",
                3,
                "--held-out",
                "p2",
                "--pictures",
                "false",
            ),
        ),
    ):
        text = torchpose(folder, "fit", kind, where, "--out", f"out/{kind}.safetensors", *more)
        out[f"{kind}.text"] = masked(text)
    written(out, "bodies", folder / "out")
    out["info_text"] = masked(torchpose(folder, "info", "out/manifold.safetensors"))
    return out


# --- the command line of this script --------------------------------------------------------------


def processor_time():
    return sum(os.times()[:4])


def chosen_by(name, only):
    return not only or any(
        fnmatch.fnmatch(name, pattern) or name.startswith(pattern) for pattern in only
    )


def write(path, only):
    names = [n for n in CAPABILITIES if chosen_by(n, only)]
    if not names:
        raise SystemExit(f"no capability like {only}; see: golden.py list")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import torchpose
    home = Path(torchpose.__file__).resolve().parent
    wanted = [Path(p).resolve() for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
    if home.parent not in wanted:
        raise SystemExit(
            f"torchpose is imported from {home}, not from PYTHONPATH; set it to the repository"
        )
    print(f"torchpose of {home}", flush=True)
    results, failed, started, spent = {}, {}, time.perf_counter(), processor_time()
    for name in names:
        begun = processor_time()
        torch.manual_seed(0)
        np.random.seed(0)
        random.seed(0)
        torch.set_default_dtype(torch.float32)
        printed = io.StringIO()
        try:
            with (
                tempfile.TemporaryDirectory(prefix="golden-") as folder,
                warnings.catch_warnings(),
                contextlib.redirect_stdout(printed),
                contextlib.redirect_stderr(printed),
            ):
                warnings.simplefilter("ignore")
                found = CAPABILITIES[name](Path(folder))
                flat = {}
                record(flat, **{"": found})
                results[name] = {key.removeprefix("."): value for key, value in flat.items()}
        except (Exception, SystemExit) as error:
            failed[name] = "".join(traceback.format_exception(error))
        seconds = processor_time() - begun
        said = (
            f"FAILED {failed[name].strip().splitlines()[-1]}"
            if name in failed
            else f"{len(results[name])} arrays"
        )
        print(f"{seconds:6.1f} s  {name}: {said}", flush=True)
    torch.save({"results": results, "failed": failed, "names": names}, path)
    print(
        f"{processor_time() - spent:.0f} s of processor time in {time.perf_counter() - started:.0f} s, "
        f"{len(results)} capabilities, {len(failed)} failed, "
        f"{sum(map(len, results.values()))} entries -> {path}"
    )
    for name, text in failed.items():
        print(f"\n--- {name}\n{text}")
    return 1 if failed else 0


def differences(a, b):
    """Largest absolute and relative difference, whether bitwise equal, or what does not fit."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return None, None, False, f"{tuple(a.shape)} {a.dtype} became {tuple(b.shape)} {b.dtype}"
    if a.numel() == 0:
        return 0.0, 0.0, True, ""
    same = a.is_complex() is b.is_complex() and bool(
        torch.equal(
            a.contiguous().view(-1).view(torch.uint8), b.contiguous().view(-1).view(torch.uint8)
        )
    )
    x, y = (v.double().reshape(-1) for v in (a, b))
    finite = x.isfinite() & y.isfinite()
    odd = ~finite
    if bool((~((x == y) | (x.isnan() & y.isnan())))[odd].any()):
        return None, None, False, "NaN or infinity in other places"
    x, y = x[finite], y[finite]
    if x.numel() == 0:
        return 0.0, 0.0, same, ""
    gap = (x - y).abs()
    scale = torch.maximum(x.abs(), y.abs()).clamp_min(1e-300)
    return float(gap.max()), float((gap / scale).max()), same, ""


def compare(path_a, path_b, tolerance, strict_text, only=()):
    one, two = (torch.load(p, weights_only=True) for p in (path_a, path_b))
    rows, bad = [], 0
    for name in filter(lambda n: chosen_by(n, only), one["names"]):
        if name not in two["names"]:
            rows.append((name, "", "", "", "not run in the second"))
            bad += 1
            continue
        if name in one["failed"] or name in two["failed"]:
            which = [w for w, part in (("first", one), ("second", two)) if name in part["failed"]]
            rows.append((name, "", "", "", f"FAILED in the {' and the '.join(which)}"))
            bad += which != ["first"]
            continue
        a, b = one["results"][name], two["results"][name]
        worst, relative, bitwise, wrong, texts = 0.0, 0.0, True, [], []
        for key, value in a.items():
            if key not in b:
                wrong.append(f"{key} missing")
                continue
            other = b[key]
            if isinstance(value, str) or isinstance(other, str):
                if value != other:
                    strict = strict_text or key.split(".")[-1] in ("files", "error")
                    (wrong if strict else texts).append(f"text {key}")
                continue
            gap, share, same, why = differences(value, other)
            bitwise &= same
            if why:
                wrong.append(f"{key}: {why}")
                continue
            worst, relative = max(worst, gap), max(relative, share)
            limit = tolerance if value.dtype == torch.float64 else max(tolerance, 1e-6)
            if value.is_floating_point():
                beyond = (
                    gap > limit
                    and share > limit
                    and not torch.allclose(
                        value.double(), other.double(), rtol=limit, atol=limit, equal_nan=True
                    )
                )
            else:
                beyond = not same
            if beyond:
                wrong.append(f"{key}: abs {gap:.1e} rel {share:.1e}")
        new = [key for key in b if key not in a]
        bad += bool(wrong)
        said = "; ".join(wrong[:4]) + (f"; and {len(wrong) - 4} more" if len(wrong) > 4 else "")
        said += (
            f" [texts differ: {', '.join(texts[:4])}{'...' if len(texts) > 4 else ''}]"
            if texts
            else ""
        )
        said += f" [new: {', '.join(new[:4])}{'...' if len(new) > 4 else ''}]" if new else ""
        rows.append(
            (
                name,
                str(len(a)),
                f"{worst:.1e} {relative:.1e}",
                "yes" if bitwise else "no",
                ("BEYOND " if wrong else "") + said,
            )
        )
    width = max(len(row[0]) for row in rows)
    print(f"{'capability':<{width}}  arrays  max abs  max rel  bitwise")
    for name, count, gap, same, said in rows:
        print(f"{name:<{width}}  {count:>6}  {gap:<15}  {same:<4} {said}")
    print(f"\n{len(rows)} capabilities, {bad} beyond {tolerance:g}")
    return 1 if bad else 0


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("write")
    one.add_argument("out")
    one.add_argument(
        "--only", nargs="*", default=[], help="names, beginnings of names, or patterns"
    )
    two = commands.add_parser("compare")
    two.add_argument("a")
    two.add_argument("b")
    two.add_argument("--only", nargs="*", default=[], help="compare these alone")
    two.add_argument("--tolerance", type=float, default=1e-10)
    two.add_argument(
        "--strict-text", action="store_true", help="texts that differ are failures, too"
    )
    commands.add_parser("list")
    args = parser.parse_args()
    if args.command == "write":
        return write(args.out, args.only)
    if args.command == "compare":
        return compare(args.a, args.b, args.tolerance, args.strict_text, args.only)
    print("\n".join(CAPABILITIES))
    return 0


if __name__ == "__main__":
    sys.exit(main())
