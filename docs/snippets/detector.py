import cv2
import torch

import torchpose


class HeadsAndNecks:
    """Stands for a model of yours: head and neck of everybody, by OpenCV's faces."""

    names = ("head", "neck")

    def __init__(self):
        self.faces = torchpose.measure.HaarFaceDetector()
        self.place = torchpose.measure.HeadNeck()

    def __call__(self, image):
        faces = self.faces(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        keypoints, _ = self.place(faces, torch.eye(3).expand(len(faces), 3, 3))
        return keypoints, torch.full(keypoints.shape[:2], 0.8)  # [N, J, 2] and [N, J]


prior = torchpose.load_prior("kinect-upper-body")
with torchpose.video.open_video("clip.mp4") as video:
    camera = torchpose.PinholeCamera.from_image_size(*video.size)
    tracker = torchpose.VideoTracker(prior, camera, fps=video.fps, detector=HeadsAndNecks())
    people = tracker(video)
print(len(people), people[0].track.joints3d.shape[2:])
# > 1 torch.Size([8, 3])
