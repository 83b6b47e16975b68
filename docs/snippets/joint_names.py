from torchpose.skeleton import canonical_name, upper_body_indices

print([canonical_name(n) for n in ("LWrist", "left_hand", "ElbowRight", "Neck")])
# > ['wrist_left', 'hand_left', 'elbow_right', 'neck']

found = upper_body_indices(["Head", "Neck", "LWrist", "RWrist"])
print(found.hand, found.missing)
# > wrist ('elbow_left', 'shoulder_left', 'shoulder_right', 'elbow_right')
