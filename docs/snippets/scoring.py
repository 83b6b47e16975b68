import torch

from torchpose.metrics import joint_errors_3d, pcp, procrustes

truth = torch.randn(100, 8, 3)
estimate = truth + 0.02 * torch.randn(100, 8, 3)

motion = procrustes(estimate, truth)  # rigid: no scale, no reflection
print(motion.rotation.shape)
# > torch.Size([100, 3, 3])
errors = joint_errors_3d(estimate, truth)  # metres, after aligning head, neck and shoulders
print(errors.shape)
# > torch.Size([100, 8])
print(pcp(estimate, truth, thresholds=[0.5]).overall > 0.9)
# > tensor([True])
