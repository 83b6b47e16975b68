import numpy as np

from torchpose.io import read_keypoints

width, height, fps = 1280, 720, 30  # of the video
names = [  # in MediaPipe's order
    "nose", "left_eye_inner", "left_eye", "left_eye_outer",
    "right_eye_inner", "right_eye", "right_eye_outer", "left_ear", "right_ear",
    "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
    "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee",
    "left_ankle", "right_ankle", "left_heel", "right_heel", "left_foot_index", "right_foot_index",
]  # fmt: skip
with open("mediapipe.csv", "w") as file:  # a made-up table of two frames, as many scripts write it
    file.write("frame,landmark,x,y,z,visibility\n")
    for frame in range(2):
        for landmark in range(33):
            file.write(f"{frame},{landmark},0.5,{0.3 + 0.01 * landmark},0,0.9\n")

rows = np.genfromtxt("mediapipe.csv", delimiter=",", names=True)
t, j = rows["frame"].astype(int), rows["landmark"].astype(int)
points, visible = np.full((t.max() + 1, 33, 2), np.nan), np.zeros((t.max() + 1, 33))
points[t, j, 0], points[t, j, 1] = rows["x"] * width, rows["y"] * height
visible[t, j] = rows["visibility"]
np.savez(
    "from_mediapipe.npz",
    keypoints=points, visibility=visible, names=names, fps=fps, image_size=(width, height),
)  # fmt: skip
print(read_keypoints("from_mediapipe.npz").names[-4:])
# > ('head', 'neck', 'hand_left', 'hand_right')
