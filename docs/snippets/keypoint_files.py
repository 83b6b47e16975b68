import torch

from torchpose.io import Keypoints, read_keypoints, write_keypoints

points = torch.rand(90, 4, 2, dtype=torch.float64) * 400
points[30:60, 2] = torch.nan  # one hand was not seen for a second
clip = Keypoints(
    points, names=("head", "neck", "left_wrist", "right_wrist"), fps=30, image_size=(640, 480)
)
write_keypoints("clip.csv", clip)

again = read_keypoints("clip.csv")
print(again.keypoints.shape, again.names, again.fps)
# > torch.Size([90, 4, 2]) ('head', 'neck', 'left_wrist', 'right_wrist') 30.0
print(again.measured.sum(0))
# > tensor([90, 90, 60, 90])
