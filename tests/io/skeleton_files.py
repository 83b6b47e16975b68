"""Files of 3D joints as sensors write them, made by hand for tests, in NumPy alone."""

import json

import numpy as np

from torchpose.skeleton._joint_sets import canonical_names

# metres in camera axes (y down) from the middle of the shoulders, someone who faces the camera
_CENTRAL = {
    "head": (0, -0.28), "neck": (0, -0.1), "shoulder_center": (0, -0.1), "nose": (0, -0.26),
    "spine_shoulder": (0, 0.0), "spine": (0, 0.3), "spine_chest": (0, 0.15),
    "spine_navel": (0, 0.3), "hip_center": (0, 0.5),
}  # fmt: skip
_SIDED = {
    "clavicle": (0.08, -0.02), "shoulder": (0.18, 0.0), "elbow": (0.26, 0.26),
    "wrist": (0.3, 0.48), "hand": (0.31, 0.55), "hand_tip": (0.31, 0.62), "thumb": (0.28, 0.57),
    "hip": (0.09, 0.5), "knee": (0.1, 0.9), "ankle": (0.1, 1.3), "foot": (0.11, 1.35),
    "eye": (0.03, -0.3), "ear": (0.07, -0.28),
}  # fmt: skip


def person(names, n_frames=6, place=(0.1, -0.2, 2.0), seed=0):
    """Joints [T, J, 3] in camera axes, metres, with a little motion."""
    rest = []
    for name in canonical_names(names):
        part, _, side = name.rpartition("_")
        if side in ("left", "right"):
            x, y = _SIDED[part]
            rest.append((x if side == "left" else -x, y, 0.01))
        else:
            rest.append((*_CENTRAL[name], 0.01))
    noise = 0.01 * np.random.default_rng(seed).normal(size=(n_frames, len(rest), 3))
    return np.array(rest) + np.array(place) + noise


def to_kinect(joints):
    """From camera axes to the Kinect SDK's: x and y change sign."""
    return joints * np.array([-1, -1, 1])


def ntu_text(bodies, n_frames, states=None):
    """NTU's layout. `bodies`: {id: {frame: [25, 3] in Kinect axes}}."""
    lines = [str(n_frames)]
    for frame in range(n_frames):
        there = [(body, joints[frame]) for body, joints in bodies.items() if frame in joints]
        lines.append(str(len(there)))
        for body, joints in there:
            lines += [f"{body} 0 1 1 1 1 0 -0.0049 -0.02 2", "25"]
            for j, (x, y, z) in enumerate(joints):
                state = 2 if states is None else states.get((body, frame, j), 2)
                lines.append(
                    f"{x:.7f} {y:.7f} {z:.7f} 250.1 200.2 900.3 500.4 0.1 0.2 0.3 0.4 {state}"
                )
    return "\n".join(lines) + "\n"


def azure_text(bodies, n_frames, names, confidence=None, step=33333):
    """The offline_processor's layout. `bodies`: {id: {frame: [32, 3] camera axes, metres}}."""
    frames = []
    for frame in range(n_frames):
        there = []
        for body, joints in bodies.items():
            if frame not in joints:
                continue
            one = {"body_id": body, "joint_positions": (1000 * joints[frame]).tolist(),
                   "joint_orientations": [[1.0, 0.0, 0.0, 0.0]] * len(names)}  # fmt: skip
            if confidence is not None:
                one["joint_confidence"] = confidence[body, frame]
            there.append(one)
        frames.append({"frame_id": frame, "timestamp_usec": 1000 + step * frame,
                       "num_bodies": len(there), "bodies": there})  # fmt: skip
    return json.dumps({"joint_names": list(names), "bone_list": [], "frames": frames})


def rows_text(joints, first=None, fourth=None, mark=" "):
    """One row per frame: an optional first number, then x, y, z (and a fourth number) per joint."""
    if fourth is not None:
        joints = np.concatenate([joints, np.broadcast_to(fourth, (*joints.shape[:2], 1))], -1)
    lines = []
    for t, row in enumerate(joints.reshape(len(joints), -1)):
        cells = [f"{v:.7g}" for v in row]
        lines.append(mark.join([f"{first[t]:g}", *cells] if first is not None else cells))
    return "\n".join(lines) + "\n"


def daily_text(bodies, n_frames):
    """MSR Daily Activity's layout. `bodies`: a list of {frame: [20, 3] in Kinect axes}."""
    lines = [f"{n_frames} 20"]
    for frame in range(n_frames):
        there = [joints[frame] for joints in bodies if frame in joints]
        lines.append(str(40 * len(there)))
        for joints in there:
            for x, y, z in joints:
                lines += [f"{x:.7f} {y:.7f} {z:.7f} 1", "0.5123 0.4321 1234 1"]
    return "\n".join(lines) + "\n"


def header_text(joints, names, extra=None, state=None, facts=(), mark=","):
    """A table with a header. `extra`: other columns by name; `state`: (kind, [T, J])."""
    extra = extra or {}
    head = [*extra, *(f"{n}_{axis}" for n in names for axis in "xyz")]
    if state is not None:
        head += [f"{n}_{state[0]}" for n in names]
    lines = [*(f"# {fact}" for fact in facts), mark.join(head)]
    for t, row in enumerate(joints):
        cells = [str(values[t]) for values in extra.values()]
        cells += ["" if np.isnan(v) else f"{v:.7g}" for v in row.ravel()]
        if state is not None:
            cells += [f"{v:g}" for v in state[1][t]]
        lines.append(mark.join(cells))
    return "\n".join(lines) + "\n"
