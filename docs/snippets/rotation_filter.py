import torch

from torchpose.math import (
    compose,
    conjugate,
    gaussian_rotate,
    quaternion_vector_to_matrix,
    unscented_update,
)

# a device that tumbles: a gyroscope, and the directions of gravity and of north as it sees them
generator = torch.Generator().manual_seed(0)
drawn = torch.randn(400, 9, generator=generator).double()
turns = torch.tensor([0.03, 0.04, -0.01]).double().repeat(400, 1)  # half the angle per frame
gyroscope = turns + 0.003 * drawn[:, :3]
world = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).double()
process, noise = 0.003**2 * torch.eye(3).double(), 0.1**2 * torch.eye(6).double()


def seen(rotation):
    """Both directions in the axes of the device, six numbers."""
    return (world @ quaternion_vector_to_matrix(rotation)).flatten(-2)


truth = dead_reckoning = centre = mean = torch.zeros(3).double()
covariance = 0.3**2 * torch.eye(3).double()
for turn, step, error in zip(turns, gyroscope, drawn[:, 3:], strict=True):
    truth, dead_reckoning = compose(truth, turn), compose(dead_reckoning, step)
    measured = seen(truth) + 0.1 * error

    # predict: the step of the gyroscope from the right, in a space around the new estimate
    old, centre = centre, compose(compose(centre, mean), step)
    mean, covariance = gaussian_rotate(mean, covariance, step, centre=old, new_centre=centre)
    covariance = covariance + process

    # update: sigma points through what the device would see
    def expected(x, centre=centre):
        return seen(compose(centre, x))

    mean, covariance, _ = unscented_update(expected, mean, covariance, measured, noise)

estimate = compose(centre, mean)
for rotation in (estimate, dead_reckoning):
    error = compose(conjugate(truth), rotation)
    print(f"{2 * error.norm().asin().rad2deg():.1f} degrees")
print(f"{2 * covariance.trace().sqrt().rad2deg():.1f} degrees by the covariance")
# > 0.6 degrees
# > 6.7 degrees
# > 2.3 degrees by the covariance
