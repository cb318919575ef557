"""Self-supervised composition of instantaneous foreground and static background (section 3.3, 4).

`model` is the network, `losses` and `perceptual` what it minimises, `data` the samples, `train` the page
that fits it to a scene, `validation` how well that goes, `infer` its use: one frame through the levels,
coarse to fine.
"""

import dataclasses

STAGE_VERSION = 5


@dataclasses.dataclass(frozen=True)
class CompositionOptions:
    """What one level's network is and how it is trained; the meaning of each key is in the schema."""

    num_filters: tuple[int, ...] = (28, 23, 13)
    unet_width: int = 1
    depth: int = 4
    head: str = "blend"
    streams: str = "all"
    l1_weight: float = 100.0
    adversarial_weight: float = 0.0
    frequency_weight: float = 100.0
    perceptual_weight: float = 0.0
    lpips_weights: str = ""
    average_weights: bool = True
    epochs: int = 10
    learning_rate: float = 1e-3
    warmup_steps: int = 100
    min_scale: float = 0.5
    max_scale: float = 1.0
    crop: int | None = None
    validation_samples: int = 4
    validation_camera: str | None = None
    patience: int | None = None
    seed: int = 0
    precision: str = "auto"
    num_threads: int = 2
    max_minutes: float | None = None
    checkpoint_s: float = 60.0
    cache_mb: int = 1024
    tensorboard: bool = False


@dataclasses.dataclass(frozen=True)
class CascadeOptions:
    """When a frame needs the coarser levels; read at test time only, so a change retrains nothing."""

    min_hole_share: float = 0.02
    min_largest_hole_share: float = 0.005
