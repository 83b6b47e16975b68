import torchpose

prior = torchpose.load_prior("kinect-upper-body")
with torchpose.video.open_video("clip.mp4") as video:
    camera = torchpose.PinholeCamera.from_image_size(*video.size)
    people = torchpose.VideoTracker(prior, camera, fps=video.fps)(video)
for person in people:
    print(person.first_frame, person.track.joints3d.shape)  # metres, camera axes
