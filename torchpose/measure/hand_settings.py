"""Constants of the histogram filter for hands."""

from dataclasses import dataclass

__all__ = ["HandSettings"]


@dataclass(frozen=True)
class HandSettings:
    """Constants of `HandTracker`; lengths in face heights B, rates for 30 frames per second.

    Attributes:
        skin_slope, skin_bias, skin_decay, skin_floor, clothes_share: see `SkinModel`.
        unknown_skin: probability of skin where the image has ended.
        face_memory: a hand in front of the face is a change of it; without, the face hides hands.
        face_alignment, face_deviations, face_floor, face_median, face_scale: see `FaceMemory`.
        disc, core, motion, unusual, beyond, towards, beside: weights of the cues, see `HandLikelihood`.
        prior: weight of the log density of a hand given the face.
        jump: share of belief that is born anew from the prior in each frame.
        face_rebirth: cost of that in front of the face, in nats.
        expected_share: of the rebirth about the expected hands, where these are given.
        near, far, near_share: the two widths of diffusion, and the share of the first.
        flow, flow_blur: share of belief that optical flow carries, and its blur.
        rest: diffusion where nothing moves.
        velocity: share of the last displacement that goes on.
        exclusion, exclusion_radius: cost of both hands at one place, in nats, and how far it reaches.
        crossing, crossing_soft: cost of hands on each other's side, in nats, and its softness.
        still: weight of a frame in which nothing moves; what is seen again is old news.
        still_motion: moving area, in B squared, from which a frame counts fully.
        covariance_scale, covariance_floor: the reported covariance is the belief's times the scale,
            plus the floor (a standard deviation).
        least_mass, least_skin: below these a hand is not `seen`.
        stray, rescale: see `follow_faces`.
        face_follow: share of a face's new size that is taken over; face_change: ratio of sizes from
            which all of it is.
    """

    skin_slope: float = 1.5
    skin_bias: float = 0.8
    skin_decay: float = 0.95
    skin_floor: float = 2e-4
    clothes_share: float = 0.5
    unknown_skin: float = 0.15
    face_memory: bool = True
    face_alignment: bool = True
    face_deviations: float = 1.5
    face_floor: float = 2.0
    face_median: float = 0.1
    face_scale: float = 4.0
    disc: float = 5.0
    core: float = 4.0
    motion: float = 4.0
    unusual: float = 0.8
    beyond: float = 3.0
    towards: float = 0.75
    beside: float = 1.2
    prior: float = 1.0
    jump: float = 0.015
    face_rebirth: float = 6.0
    expected_share: float = 0.5
    near: float = 0.06
    far: float = 0.25
    near_share: float = 0.7
    flow: float = 0.5
    flow_blur: float = 0.06
    rest: float = 0.035
    velocity: float = 0.8
    exclusion: float = 2.5
    exclusion_radius: float = 0.34
    crossing: float = 2.8
    crossing_soft: float = 0.15
    still: float = 0.12
    still_motion: float = 0.8
    covariance_scale: float = 2.0
    covariance_floor: float = 0.05
    least_mass: float = 0.3
    least_skin: float = 0.15
    stray: float = 0.5
    rescale: float = 1.15
    face_follow: float = 0.05
    face_change: float = 1.3
