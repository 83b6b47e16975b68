import torchpose

manifold = torchpose.load_manifold("walk")
limbs = torchpose.load_limb_conditionals("exercises")
bank = torchpose.load_action("exercises")
print(manifold.info.actions, limbs.info.fps, len(bank.info.names))
# > ('walk',) 30.0 11
