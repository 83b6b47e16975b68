import torch

from torchpose.math import compose, gaussian_rotate, rotate_gaussian
from torchpose.viz import plot_rotations, save_figure

# a knee that bends: 60 degrees from straight, deviations of 25 degrees about the knee, 6 and 3
centre, mean = torch.tensor([0.5, 0.0, 0.0]).double(), torch.zeros(3).double()
covariance = torch.diag(torch.tensor([25.0, 3.0, 6.0]).double().deg2rad() / 2) ** 2
thigh = torch.tensor([-0.35, 0.0, 0.3]).double()  # raised, and to the side

shank = compose(thigh, centre)  # the centre of the space of the result
before = rotate_gaussian(thigh, mean, covariance, centre=centre, new_centre=shank)
after = gaussian_rotate(mean, covariance, thigh, centre=centre, new_centre=compose(centre, thigh))
panels = {
    "N(x)": (mean, covariance, centre),
    "F(q, N(x)): q from the left": (*before, shank),
    "F(N(x), q): q from the right": (*after, compose(centre, thigh)),
}
generator = torch.Generator().manual_seed(0)
save_figure(plot_rotations(panels, view=(140, 15), generator=generator), "rotations.png")
