import torchpose
from torchpose.errors import InputError
from torchpose.upper_body import method_options

prior = torchpose.load_prior("kinect-upper-body-small")
print(torchpose.UpperBodyTracker(prior, prior.camera).method)
# > multiple-model
print(method_options("window-mixture"))
# > ('likelihood_power', 'dtype')
try:
    torchpose.UpperBodyTracker(prior, prior.camera, n_tracks=20)
except InputError as error:
    print(str(error).split("; ")[1])
# > it is of mkf-sampled, mkf-split
