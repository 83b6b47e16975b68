import torch

from torchpose.math import (
    angle_to_edge,
    compose,
    fit_gaussian,
    gaussian_rotate,
    rotate_gaussian,
    safe_centre,
)

# recorded rotations, as quaternion vectors: axis times the sine of half the angle
generator = torch.Generator().manual_seed(0)
draws = 0.1 * torch.randn(500, 3, generator=generator).double()
recorded = compose(torch.tensor([0.0, 0.9, 0.3]).double(), draws)
centre = safe_centre(recorded)
for space in (None, centre):  # how far they stay from the edge, without and with the centre
    print(f"{angle_to_edge(recorded, space).rad2deg():.0f} degrees")
# > 4 degrees
# > 127 degrees

# a Gaussian around that centre, turned by a known rotation from the left and from the right
mean, covariance = fit_gaussian(recorded, centre)
turn = torch.tensor([0.5, 0.1, -0.3]).double()
new_centre = compose(turn, centre)
before = rotate_gaussian(turn, mean, covariance, centre=centre, new_centre=new_centre)
after = gaussian_rotate(mean, covariance, turn, centre=centre, new_centre=compose(centre, turn))

# the same by 100,000 draws
noise = torch.randn(100_000, 3, generator=generator).double()
x = mean + noise @ torch.linalg.cholesky(covariance).mT
drawn = fit_gaussian(compose(turn, compose(centre, x)), new_centre)
offset = compose(-drawn[0], before[0]).norm()
print(f"means {2 * offset.rad2deg():.1f} degrees apart,", end=" ")
print(f"covariances {(before[1] - drawn[1]).norm() / drawn[1].norm():.0%}")
# > means 0.0 degrees apart, covariances 0%
