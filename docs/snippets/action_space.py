import math

import torch

from torchpose.body import BODY_15, Body, body_joints
from torchpose.learning import fit_action_space, repetition_axis, split_repetitions
from torchpose.priors import ActionBank, posture_angles, posture_to_state
from torchpose.viz import plot_action_space, save_figure


def somebody(
    action, speed, reach
):  # five times the same; in yours joints [T, K, 3] of `read_mocap`
    body = Body.of_height(BODY_15, 1.6 + 0.2 * reach)
    phase = torch.arange(round(300 / speed), dtype=torch.float64) * (speed * 2 * math.pi / 60)
    states = torch.zeros(len(phase), body.dim, dtype=torch.float64)
    for lag, (part, size) in enumerate(action.items()):
        wave = (1 - (phase - 0.2 * lag).cos()) / 2
        states[:, 3 + 3 * BODY_15.part(part)] = size * reach * wave
    return body.joints(states)


bend = {"left_thigh": -0.6, "right_thigh": -0.6, "left_shank": 0.1, "left_upper_arm": -0.3}
raise_arms = {"left_upper_arm": -0.6, "right_upper_arm": -0.6, "left_forearm": -0.3}
styles = [(1.0, 1.0), (0.8, 1.1), (1.3, 0.9), (1.1, 1.05)]

spaces = []
for name, action in (("bend", bend), ("raise arms", raise_arms)):
    recordings = [body_joints(somebody(action, *style), BODY_15.names) for style in styles]
    postures = [posture_angles(joints) for joints in recordings]  # [T, 36], degrees
    axis = repetition_axis(postures)
    performances = [p[part] for p in postures for part in split_repetitions(p, 30.0, axis)]
    spaces.append(fit_action_space(performances, 3, name=name, fps=30.0))
    save_figure(plot_action_space(spaces[-1]), f"{name}.png")

# the gate: is a posture one of the action, and the nearest one that is
space, generator = spaces[0], torch.Generator().manual_seed(0)
seen = posture_angles(somebody(bend, 0.9, 1.0))
z = space.project(seen)
j = space.match(z, generator)
print(f"{float(space.inside(z, j).double().mean()):.1f} of the postures pass")
body = Body.of_height(BODY_15, 1.7)
inside = posture_to_state(body, space.clamp_postures(seen, j), torch.zeros(body.dim).double())

# several actions, and none of them
bank = ActionBank(spaces)
posterior = bank.recognise(seen)  # [T, 3]: bend, raise arms, none
print(bank.names[int(posterior.mean(0).argmax())], tuple(inside.shape))
