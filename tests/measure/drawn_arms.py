"""Arms as a camera might see them, drawn."""

import numpy as np
import torch

from torchpose.skeleton import UPPER_BODY

JOINTS = {
    "hand_left": (200, 150), "elbow_left": (230, 110), "shoulder_left": (190, 70), "head": (160, 30),
    "neck": (160, 55), "shoulder_right": (130, 70), "elbow_right": (90, 110), "hand_right": (70, 150),
}  # fmt: skip


def pose(**moved):
    return torch.tensor([(JOINTS | moved)[name] for name in UPPER_BODY]).float()


def drawing(joints, thickness=14, seed=0):
    """Arms in front of a dull wall, grey [200, 320]."""
    import cv2

    image = np.full((200, 320), 150.0)
    p = {n: tuple(int(c) for c in joints[i]) for i, n in enumerate(UPPER_BODY)}
    for side in ("left", "right"):
        for a, b in (("shoulder", "elbow"), ("elbow", "hand")):
            cv2.line(image, p[f"{a}_{side}"], p[f"{b}_{side}"], 60.0, thickness)
    noise = np.random.default_rng(seed).normal(0, 3, image.shape)
    return (cv2.GaussianBlur(image, (3, 3), 0.8) + noise).clip(0, 255).astype(np.uint8)
