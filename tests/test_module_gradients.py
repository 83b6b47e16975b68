"""Every public module but those of images: gradients are those of its functions, or there are none."""

from inspect import isabstract

import pytest
import torch
from torch import nn

import torchpose
from tests._core import test_module_state as modules
from tests.gradients import assert_differentiable, assert_without_gradient
from tests.whole_body.filters.bending_body import BODY
from tests.whole_body.filters.walking_body import HEIGHT, WIDTH, rig, walk, walker
from torchpose import body, filters, priors, whole_body
from torchpose.camera import lift, map_pixels, project
from torchpose.camera._projection import backproject
from torchpose.math import euler_to_matrix
from torchpose.math._rotations import matrix_to_euler
from torchpose.priors._actions.part_postures import PartPostures
from torchpose.upper_body._fusion import MotionStage, ReadOut

POINTS = modules.points
ELSEWHERE = {
    "MixtureKalmanFilter": "tests/filters/test_gradients.py",
    "FixedTrackFilter": "tests/filters/test_gradients.py",
    "SampledTrackFilter": "tests/filters/test_gradients.py",
    "SplitTrackFilter": "tests/filters/test_gradients.py",
    "BootstrapParticleFilter": "tests/filters/test_gradients.py",
    "ConstantVelocityFilter": "tests/filters/test_gradients.py",
    "BodyTracker": "tests/whole_body/test_tracker.py",
    "UpperBodyTracker": "tests/test_gradients.py",
    "UpperBodyPrior": "holds mixtures",
    "VideoTracker": "takes images",
}


def states(n=3):
    """Body states of a walk, with no part at its centre, where a norm has no slope."""
    return walk(walker(), n, phase=0.3) + 0.05 * POINTS(5, n, walker().dim).tanh()


def mixture():
    m = modules.gmm(1)
    return {
        "density": (lambda x: [m.log_prob(x), m.component_log_prob(x), m(x)], POINTS(7, 5, 4)),
        "conditioned": (lambda x: m.condition([0, 2], x)[:2], POINTS(7, 5, 2)),
        "marginal": (lambda x: [m.marginal([1, 3]).log_prob(x)], POINTS(7, 5, 2)),
    }


def manifold():
    m = modules.manifold(1)
    x = walk(walker(), 5, seed=3)[:, 6:].to(m.poses) + 0.01
    if m.poses.dtype != torch.float64:
        raise AssertionError("differences need float64")
    return {
        "to_latent": (lambda x: [m.to_latent(x)], x),
        "to_pose": (lambda z: [m.pose_mean(z), *m.to_pose(z)], m.to_latent(x)),
        "reconstruct": (lambda x: [m.reconstruct(x)], x),
    }


def limbs():
    m = modules.limbs(1)
    n = m.tree.n_nodes
    cov = 0.01 * torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
    mean = 0.2 * POINTS(7, n, 3).tanh()
    edges = torch.arange(n - 1)
    return {
        "diffuse": (lambda x: [m.diffuse(x, cov)[1]], mean),
        "transport": (
            lambda x: [
                part for up in (False, True) for part in m.transport(x[1:], cov[1:], edges, up)
            ],
            mean,
        ),
    }


def actions():
    m = modules.actions(1)
    postures = m.mean + 20 * POINTS(7, 5, 36)
    j = torch.arange(5)
    return {
        "project": (lambda x: [m.project(x), m.log_match(m.project(x))], postures),
        "reconstruct": (lambda z: [m.reconstruct(z)], m.project(postures)),
        "clamp": (lambda z: [m.clamp(z, j)], m.project(postures)),
    }


def bank():
    m = modules.bank(1)
    postures = 30 * POINTS(7, 5, 36)
    return {"likelihood": (lambda x: [m.log_likelihood(x), m.project(x)], postures)}


def figure():
    m = walker()
    return {
        "joints": (lambda x: [m(x), m.joints(x), *m.limbs(x)[:2]], states()),
        "parts": (lambda x: [m.part_rotations(x), m.relative(x)], states()),
    }


def limits():
    m = body.JointLimits.fit(POINTS(1, 50, 12).tanh())
    x = 1.3 * POINTS(7, 5, 12).tanh()
    return {"density": (lambda x: [m.log_prob(x), m(x)], x), "clamp": (lambda x: [m.clamp(x)], x)}


def cameras():
    one = torchpose.PinholeCamera(500, 490, 320, 240, rotation=(0.1, 0.2, 0.3))
    several = rig(2)
    matrix, turn = one.matrix.double(), euler_to_matrix(POINTS(2, 3), "zxy")
    place = torch.tensor([0.1, 0.2, 4.0]).double()
    x = POINTS(7, 5, 3) + torch.tensor([0.0, 0.0, 6.0])
    return {
        "camera": (lambda x: [one(x)], x),
        "rig": (lambda x: several(x), 0.3 * POINTS(7, 5, 3)),
        "projection": (
            lambda x: [
                project(x, matrix, turn, place),
                backproject(x, matrix),
                lift(x, matrix, turn, place),
                map_pixels(x[:, :2], matrix, 2 * matrix - torch.diag(matrix.new_tensor([0, 0, 1]))),
            ],
            x,
        ),
        "rotations": (
            lambda x: [
                matrix_to_euler(euler_to_matrix(x, order), order) for order in ("zxy", "zyx")
            ],
            0.5 * POINTS(7, 5, 3).tanh(),
        ),
    }


def stage():
    m = MotionStage(10.0, 20.0, 30.0, 30.0)
    sizes = {"joints": (8, 3), "covs": (8, 3, 3), "angles": (3,), "place": (3,), "uv": (8, 2)}
    lengths = torch.tensor([6, 4])
    seen = torch.ones(2, 6, dtype=torch.bool)
    seen[1, :2] = False

    def reading(x):
        parts = {
            name: x[..., : torch.Size(s).numel()].unflatten(-1, s) for name, s in sizes.items()
        }
        return ReadOut(**parts, uv_covs=parts["covs"][..., :2, :2])

    def run(lag):
        return lambda x: list(m(reading(x), seen, lengths, lag))

    return {str(lag): (run(lag), POINTS(7, 2, 6, 72)) for lag in (0, 2, None)}


def postures():
    m = PartPostures(BODY, dtype=torch.float64)
    return {"postures": (lambda x: [m(x)], 0.5 * POINTS(7, 5, BODY.dim).tanh())}


CASES = {
    "GaussianMixture": mixture,
    "BackConstrainedGPLVM": manifold,
    "LimbConditionals": limbs,
    "ActionSpace": actions,
    "ActionBank": bank,
    "Body": figure,
    "JointLimits": limits,
    "PinholeCamera": cameras,
    "CameraRig": cameras,
    "MotionStage": stage,
    "PartPostures": postures,
}
PARTICLES = (
    "SIRParticleFilter", "AnnealedParticleFilter", "ManifoldParticleFilter",
    "ConstrainedParticleFilter", "RootUncertaintyTracker",
)  # fmt: skip


def test_every_public_module_is_looked_at():
    packages = torchpose, body, filters, priors
    found = {
        name
        for package in packages
        for name in package.__all__
        for value in [getattr(package, name)]
        if isinstance(value, type) and issubclass(value, nn.Module) and not isabstract(value)
    }
    abstract = {"RecursiveFilter", "SilhouetteParticleFilter"}
    assert found - abstract <= {*CASES, *ELSEWHERE, *PARTICLES}


@pytest.mark.parametrize("name", [name for name in CASES if name != "CameraRig"])
def test_gradients_are_those_of_the_functions(name):
    for function, x in CASES[name]().values():
        assert_differentiable(function, x, step=1e-6)


@pytest.mark.parametrize("name", PARTICLES)
def test_particles_of_bodies_have_none(name):
    tracker = modules.CASES[name][0](1)
    if name == "RootUncertaintyTracker":
        own, known = modules.walks(1)
        first = known[0][0]
        seen = whole_body.render(own, known[0][:2], rig(2), HEIGHT, WIDTH)
        cameras = rig(2)
    else:
        seen, cameras = torch.zeros(2, 1), None
        dim = tracker.body.dim
        first = 0.1 * (walk(walker(), 1)[0] if dim == walker().dim else POINTS(3, dim))

    def run(first):
        found = tracker(seen, cameras, first, generator=torch.Generator().manual_seed(0))
        return [found.mean, found.std, found.log_evidence]

    assert_without_gradient(run, first.double())
