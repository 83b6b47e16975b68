from pathlib import Path

import numpy as np

from torchpose.demo import performer
from torchpose.io import read_recordings
from torchpose.learning import curate, leave_one_person_out
from torchpose.skeleton import UPPER_BODY

for seed, person in enumerate(("alice", "bob", "carol")):  # yours: files in a folder per person
    folder = Path("recordings") / person
    folder.mkdir(parents=True)
    joints = performer(n_frames=300, seed=seed).joints.numpy()
    joints[120, 0] += 0.5  # the left hand jumps
    np.savez(folder / "wave.npz", joints=1000 * joints, names=UPPER_BODY, fps=30)

recordings = read_recordings("recordings")
print(recordings[0].person_id, recordings[0].notes[0][:24])
# > alice# taken for millimetres (t

curated = curate(recordings)
print(curated.report.text().splitlines()[2])
# > dropped  3 joints: jump

for train, test, persons in leave_one_person_out(curated.recordings):
    print(persons, len(train), len(test))
# > ('alice#',) 2 1
# > ('bob#',) 2 1
# > ('carol#',) 2 1
