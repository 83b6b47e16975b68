import cv2
import numpy as np
import torch

import torchpose


class OtherCascade:
    """Another of the cascades that come with OpenCV."""

    def __init__(self):
        name = cv2.data.haarcascades + "haarcascade_frontalface_alt2.xml"
        self.cascade = cv2.CascadeClassifier(name)

    def __call__(self, image, region=None):
        left, top = (0, 0) if region is None else (region.left, region.top)
        if region is not None:
            image = image[top : region.bottom, left : region.right]
        boxes = self.cascade.detectMultiScale(np.ascontiguousarray(image), 1.1, 3, minSize=(40, 40))
        found = torch.from_numpy(np.asarray(boxes, dtype=np.float64).reshape(-1, 4))
        centres = found[:, :2] + found[:, 2:] / 2 + torch.tensor([left, top])
        return torch.cat([centres, found[:, 2:3]], 1)  # x, y and side of the box


prior = torchpose.load_prior("kinect-upper-body")
with torchpose.video.open_video("clip.mp4") as video:
    camera = torchpose.PinholeCamera.from_image_size(*video.size)
    tracker = torchpose.VideoTracker(prior, camera, fps=video.fps, face_detector=OtherCascade())
    print(len(tracker(video)))
# > 1
