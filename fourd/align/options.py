"""Settings of the stage align: one dataclass for all its commands."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class AlignOptions:
    """Settings of the config section `align`; config/schemas/align.schema.yaml says what each means.

    max_delay_s: largest difference between the starts of two films that sound is searched for, s
    window_s: length of the pieces of sound that are compared, s
    min_sound_score: least score at which two films count as one event
    """

    max_delay_s: float = 60.0
    window_s: float = 2.0
    min_sound_score: float = 0.5
