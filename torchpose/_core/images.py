"""Name the type of an image in memory, which measuring, video and the demo share."""

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
"""Eight bits a channel: RGB [H, W, 3], or grey [H, W]."""
