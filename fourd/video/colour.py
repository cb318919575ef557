"""From decoded frames to display-referred 8-bit RGB; HLG and PQ films are mapped to SDR.

The mapping is display-referred, for a peak of 1000 cd/m2:

1. Light of the display, BT.2020 primaries. PQ: EOTF of BT.2100, table 4. HLG: inverse OETF
   E = E'^2 / 3 up to 1/2, else (exp((E' - c) / a) + b) / 12, and the OOTF F = 1000 Y^0.2 E with
   Y the luminance of E (BT.2100, table 5; system gamma 1.2 at 1000 cd/m2).
2. Divided by 203 cd/m2, the reference white of BT.2408, 2.1: 75 % HLG and 58 % PQ become 1.
3. Primaries of BT.2020 to those of BT.709 (BT.2087, 2.2, inverted); what lies outside is clipped at 0.
4. Tone curve per channel: x up to the knee k, above it k + (1 - k) f((x - k) / (1 - k)) with
   f(t) = t (1 + t / p^2) / (1 + t), p the peak's t: slope 1 at the knee, 1 at the peak
   (Reinhard et al., Photographic tone reproduction for digital images, 2002, eq. 4).
5. SDR signal x^(1 / 2.4), the inverse of the EOTF of BT.1886.

Reference white becomes 93 % of the SDR signal; a picture below the knee is reproduced exactly.
"""

import functools

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation

# The fast path of swscale repeats chroma samples and rounds down; 6 ms per 1080p frame buys both back.
INTERPOLATION = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
# H.273 matrix coefficients to swscale's numbering.
_COLORSPACES = {1: Colorspace.ITU709, 4: Colorspace.FCC, 5: Colorspace.ITU601, 6: Colorspace.ITU601}
_COLORSPACES |= {7: Colorspace.SMPTE240M, 9: Colorspace.BT2020, 10: Colorspace.BT2020}
_TRANSFERS = {16: "pq", 18: "hlg"}

# In swscale's 16 bits white is 255 << 8. Planar, because its rgb48le loses chroma in this mode.
WHITE_16 = 65280
REFERENCE_WHITE_NITS = 203.0
PEAK_NITS = 1000.0
KNEE = 0.7
_PEAK = PEAK_NITS / REFERENCE_WHITE_NITS
_LUMINANCE_2020 = np.array([[0.2627, 0.6780, 0.0593]], dtype=np.float32)
BT709_FROM_BT2020 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]],
    dtype=np.float32,
)


def transfer_of(frame: av.VideoFrame) -> str:
    """`hlg`, `pq` or `sdr` (everything else): the transfer characteristics a frame is tagged with."""
    return _TRANSFERS.get(int(frame.color_trc), "sdr")


def rgb_image(frame: av.VideoFrame) -> np.ndarray:
    """(H, W, 3) uint8 RGB, full range, of the stored picture. Untagged SDR follows HD or SD custom."""
    transfer = transfer_of(frame)
    if transfer != "sdr":
        return sdr_from_hdr(_to_rgb(frame, "gbrp16le", Colorspace.BT2020), transfer)
    is_hd = frame.width >= 1280 or frame.height > 576
    return _to_rgb(frame, "rgb24", Colorspace.ITU709 if is_hd else Colorspace.ITU601)


def _to_rgb(frame: av.VideoFrame, layout: str, untagged: Colorspace) -> np.ndarray:
    return frame.to_ndarray(
        format=layout,
        src_colorspace=None if frame.format.is_rgb else _COLORSPACES.get(frame.colorspace, untagged),
        dst_color_range=ColorRange.JPEG,
        interpolation=INTERPOLATION,
        threads=1,
    )


def luma_samples(frame: av.VideoFrame, step: int) -> np.ndarray:
    """Every step-th pixel, both ways, of the stored picture's luma: (h, w) float32, 8-bit levels.

    Single pixels, not means, so that the sensor's noise stays. Of RGB films it is one channel.
    """
    plane, component = frame.planes[0], frame.format.components[0]
    dtype = np.uint8 if component.bits <= 8 else np.uint16
    rows = np.frombuffer(memoryview(plane), dtype=dtype).reshape(plane.height, -1)
    return rows[::step, : plane.width : step].astype(np.float32) / 2 ** (component.bits - 8)


def sdr_from_hdr(rgb: np.ndarray, transfer: str) -> np.ndarray:
    """An HLG or PQ picture as SDR (BT.709), by the mapping that this module describes.

    rgb: (H, W, 3) uint16 signal of BT.2020, 0 to WHITE_16;  transfer: `hlg` or `pq`
    Returns (H, W, 3) uint8.
    """
    light = _light_table(transfer)[rgb]
    if transfer == "hlg":
        light *= cv2.pow(cv2.transform(light, _LUMINANCE_2020), 0.2)[..., None] * np.float32(_PEAK)
    light = np.clip(cv2.transform(light, BT709_FROM_BT2020), 0, _PEAK)
    # The root spreads the dark levels over the table.
    index = cv2.sqrt(light)
    index *= np.float32(65535 / np.sqrt(_PEAK))
    return _signal_table()[(index + np.float32(0.5)).astype(np.uint16)]


@functools.cache
def _light_table(transfer: str) -> np.ndarray:
    """(65536,) float32 of a 16-bit signal: scene light of HLG, 0 to 1; display light of PQ, white 1."""
    signal = np.minimum(np.arange(65536) / WHITE_16, 1)
    if transfer == "hlg":
        a = 0.17883277
        b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    else:
        m1, m2 = 2610 / 16384, 2523 / 4096 * 128
        c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
        root = signal ** (1 / m2)
        light = 10000 * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1) / REFERENCE_WHITE_NITS
    return light.astype(np.float32)


@functools.cache
def _signal_table() -> np.ndarray:
    """(65536,) uint8 SDR signal; the index is the root of light, 65535 at the peak."""
    light = (np.arange(65536) / 65535) ** 2 * _PEAK
    above, peak = (light - KNEE) / (1 - KNEE), (_PEAK - KNEE) / (1 - KNEE)
    rolled = KNEE + (1 - KNEE) * above * (1 + above / peak**2) / (1 + np.maximum(above, 0))
    toned = np.where(light <= KNEE, light, rolled)
    return np.round(255 * np.clip(toned, 0, 1) ** (1 / 2.4)).astype(np.uint8)
