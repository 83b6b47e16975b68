import json

import numpy as np

from torchpose.io import read_keypoints

coco = [
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip",
    "left_knee", "right_knee", "left_ankle", "right_ankle",
]  # fmt: skip
made_up = [float(v) for j in range(17) for v in (300 + 9 * j, 100 + 9 * j, 0.9)]

# Results in COCO's layout, as AlphaPose and MMPose write them: an entry for each person in each image.
with open("results.json", "w") as file:
    json.dump(
        [{"image_id": f"{t}.jpg", "keypoints": made_up, "score": 0.9} for t in range(3)], file
    )
with open("results.json") as file:
    entries = json.load(file)
best = {}  # of several persons in an image the one of the highest score
for entry in entries:
    t = int(str(entry["image_id"]).split(".")[0])  # the number of the frame
    if t not in best or entry["score"] > best[t]["score"]:
        best[t] = entry
table = np.zeros((max(best) + 1, 17, 3))  # x, y, score; zeros are missing
for t, entry in best.items():
    table[t] = np.reshape(entry["keypoints"], (17, 3))
np.savez(
    "from_coco.npz",
    keypoints=table[..., :2], confidence=table[..., 2].clip(0, 1), names=coco,
    fps=30, image_size=(1280, 720),
)  # fmt: skip
print(read_keypoints("from_coco.npz").keypoints.shape)
# > torch.Size([3, 17, 2])
