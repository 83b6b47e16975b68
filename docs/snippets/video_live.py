import torchpose
from torchpose.video import open_video

prior = torchpose.load_prior("kinect-upper-body")
with open_video("clip.mp4") as video:  # open_video(0) is the first camera
    camera = torchpose.PinholeCamera.from_image_size(*video.size)
    tracker = torchpose.VideoTracker(prior, camera, fps=video.fps, max_persons=1)
    state = tracker.init()
    for frame in video:  # with image, time and index
        state, people = tracker.step(state, frame)

for number, pose, measured in people:
    print(number, pose.joints3d.shape, measured.keypoints.shape)
# > 0 torch.Size([1, 1, 8, 3]) torch.Size([1, 6, 2])
