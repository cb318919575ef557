"""Pictures with nothing to match, too much to match, or values at the ends of what is stored."""

import numpy as np

from fourd.stability import rig
from fourd.stability.case import (
    Outcome,
    elementwise_difference,
    judge,
    judge_refusal,
    make_cases,
    reason_of,
)
from fourd.stereo.disparity import PairDisparity, StereoOptions, make_matcher, rectify_image
from fourd.stereo.files import decode_confidence, decode_disparity, encode_confidence, encode_disparity
from fourd.stereo.rectification import Rectification
from fourd.stereo.rectify import disparity_from_depth, inverse_depth_from_disparity

LEFT, RIGHT_CAMERA = rig.on_arc(0), rig.on_arc(10)
SHAPE = (rig.SIZE[1], rig.SIZE[0], 3)
MAX_INVENTED = 0.02


def _rectification() -> Rectification:
    result, reason = rig.rectify(LEFT, RIGHT_CAMERA)
    if result is None:
        raise AssertionError(f"the ordinary pair is refused: {reason}")
    return result


def _match(left: np.ndarray, right: np.ndarray) -> PairDisparity:
    return rig.match(_rectification(), LEFT, RIGHT_CAMERA, (left, right))


def _is_clean(found: PairDisparity) -> bool:
    """Confidence is a number in 0..1, and above 0 exactly where there is a disparity."""
    sides = (
        (found.left_disparity, found.left_confidence),
        (found.right_disparity, found.right_confidence),
    )
    return all(
        bool(np.isfinite(c).all() and (c >= 0).all() and (c <= 1).all() and ((c > 0) == np.isfinite(d)).all())
        for d, c in sides
    )


def _nothing_invented(left: np.ndarray, right: np.ndarray) -> Outcome:
    found = _match(left, right)
    share = float(np.isfinite(found.left_disparity).mean())
    return judge(_is_clean(found) and share <= MAX_INVENTED, f"{share:.1%} matched")


def _flat(level: int) -> np.ndarray:
    return np.full(SHAPE, level, np.uint8)


def _noise(seed: int, level: float, sigma: float) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(level, sigma, SHAPE)
    return np.clip(np.rint(noise), 0, 255).astype(np.uint8)


def black_pictures() -> Outcome:
    """Nothing matched."""
    return _nothing_invented(_flat(0), _flat(0))


def saturated_pictures() -> Outcome:
    """Nothing matched."""
    return _nothing_invented(_flat(255), _flat(255))


def one_black_picture() -> Outcome:
    """Nothing matched."""
    return _nothing_invented(rig.render(LEFT), _flat(0))


def textureless_wall_with_noise() -> Outcome:
    """At most 2 % of the noise taken for a surface."""
    return _nothing_invented(_noise(1, 128, 1.5), _noise(2, 128, 1.5))


def pictures_of_pure_noise() -> Outcome:
    """At most 2 % of the noise taken for a surface."""
    return _nothing_invented(_noise(1, 128, 40), _noise(2, 128, 40))


def pictures_of_different_places() -> Outcome:
    """At most 5 % matched: the surfaces do not exist."""
    upside_down = rig.render(RIGHT_CAMERA)[::-1, ::-1].copy()
    found = _match(rig.render(LEFT), upside_down)
    share = float(np.isfinite(found.left_disparity).mean())
    return judge(_is_clean(found) and share <= 0.05, f"{share:.1%} matched")


def repeated_stripes() -> Outcome:
    """Confidence and disparity stay numbers where every stripe matches every other."""
    stripes = np.broadcast_to(((np.arange(SHAPE[1]) % 8 < 4) * 255).astype(np.uint8)[None, :, None], SHAPE)
    found = _match(np.ascontiguousarray(stripes), np.ascontiguousarray(stripes))
    return judge(_is_clean(found), f"{np.isfinite(found.left_disparity).mean():.0%} matched")


def half_a_picture_saturated() -> Outcome:
    """The other half is matched, the saturated one is not."""
    left, right = rig.render(LEFT), rig.render(RIGHT_CAMERA)
    left[:, : SHAPE[1] // 2] = 255
    found = np.isfinite(_match(left, right).left_disparity)
    inside, _ = rectify_image(left, _rectification(), LEFT, "left", "linear")
    blown = (inside == 255).all(axis=2)
    shares = float(found[blown].mean()), float(found[~blown].mean())
    return judge(
        shares[0] < 0.05 and shares[1] > 0.3, f"{shares[0]:.1%} of the blown half, {shares[1]:.0%} beside"
    )


def picture_of_another_size() -> Outcome:
    """Refused: both sizes are named."""
    reason = reason_of(_match, rig.render(LEFT)[:-1], rig.render(RIGHT_CAMERA))
    return judge_refusal(reason, "160x90")


def range_of_no_width() -> Outcome:
    """A range from 0 to 0 finds disparity 0 in equal pictures."""
    image = rig.render(LEFT)
    found = make_matcher(StereoOptions()).match(image, image, (0.0, 0.0)).disparity
    share = float(np.mean(np.abs(found[np.isfinite(found)]) < 0.5)) if np.isfinite(found).any() else 0.0
    return judge(share > 0.99, f"{share:.1%} of what is found is 0")


def pictures_of_one_row() -> Outcome:
    """A shape as asked for, no error."""
    image = rig.render(LEFT)[:1]
    match = make_matcher(StereoOptions()).match(image, image, (-3.0, 5.0))
    return judge(
        match.disparity.shape == image.shape[:2] == match.confidence.shape, f"{match.disparity.shape}"
    )


def disparity_of_infinity() -> Outcome:
    """Inverse depth 0, exactly, and back."""
    geometry = _rectification()
    disparity = disparity_from_depth(geometry, np.array([np.inf]))
    inverse = float(inverse_depth_from_disparity(geometry, disparity)[0])
    return judge(bool(np.isfinite(disparity).all()) and inverse == 0, f"{disparity[0]:.2f} px is {inverse:g}")


def disparities_below_infinity() -> Outcome:
    """A negative inverse depth: behind infinity, never a large depth."""
    geometry = _rectification()
    below = np.array(geometry.disparity_at_infinity[0]) - np.array([1e-6, 1.0, 100.0])
    inverse = inverse_depth_from_disparity(geometry, below)
    return judge(bool((inverse < 0).all()), f"{inverse.max():.1g} and below")


def depth_and_disparity_in_single_precision() -> Outcome:
    """Inverse depth from float32 disparities as from float64, within 1e-6 of the nearest."""
    geometry = _rectification()
    depth = np.geomspace(rig.RANGE[0], 1e6, 2000)
    disparity = disparity_from_depth(geometry, depth)
    single = inverse_depth_from_disparity(geometry, disparity.astype(np.float32))
    error = float(np.abs(single - 1 / depth).max() * rig.RANGE[0])
    return judge(error < 1e-6, f"within {error:.1g}", error)


def disparity_beyond_the_file() -> Outcome:
    """Refused: it does not fit, and it does not wrap."""
    return judge_refusal(reason_of(encode_disparity, np.array([[1024.0]], np.float32)), "do not fit")


def stored_holes() -> Outcome:
    """NaN and both infinities are stored as holes, the ends of the range as themselves."""
    stored = np.array([[np.nan, np.inf, -np.inf, 1023.96875, -1023.96875, 0.0]], np.float32)
    found = decode_disparity(encode_disparity(stored))
    is_right = bool(np.isnan(found[0, :3]).all()) and elementwise_difference(found[0, 3:], stored[0, 3:]) == 0
    return judge(is_right, f"{found[0].tolist()}")


def stored_confidence() -> Outcome:
    """0 and 1 stay what they are; all else within 1/510."""
    confidence = np.linspace(0, 1, 1001, dtype=np.float32)
    found = decode_confidence(encode_confidence(confidence))
    error = float(np.abs(found - confidence).max())
    return judge(found[0] == 0 and found[-1] == 1 and error <= 1 / 510 + 1e-6, f"within {error:.2g}", error)


CASES = make_cases(
    "matching",
    black_pictures,
    saturated_pictures,
    one_black_picture,
    textureless_wall_with_noise,
    pictures_of_pure_noise,
    pictures_of_different_places,
    repeated_stripes,
    half_a_picture_saturated,
    picture_of_another_size,
    range_of_no_width,
    pictures_of_one_row,
    disparity_of_infinity,
    disparities_below_infinity,
    depth_and_disparity_in_single_precision,
    disparity_beyond_the_file,
    stored_holes,
    stored_confidence,
)
