"""A user's own video-segmentation network behind the interface of `carry_flow`."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from fourd.edit.voxels import OBJECT, OTHER, UNKNOWN
from fourd.errors import InputError

# Beliefs between these are no opinion.
_SURE_NOT, _SURE = 0.3, 0.7


def load_network(path: Path | str) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """What carries a mask to the next frame, from a TorchScript file.

    The network is called as `network(image, before, mask)` with float32 tensors of (1, 3, H, W), (1, 3, H, W)
    and (1, 1, H, W), values 0 to 1, and gives (1, 1, H, W), the belief 0 to 1 that a pixel of `image` is the
    thing that `mask` shows in `before`.
    Raises InputError if the file is no such network.
    """
    # Torch takes seconds to import, and the flow does without it.
    import torch

    source = Path(path)
    if not source.is_file():
        raise InputError(
            f"edit.network: expected a TorchScript file at {source}, found nothing: check the path"
        )
    try:
        network = torch.jit.load(str(source), map_location="cpu").eval()
    except (RuntimeError, ValueError) as error:
        reason = str(error).strip().split("\n")[0]
        raise InputError(
            f"edit.network: expected a TorchScript file at {source}, got one that torch cannot load "
            f"({reason}): save it with torch.jit.save"
        ) from None

    def carry(image: np.ndarray, before: np.ndarray, mask: np.ndarray) -> np.ndarray:
        tensors = [torch.from_numpy(i.copy()).permute(2, 0, 1)[None].float() / 255 for i in (image, before)]
        tensors.append(torch.from_numpy((mask == OBJECT).astype(np.float32))[None, None])
        try:
            with torch.inference_mode():
                belief = network(*tensors)
        except RuntimeError as error:
            reason = str(error).strip().split("\n")[-1]
            raise InputError(
                f"edit.network: {source} failed on pictures of {image.shape[1]} x {image.shape[0]} px "
                f"({reason}): it has to take (image, before, mask)"
            ) from None
        if not isinstance(belief, torch.Tensor) or tuple(belief.shape) != (1, 1, *mask.shape):
            given = tuple(belief.shape) if isinstance(belief, torch.Tensor) else type(belief).__name__
            raise InputError(
                f"edit.network: expected {source} to give (1, 1, {mask.shape[0]}, {mask.shape[1]}), "
                f"got {given}: its last layer has to be as large as its input"
            )
        values = belief[0, 0].float().numpy()
        if not np.isfinite(values).all():
            raise InputError(
                f"edit.network: expected beliefs from 0 to 1 of {source}, got NaN: train it anew"
            )
        return np.where(values >= _SURE, OBJECT, np.where(values <= _SURE_NOT, OTHER, UNKNOWN)).astype(
            np.uint8
        )

    return carry
