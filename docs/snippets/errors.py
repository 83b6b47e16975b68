import torch

from torchpose import PinholeCamera
from torchpose.errors import CameraError, TorchposeError
from torchpose.priors import GaussianMixture

try:
    PinholeCamera(fx=0, fy=525, cx=319.5, cy=239.5)
except CameraError as error:
    print(type(error).__name__)
# > CameraError

try:
    GaussianMixture(torch.tensor([0.5, 0.5]), torch.zeros(2, 3), torch.eye(2).expand(2, 2, 2))
except TorchposeError as error:  # the base class of them all
    print(error)
# > covariances must have shape [2, 3, 3], got [2, 2, 2]
