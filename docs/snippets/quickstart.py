import torchpose

prior = torchpose.load_prior("kinect-upper-body")
camera = torchpose.PinholeCamera(fx=525, fy=525, cx=319.5, cy=239.5)
tracker = torchpose.UpperBodyTracker(prior, camera=camera)

clip = torchpose.io.read_keypoints("keypoints.npz")
tracks = tracker(clip.keypoints[None], names=clip.names)  # batch of one
print(tracks.joints3d.shape)  # joints in metres, camera axes
