import torchpose
from torchpose.upper_body import write_bvh
from torchpose.video import VideoWriter, draw_overlay, open_video
from torchpose.viz import write_report

prior = torchpose.load_prior("kinect-upper-body")
with open_video("clip.mp4") as video:
    camera = torchpose.PinholeCamera.from_image_size(*video.size)
    tracker = torchpose.VideoTracker(prior, camera, fps=video.fps, smoothing="full")
    person = tracker(video)[0]  # the one seen longest
track = person.track

with open_video("clip.mp4") as video, VideoWriter("mine.mp4", video.fps, video.size) as writer:
    for image, _, index in video:
        t = index - person.first_frame
        if 0 <= t < len(person):  # one row for each person
            image = draw_overlay(
                image, track.joints2d[:, t], track.covariance2d[:, t], track.observed[:, t]
            )
        writer.write(image)

write_bvh(track, "mine.bvh")
write_report(
    "mine.html", [track], overlay="mine.mp4", first_frames=[person.first_frame], notes=track.notes
)
