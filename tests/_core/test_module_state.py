"""Every public module: its state is whole, shared by nothing, and all that counts when it is loaded."""

import copy
import io
import pickle
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from inspect import isabstract

import numpy as np
import pytest
import torch
from safetensors.torch import save
from torch import nn
from torch.utils.data import DataLoader, Dataset

import torchpose
from tests.whole_body.filters.bending_body import BODY, performances, space
from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, walk, walker
from tests.whole_body.keypoints.scenes import moving_body, ring
from torchpose import body, filters, measure, priors, whole_body
from torchpose.body import Body, JointLimits
from torchpose.camera import PinholeCamera
from torchpose.filters._constant_velocity import ConstantVelocityFilter
from torchpose.learning import fit_action_space, fit_gplvm, fit_gplvm_noise, fit_limb_conditionals
from torchpose.measure._association import HandAssociation
from torchpose.measure._brightness_background import BrightnessBackground
from torchpose.measure._face import FaceTracker
from torchpose.measure._hand_prior import HandPrior
from torchpose.measure._persons import PersonRegister
from torchpose.measure._skin import SkinModel
from torchpose.priors import ActionBank
from torchpose.priors._actions.part_postures import PartPostures
from torchpose.priors._limb_conditionals import in_body_frame
from torchpose.upper_body._fusion import MotionStage
from torchpose.whole_body._filters.posture_gate import PostureGate

G = torch.Generator
PACKAGES = (
    "torchpose",
    *(f"torchpose.{p}" for p in ("body", "filters", "measure", "priors", "whole_body")),
)
ELSEWHERE = {
    "RecursiveFilter": "an abstract base",
    "SilhouetteParticleFilter": "an abstract base",
    "MixtureKalmanFilter": "tests/filters/test_filter_state.py",
    "FixedTrackFilter": "tests/filters/test_filter_state.py",
    "SampledTrackFilter": "tests/filters/test_filter_state.py",
    "SplitTrackFilter": "tests/filters/test_filter_state.py",
    "BootstrapParticleFilter": "tests/filters/test_filter_state.py",
    "UpperBodyTracker": "tests/upper_body/test_tracker_state.py",
}


def points(seed, *shape):
    return torch.randn(*shape, generator=G().manual_seed(seed), dtype=torch.float64)


def gmm(seed, dim=4):
    root = points(seed, 3, dim, dim)
    cov = root @ root.mT + torch.eye(dim)
    return priors.GaussianMixture(torch.tensor([0.2, 0.3, 0.5]).double(), points(seed, 3, dim), cov)


def upper_body_prior(seed):
    prior = torchpose.load_prior("kinect-upper-body-small")
    with torch.no_grad():
        for buffer in prior.buffers():
            if buffer.ndim == 3:
                buffer.mul_(1 + 0.1 * seed)
    return prior


def scene(seed, n=4):
    g = G().manual_seed(seed)
    return torch.randint(60, 200, (n, 3, 48, 64), generator=g, dtype=torch.uint8)


def manifold(seed):
    poses = walk(walker(), 40, seed=seed, phase=seed)[:, 6:]
    made = fit_gplvm(poses, steps=1, n_init=1)
    fit_gplvm_noise(made, walk(walker(), 30, seed=seed + 5)[:, 6:], 60.0)
    return made


@cache
def walks(seed):
    """A body with safe centres, and walks of it; a cache of what two cases share."""
    seen = [walk(walker(), 120, seed=k, phase=k, speed=0.01) for k in (seed, seed + 1)]
    return in_body_frame([(walker(), seen)])


def limbs(seed):
    return fit_limb_conditionals(*walks(seed), 60.0)


def actions(seed):
    return space("bend" if seed == 1 else "wave")


def bank(seed):
    other = fit_action_space(performances("wave", first=50 * seed), 4, name="wave", fps=30.0)
    return ActionBank([space("bend"), other])


def low_states(states, frame):
    """A likelihood that can be pickled."""
    return -states.square().sum(-1)


def body_filter(kind, model=None, person=walker):
    """Makes filters over bodies of two builds, with what they have learnt."""

    def make(seed):
        learnt = () if model is None else (model(seed),)
        own = person().altered(radii=person().radii * (1 + 0.1 * seed))
        return kind(own, *learnt, 20, process_cov=(0.01 * seed) ** 2, likelihood=low_states)

    return make


def follow(tracker):
    states = walk(walker(), 1) if tracker.body.dim == walker().dim else points(3, 1, BODY.dim)
    return tracker(torch.zeros(3, 1), None, 0.1 * states[0], generator=G().manual_seed(0)).mean


def root_tracker(seed):
    own, _ = walks(1)
    own = own.altered(radii=own.radii * (1 + 0.1 * seed))
    learnt = fit_limb_conditionals(own, [0.9 * seed * s for s in walks(1)[1]], 60.0)
    return whole_body.RootUncertaintyTracker(
        own, learnt, 10, fps=60.0, process_cov=(0.01 * seed) ** 2
    )


def follow_root(tracker):
    own, states = walks(1)
    seen = whole_body.render(own, states[0][:3], rig(2), HEIGHT, WIDTH)
    return tracker(seen, rig(2), states[0][0], generator=G().manual_seed(0)).mean


def body_tracker(seed):
    own = Body.of_height(body.BODY_15, 1.6 + 0.1 * seed)
    noise = torch.full((own.dim,), (0.01 * seed) ** 2, dtype=torch.float64)
    return torchpose.BodyTracker(
        rig(2, 3.0 + seed), "root", body=own, manifold=manifold(1), conditionals=limbs(1),
        n_particles=70, process_cov=noise, initial_cov=2 * noise,
    )  # fmt: skip


def follow_body(tracker):
    seen = whole_body.render(walker(), walk(walker(), 3), rig(2), HEIGHT, WIDTH)
    start = walker().convert(walk(walker(), 1)[0], tracker.body)
    poses = tracker(seen, start, generator=G().manual_seed(0))
    return poses.state, poses.covariance3d, tracker.upright.joints(walk(walker(), 2))


def keypoint_tracker(count):
    """Makes trackers by keypoints of some cameras and persons of two sizes."""

    def make(seed):
        rig = ring(count, 3.0 + seed)
        return torchpose.BodyTracker(rig, "kalman", height=1.5 + 0.1 * seed, fps=10.0)

    return make


def follow_keypoints(tracker):
    """With more cameras than one, one alone at first, which is tracked as if it were the only one."""
    seen = ring(len(tracker.cameras))(moving_body(8)).pixels
    seen[:, 1:] = torch.nan
    track = tracker(keypoints=seen)
    return track.joints3d, track.covariance3d


def off_centre(by):
    """Centres of all parts but the root, which has none."""
    centres = torch.full_like(BODY.centres, by)
    centres[0] = 0
    return centres


def state_of(module):
    """For modules without a function of their own: what they hold."""
    return tuple(module.state_dict().values())


STATE_ONLY = {
    kind.__name__: kind
    for kind in (FaceTracker, HandAssociation, measure.HeadNeck, measure.MeanShiftHandTracker,
                 PersonRegister, measure.SkinMixtureModel, SkinModel)
} | {
    "HandTracker": lambda: measure.HandTracker(CASES["HandPrior"][0](1)),
    "UpperBodyMeasurer": lambda: measure.UpperBodyMeasurer(upper_body_prior(1)),
}  # fmt: skip

CASES = {
    "GaussianMixture": (gmm, lambda m: m.log_prob(points(7, 5, 4))),
    "UpperBodyPrior": (
        upper_body_prior,
        lambda m: (m.left.log_prob(points(7, 5, 21)), m.windows["causal"].left.covariances),
    ),
    "BackConstrainedGPLVM": (manifold, lambda m: m.to_pose(m.to_latent(walk(walker(), 5)[:, 6:]))),
    "LimbConditionals": (limbs, lambda m: (state_of(m), m._predict, m._carry)),
    "ActionSpace": (actions, lambda m: m.project(points(7, 5, 36))),
    "ActionBank": (bank, lambda m: m.log_likelihood(points(7, 5, 36))),
    "PartPostures": (
        lambda s: PartPostures(BODY.altered(centres=off_centre(0.1 * s))),
        lambda m: m(points(7, 5, BODY.dim).float().tanh()),
    ),
    "ConstantVelocityFilter": (
        lambda s: ConstantVelocityFilter(10.0**s, 30.0 + s),
        lambda m: (m(points(7, 2, 9, 3)), m.smooth(points(7, 2, 9, 3))),
    ),
    "MotionStage": (
        lambda s: MotionStage(10.0**s, 20.0 * s, 30.0, 30.0),
        lambda m: m.joints(points(7, 2, 9, 3)),
    ),
    "SIRParticleFilter": (body_filter(whole_body.SIRParticleFilter), follow),
    "AnnealedParticleFilter": (body_filter(whole_body.AnnealedParticleFilter), follow),
    "ManifoldParticleFilter": (body_filter(whole_body.ManifoldParticleFilter, manifold), follow),
    "ConstrainedParticleFilter": (
        body_filter(whole_body.ConstrainedParticleFilter, actions, lambda: BODY),
        follow,
    ),
    "RootUncertaintyTracker": (root_tracker, follow_root),
    "BodyTracker": (body_tracker, follow_body),
    "BodyTracker by keypoints": (keypoint_tracker(2), follow_keypoints),
    "BodyTracker by keypoints of one camera": (keypoint_tracker(1), follow_keypoints),
    "PostureGate": (lambda s: PostureGate(BODY, actions(s)), state_of),
    "PinholeCamera": (
        lambda s: PinholeCamera(500 + s, 500, 320, 240, translation=(0, 0, s)),
        lambda m: m(points(7, 5, 3) + 5),
    ),
    "CameraRig": (lambda s: rig(2, 3.0 + s), lambda m: m(points(7, 5, 3))),
    "Body": (
        lambda s: Body.of_height(body.BODY_15, 1.6 + 0.1 * s),
        lambda m: (m.joints(walk(walker(), 5)), m.limbs(walk(walker(), 5))),
    ),
    "JointLimits": (
        lambda s: JointLimits.fit(points(s, 50, 12).tanh()),
        lambda m: m.log_prob(points(7, 5, 12).tanh()),
    ),
    "BrightnessBackground": (
        lambda s: BrightnessBackground().fit(scene(s)),
        lambda m: m(scene(7)[0]),
    ),
    "HandPrior": (
        lambda s: HandPrior.from_prior(upper_body_prior(s)),
        lambda m: m(torch.tensor([[1.5, 4.0], [-1.5, 4.0]])),
    ),
    "VideoTracker": (
        lambda s: torchpose.VideoTracker(
            upper_body_prior(s), PinholeCamera.from_image_size(64, 48), smoothing="full"
        ),
        lambda m: (state_of(m), state_of(m.smoother)),
    ),
}  # fmt: skip


def public_modules():
    """Classes of modules that the public packages name."""
    found = {}
    for package in PACKAGES:
        module = import_module(package)
        for name in module.__all__:
            value = getattr(module, name)
            if isinstance(value, type) and issubclass(value, nn.Module) and not isabstract(value):
                found[name] = value
    return found


def tensors(value):
    """All tensors and arrays of a result, in order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, np.ndarray):
        return [torch.from_numpy(value)]
    if isinstance(value, tuple | list):
        return [t for part in value for t in tensors(part)]
    if is_dataclass(value):
        return [t for field in fields(value) for t in tensors(getattr(value, field.name))]
    return []


def assert_same(a, b):
    pairs = list(zip(tensors(a), tensors(b), strict=True))
    assert pairs
    for x, y in pairs:
        torch.testing.assert_close(x, y, rtol=0, atol=0, equal_nan=True)


def through_a_file(state):
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def test_every_public_module_is_looked_at():
    assert set(public_modules()) <= {*CASES, *ELSEWHERE, *STATE_ONLY}


@pytest.mark.parametrize("name", CASES)
def test_the_state_goes_round(name):
    make, run = CASES[name]
    module, other = make(1), make(2)
    entries, size = list(module.state_dict()), len(pickle.dumps(module))
    expected = run(module)
    assert list(module.state_dict()) == entries
    assert len(pickle.dumps(module)) == size
    save(dict(module.state_dict()))  # which refuses memory that entries share
    run(other)
    other.load_state_dict(through_a_file(module.state_dict()))
    for again in (other, copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert_same(run(again), expected)


@pytest.mark.parametrize(
    "name",
    [
        "GaussianMixture",
        "UpperBodyPrior",
        "PinholeCamera",
        "BodyTracker",
        "BodyTracker by keypoints",
    ],
)
def test_a_narrow_state_loads_into_the_precision_of_the_module(name):
    make, run = CASES[name]
    copied, assigned = make(2), make(2)
    narrow = {
        key: value.float() if getattr(value, "is_floating_point", bool)() else value
        for key, value in make(1).state_dict().items()
    }
    copied.load_state_dict(narrow)
    assigned.load_state_dict(narrow, assign=True)
    assert_same(state_of(assigned), state_of(copied))
    assert_same(run(assigned), run(copied))


@pytest.mark.parametrize("name", STATE_ONLY)
def test_a_measurer_is_copied_and_its_state_loads_into_another(name):
    module = STATE_ONLY[name]()
    save(dict(module.state_dict()))
    again = pickle.loads(pickle.dumps(module))
    again.load_state_dict(through_a_file(module.state_dict()))
    for own, copied in zip(module.state_dict().items(), again.state_dict().items(), strict=True):
        assert own[0] == copied[0] and torch.equal(own[1], copied[1])


class Scored(Dataset):
    """Samples scored by modules that went to a worker process."""

    def __init__(self):
        self.prior = gmm(1)
        self.tracker = filters.MixtureKalmanFilter(self.prior, torch.ones(4), torch.ones(2), [0, 2])

    def __len__(self):
        return 4

    def __getitem__(self, index):
        with torch.no_grad():
            return self.tracker(points(index, 1, 5, 2)).mean


@pytest.mark.slow
def test_modules_go_to_worker_processes():
    data = Scored()
    here = torch.stack([data[i] for i in range(4)])
    loader = DataLoader(data, batch_size=4, num_workers=1, multiprocessing_context="spawn")
    torch.testing.assert_close(next(iter(loader)), here, rtol=0, atol=0)
